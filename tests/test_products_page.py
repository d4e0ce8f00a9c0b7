"""The report page: what it says, and that names of photographs cannot put anything into it."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

from onthefly3r.options import Options
from onthefly3r.products.page import page, write_page
from onthefly3r.products.report import RejectedImage, RunSummary, Timing, build_report
from onthefly3r.products.reportfigures import Figure


class Words(HTMLParser):
    """Collects text and tags, and notices what is left open."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_page_tells_rejections_and_escapes_names() -> None:
    bad = RejectedImage("<script>x</script>.jpg", "retrieval", "no similar photograph & nothing near")
    report = build_report(RunSummary(Options(), "classical 1", 3, 2, [bad], Timing(4.0, 1.0), warnings=["<b>!"]), None)
    words = Words()
    words.feed(page(report, "flight <1>", preview=None))
    text = " ".join(words.text)
    assert not words.open
    assert "script" not in words.tags
    assert "b" not in words.tags
    assert "2 of 3" in text
    assert bad.image in text
    assert bad.reason in text
    assert "No placed photograph looks alike" in text


def test_page_with_an_undecodable_name_is_written(tmp_path: Path) -> None:
    bad = RejectedImage("DJI_\udcff.jpg", "intake", "damaged")
    report = build_report(RunSummary(Options(), "classical 1", 3, 2, [bad], Timing(4.0, 1.0)), None)
    write_page(tmp_path / "report.html", report, "flight \udcfe")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "DJI_\\udcff.jpg" in text
    assert "flight \\udcfe" in text


def test_page_names_weights_licence_and_gpu_memory() -> None:
    weights = {"file": "model.pt", "source": "a/b", "revision": "1f", "bytes": 1234567, "sha256": "0badcafe"}
    facts = {"name": "vggt", "version": "a/b@1f", "licence": "no <commercial> use", "weights": weights}
    memory = {"backbone": {"peak_gpu_mib": 4321.4}, "map": {"peak_rss_mib": 10.0}}
    run = RunSummary(Options(), "vggt a/b@1f", 3, 3, [], Timing(4.0, 1.0), backbone_facts=facts, stage_memory=memory)
    words = Words()
    words.feed(page(build_report(run, 99.0), "flight", preview=None))
    text = " ".join(words.text)
    for told in ("no <commercial> use", "a/b@1f: model.pt, 1,234,567 bytes", "0badcafe", "4321 MiB", "99 MiB"):
        assert told in text


def test_page_of_a_failed_run_says_why() -> None:
    report = build_report(
        RunSummary(Options(), "classical 1", 3, 0, [], Timing(4.0, 1.0), error="nothing overlaps"), None
    )
    assert "nothing overlaps" in page(report, "flight", preview=True)
    assert "<img" not in page(report, "flight", preview=True)


def test_a_run_that_placed_too_few_photographs_says_so_first() -> None:
    missing = [RejectedImage(f"{k}.jpg", "retrieval", "no similar photograph") for k in range(3)]
    report = build_report(RunSummary(Options(), "classical 1", 10, 7, missing, Timing(4.0, 1.0)), None)
    words = Words()
    words.feed(page(report, "flight", preview=None))
    text = " ".join(words.text)
    assert text.index("Part of the survey is missing: only 7 of 10") < text.index("Rejected photographs")
    whole = build_report(RunSummary(Options(), "classical 1", 10, 10, [], Timing(4.0, 1.0)), None)
    assert "The survey is good: 10 of 10" in page(whole, "flight", preview=None)


def test_the_command_repeats_the_options_and_is_quoted() -> None:
    options = Options.from_flat({"format": "las", "stray_filter": False, "crs": "EPSG:32633", "spacing_m": 0.5})
    report = build_report(RunSummary(options, "classical 1", 3, 3, [], Timing(4.0, 1.0)), None)
    command = report["software"]["command"]
    assert command.startswith("onthefly3r run PHOTOS OUT")
    for part in ("--format las", "--no-stray-filter", "--crs EPSG:32633", "--spacing-m 0.5"):
        assert part in command


def test_figures_are_drawn_into_the_page() -> None:
    report = build_report(RunSummary(Options(), "classical 1", 3, 3, [], Timing(4.0, 1.0)), None)
    words = Words()
    words.feed(page(report, "flight", None, [Figure("Maps < more", "<svg></svg>", "a <note>")]))
    assert "svg" in words.tags
    assert "Maps < more" in words.text
    assert "a <note>" in words.text
