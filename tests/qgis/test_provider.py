"""What QGIS sees of the plugin: the provider, its algorithms and their descriptions."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

ALGORITHMS = {
    "loadresults",
    "sampleflight",
    "reconstruct",
    "exportcloud",
    "exportcameras",
    "georeference",
    "reconstructflights",
    "check",
    "evaluate",
    "setup",
}


def algorithms() -> list[Any]:
    from qgis.core import QgsApplication

    return list(QgsApplication.processingRegistry().providerById("onthefly3r").algorithms())


def test_qgis_process_lists_them(qgis_process: Any) -> None:
    listed = qgis_process("list")
    assert listed.returncode == 0
    assert set(re.findall(r"^\s+onthefly3r:(\w+)\t", listed.stdout, flags=re.MULTILINE)) == ALGORITHMS
    shown = qgis_process("help", "onthefly3r:reconstruct")
    assert "name=value, a line each" in shown.stdout


def test_provider(qgis: Any, plugin: Any) -> None:
    from qgis.core import QgsApplication

    provider = QgsApplication.processingRegistry().providerById("onthefly3r")
    assert {algorithm.name() for algorithm in algorithms()} == ALGORITHMS
    assert provider.versionInfo() == plugin("core.onthefly3r").__version__
    assert not provider.icon().isNull()


def test_every_parameter_output_and_algorithm_is_described(qgis: Any) -> None:
    for algorithm in algorithms():
        assert len(algorithm.shortHelpString()) > 100
        assert algorithm.shortDescription().endswith(".")
        assert algorithm.displayName() and algorithm.helpUrl().startswith("file:")
        icon = Path(algorithm.svgIconPath())
        assert icon.is_file() and not algorithm.icon().isNull()
        for parameter in algorithm.parameterDefinitions():
            where = f"{algorithm.name()} {parameter.name()}"
            assert parameter.description()[0].isupper() or parameter.description()[0].isdigit(), where
            assert len(parameter.help()) > 15 and parameter.help().endswith("."), where
            assert "_" not in parameter.description(), where
        for output in algorithm.outputDefinitions():
            assert output.description(), f"{algorithm.name()} {output.name()}"
        names = [item.name() for item in (*algorithm.parameterDefinitions(), *algorithm.outputDefinitions())]
        destinations = {item.name() for item in algorithm.destinationParameterDefinitions()}
        assert {name for name in names if names.count(name) > 1} <= destinations | {"OUTPUT"}


def test_every_option_of_the_core_has_a_parameter(qgis: Any, plugin: Any) -> None:
    from qgis.core import QgsApplication, QgsProcessingParameterDefinition

    algorithm = QgsApplication.processingRegistry().algorithmById("onthefly3r:reconstruct")
    definitions = algorithm.parameterDefinitions()
    named = {parameter.name() for parameter in definitions}
    assert {"PHOTOS", "QUALITY", "CRS", "CONTROL", "BOUNDARY", "EXTENT", "OPTIONS", "OUTPUT"} <= named
    advanced = QgsProcessingParameterDefinition.Flag.FlagAdvanced
    assert len([item for item in definitions if not item.flags() & advanced]) <= 11
    text = plugin("processing_algorithms.option_text")
    for _, item in plugin("core.onthefly3r.options").iterate_options():
        assert text.known_name(item.name.upper().replace("_", "-")) == item.name


def test_words_that_people_look_for_find_it(qgis: Any) -> None:
    for algorithm in algorithms():
        assert {"uav", "drone", "photogrammetry", "sfm", "lidar", "orthophoto", "dem"} <= set(algorithm.tags())


def test_help_is_a_page(qgis: Any, plugin: Any) -> None:
    from qgis.PyQt.QtCore import QUrl

    page = Path(QUrl(plugin("plugin.help_page").help_page()).toLocalFile())
    text = page.read_text(encoding="utf-8")
    assert page.suffix == ".html" and "<table" in text and "First run" in text
    pictures = re.findall(r'src="([^"]+)"', text)
    assert pictures and all(Path(QUrl(name).toLocalFile()).is_file() for name in pictures)
    assert "**" not in text and "](" not in text
    assert algorithms()[0].helpUrl().endswith(".html")


def test_backbones_are_those_of_the_core(qgis: Any, plugin: Any) -> None:
    text = (Path(plugin("plugin.worker").PLUGIN_FOLDER) / "core/onthefly3r/backbones/registry.py").read_text()
    built_in = re.findall(r'^    "([\w-]+)": "onthefly3r\.backbones', text, flags=re.MULTILINE)
    assert tuple(sorted(built_in)) == tuple(sorted(plugin("processing_algorithms.parameters").BACKBONES))


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_usable_in_the_modeler_and_in_batches(qgis: Any, name: str) -> None:
    from qgis.core import (
        QgsApplication,
        QgsProcessingAlgorithm,
        QgsProcessingModelAlgorithm,
        QgsProcessingModelChildAlgorithm,
    )

    algorithm = QgsApplication.processingRegistry().algorithmById(f"onthefly3r:{name}")
    assert algorithm.flags() & QgsProcessingAlgorithm.Flag.FlagSupportsBatch
    assert not algorithm.flags() & QgsProcessingAlgorithm.Flag.FlagHideFromModeler
    model = QgsProcessingModelAlgorithm("model", "tests")
    child = QgsProcessingModelChildAlgorithm(f"onthefly3r:{name}")
    assert child.reattach()
    model.addChildAlgorithm(child)
    assert model.childAlgorithms()


def test_settings_name_the_interpreter_and_the_variable_goes_first(
    qgis: Any, plugin: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settings = plugin("plugin.settings")
    python = tmp_path / "no-dot-in-this-name"
    python.write_text("")
    monkeypatch.delenv("ONTHEFLY3R_PYTHON")
    assert settings.interpreter() == ""
    settings.save_interpreter(str(python))
    assert settings.interpreter() == str(python)
    python.unlink()
    assert settings.interpreter() == ""
    environment = tmp_path / "environment"
    settings.save_environment(str(environment))
    interpreter = environment / "bin" / "python"
    interpreter.parent.mkdir(parents=True)
    interpreter.write_text("")
    assert settings.interpreter() == ""  # it was not completed
    (environment / "onthefly3r-stamp.json").write_text("{}")
    assert settings.interpreter() == str(interpreter)
    monkeypatch.setenv("ONTHEFLY3R_PYTHON", str(tmp_path / "elsewhere"))
    assert settings.interpreter() == ""
    settings.save_environment("")


def test_stamp_has_the_name_that_bootstrap_gives_it(plugin: Any) -> None:
    text = (Path(plugin("plugin.worker").PLUGIN_FOLDER) / "bootstrap.py").read_text(encoding="utf-8")
    assert f'STAMP_NAME = "{plugin("plugin.settings")._STAMP}"' in text


def test_options_page_shows_the_settings(qgis: Any) -> None:
    from processing.core.ProcessingConfig import ProcessingConfig

    shown = ProcessingConfig.getSettings()["On-the-Fly3R"]
    names = ["ONTHEFLY3R_PYTHON", "ONTHEFLY3R_ENVIRONMENT", "ONTHEFLY3R_WEIGHTS", "ONTHEFLY3R_SCRATCH"]
    assert [setting.name for setting in shown] == names


def test_worker_learns_the_folders_that_the_settings_name(qgis: Any, plugin: Any, tmp_path: Path) -> None:
    from qgis.core import QgsSettings

    settings, worker = plugin("plugin.settings"), plugin("plugin.worker")
    assert settings.worker_variables() == {}
    named = {settings.MODELS: str(tmp_path / "weights"), settings.CACHE: str(tmp_path)}
    try:
        for name, folder in named.items():
            QgsSettings().setValue(f"Processing/Configuration/{name}", folder)
        environ = worker.worker_environ(settings.worker_variables())
    finally:
        for name in named:
            QgsSettings().remove(f"Processing/Configuration/{name}")
    assert environ["ONTHEFLY3R_WEIGHTS"] == str(tmp_path / "weights")
    assert environ["TMPDIR"] == environ["TEMP"] == str(tmp_path)


def test_recent_runs_are_those_that_are_still_there(qgis: Any, plugin: Any, tmp_path: Path) -> None:
    settings = plugin("plugin.settings")
    runs = [tmp_path / name for name in ("a", "b", "c")]
    for run in runs:
        run.mkdir()
        (run / "report.json").write_text("{}")
        (run / "report.html").write_text("")
        settings.save_run(str(run))
    assert settings.recent_runs()[:3] == [str(run) for run in reversed(runs)]
    assert settings.last_report() == str(runs[2] / "report.html")
    settings.save_run(str(runs[0]))
    (runs[2] / "report.json").unlink()
    assert settings.recent_runs()[:2] == [str(runs[0]), str(runs[1])]
