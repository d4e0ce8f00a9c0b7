"""The strategies on a small simulated survey, and the parts of those that put pieces together afterwards."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.evaluate.trajectory_errors import pose_errors
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.map.store import Store
from onthefly3r.records import Subset
from onthefly3r.selection.index import RetrievalIndex
from onthefly3r.simulate.oracle import Faults, Noise, OracleBackbone, OracleDescriber
from paper import simulated, strategies
from paper.__main__ import main
from paper.chunks import PUBLISHED, chunk_windows, find_loops, place_chunks
from paper.interleaved import hamiltonian_order, interleaved_windows
from paper.partition import guests, halve, retrieval_graph, shared_most
from paper.passes import graph_passes
from paper.pieces import Piece, cameras, piece_of, settle, tie
from paper.results import read_result
from paper.simulated import SCENARIOS, in_turn, survey_of

SILENT = Noise(0.0, 0.0, 0.0, 0.1)
CLEAN = replace(SCENARIOS["small"], name="clean", look_alike=False, faults=Faults())


def test_drones_deliver_in_turn() -> None:
    survey = survey_of(SCENARIOS["small"], 0)
    numbers = [int(view.name[4:8]) for view in survey.views]
    assert numbers[:6] == [1, 61, 2, 62, 3, 63]
    assert sorted(numbers) == list(range(1, 121))
    views = survey.views[:5]
    assert in_turn(views, 1) == views
    assert [views.index(view) for view in in_turn(views, 2)] == [0, 3, 1, 4, 2]


@pytest.mark.parametrize("strategy", ["on-the-fly", "paper", "graph-cuts", "vanilla-unlimited"])
def test_without_faults_every_strategy_that_needs_no_order_places_all(strategy: str, tmp_path: Path) -> None:
    row = simulated.run_one(CLEAN, strategy, 0, tmp_path)
    assert row["placed"] == row["given"] == 120
    assert row["ate"] < 2.0  # metres at 100 m flying height
    poses = read_result(simulated.pose_file(tmp_path, "clean", strategy, 0))
    truth = simulated.truth(survey_of(CLEAN, 0))
    assert pose_errors(poses, truth).ate == pytest.approx(row["ate"])
    assert json.loads((tmp_path / "rows.jsonl").read_text())["strategy"] == strategy
    assert row["largest"] <= strategies.JOINT_LIMIT or strategy == "vanilla-unlimited"


def test_chunks_follow_one_drone_but_not_two_in_turn(tmp_path: Path) -> None:
    one = simulated.run_one(replace(CLEAN, drones=1), "chunks", 0, tmp_path)
    two = simulated.run_one(replace(CLEAN, faults=Faults(strays=True)), "chunks", 0, tmp_path)
    assert one["placed"] == two["placed"] == 120
    assert one["ate"] < 2.0 < 20.0 < two["ate"]


def test_interleaved_parts_place_what_one_call_sees_as_a_whole(tmp_path: Path) -> None:
    one = simulated.run_one(SCENARIOS["joint"], "interleaved", 0, tmp_path)
    assert one["placed"] == 58 and one["ate"] < 0.5 and one["calls"] == 1
    two = simulated.run_one(replace(CLEAN, images=80, drones=1), "interleaved", 0, tmp_path)
    assert two["placed"] == 80 and two["ate"] < 2.0 and two["calls"] == 3 and two["largest"] <= 58


def test_a_joint_inference_runs_out_of_memory(tmp_path: Path) -> None:
    row = simulated.run_one(CLEAN, "vanilla", 0, tmp_path)
    assert row["placed"] == row["calls"] == 0 and row["ate"] is None and row["note"].startswith("out of memory")
    fits = simulated.run_one(SCENARIOS["joint"], "vanilla", 0, tmp_path)
    assert fits["placed"] == fits["largest"] == 58 and fits["calls"] == 1


def test_ours_withstands_what_the_survey_has_in_store(tmp_path: Path) -> None:
    row = simulated.run_one(SCENARIOS["small"], "on-the-fly", 1, tmp_path)
    assert row["placed"] >= 0.99 * row["given"]
    assert row["ate"] < 1.5
    assert row["passes"] and all(after <= 1.02 * before for before, after in row["passes"])


def test_the_command_runs_what_is_missing_and_prints_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulated", "--scenario", "joint", "--seed", "0", "--out", str(tmp_path), "--strategy"]
    assert main([*command, "vanilla", "chunks"]) == 0
    first = capsys.readouterr().out
    assert first.count("placed,") == 2 and "| vanilla | 0 |" in first
    assert main([*command, "vanilla", "chunks", "case-2"]) == 0
    second = capsys.readouterr().out
    assert second.count("placed,") == 1 and "| 2 | yes | no | no |" in second and "numpy" in second
    assert len(simulated.read_rows(tmp_path)) == 3


def test_the_journal_tells_what_the_pose_graph_did(tmp_path: Path) -> None:
    survey = survey_of(CLEAN, 0)
    images = {shot.name: image for shot, image in _shots_and_images(survey)}
    task = strategies.Task(
        shots=[shot for shot, _ in _shots_and_images(survey)],
        load=lambda shot: images[shot.name],
        backbone=OracleBackbone(survey, grid_side_px=32),
        describer=OracleDescriber(survey),
        work=tmp_path,
    )
    placement = strategies.place("on-the-fly", task)
    passes = graph_passes(Store(tmp_path))
    assert len(passes) == len(placement.passes) > 0
    last = passes[-1].after
    assert set(last) == set(placement.map_from_cam)
    for index, pose in placement.map_from_cam.items():
        np.testing.assert_allclose(last[index].translation, pose.translation, atol=1e-9)
    assert any(np.abs(passes[0].after[i].translation - p.translation).max() > 0 for i, p in passes[0].before.items())


def _shots_and_images(survey: object) -> list[tuple[object, object]]:
    from onthefly3r.simulate.oracle import oracle_images, oracle_shots

    return list(zip(oracle_shots(survey), oracle_images(survey, 32).values(), strict=True))  # type: ignore[arg-type]


# ------------------------------------------------------------------ pieces


@pytest.fixture(scope="module")
def pieces() -> list[Piece]:
    """Three noise-free pieces in a row, each in a frame and scale of its own."""
    survey = survey_of(replace(CLEAN, drones=1), 0)
    backbone = OracleBackbone(survey, SILENT, grid_side_px=64)
    found = []
    for number, members in enumerate(((0, 1, 2, 3, 4, 5), (3, 4, 5, 6, 7, 8), (6, 7, 8, 9, 10, 11))):
        model = backbone.reconstruct(Subset((), members), {}, {})
        found.append(piece_of(number, model, 0.5))  # type: ignore[arg-type]
    return found


def test_a_tie_is_the_similarity_between_two_pieces(pieces: list[Piece]) -> None:
    edge = tie(pieces[0], pieces[1])
    assert edge is not None and (edge.source, edge.target) == (0, 1)
    for image in (3, 4, 5):
        moved = edge.source_from_target.apply_to_pose(pieces[1].local_from_cam[image])
        here = pieces[0].local_from_cam[image]
        scale = np.linalg.norm(here.translation - pieces[0].local_from_cam[0].translation)
        assert np.linalg.norm(moved.translation - here.translation) < 1e-4 * scale
        np.testing.assert_allclose(moved.rotation, here.rotation, atol=1e-4)
    assert tie(pieces[0], pieces[2]) is None  # no image in common


def test_pieces_settle_along_their_ties(pieces: list[Piece]) -> None:
    edges = [tie(pieces[0], pieces[1]), tie(pieces[1], pieces[2])]
    poses = settle(pieces, [edge for edge in edges if edge], root=0)
    placed = cameras(pieces, poses, {i: min(i // 4, 2) for i in range(12)})
    survey = survey_of(replace(CLEAN, drones=1), 0)
    errors = pose_errors(simulated.pose_set(placed, survey), simulated.truth(survey))
    assert errors.n_common == 12 and errors.ate < 0.01 and errors.are_deg < 0.01
    alone = settle(pieces, [edge for edge in edges[:1] if edge], root=0)
    assert set(alone) == {0, 1}  # what hangs on nothing has no place
    assert 11 not in cameras(pieces, alone, {0: 0, 11: 2})


def test_a_loop_spreads_the_error_of_a_chain() -> None:
    turn = Sim3(1.0, rotation_exp(np.array([0.0, 0.0, 0.5])), np.array([1.0, 0.0, 0.0]))
    nothing = [Piece(k, {}, {}, {}) for k in range(4)]
    from onthefly3r.records import Edge

    drifting = Sim3(1.02, turn.rotation, turn.translation)
    chain = [Edge(k, k + 1, drifting, np.eye(7)) for k in range(3)]
    closing = Edge(0, 3, turn @ turn @ turn, np.eye(7))
    open_end = settle(nothing, chain, root=0)[3].scale
    closed = settle(nothing, [*chain, closing], root=0)[3].scale
    assert open_end == pytest.approx(1.02**3)
    assert 1.0 < closed < 1.02**1.5


def test_the_tree_takes_the_most_trusted_edges_first() -> None:
    from onthefly3r.records import Edge

    def step(metres: float) -> Sim3:
        return Sim3(1.0, np.eye(3), np.array([metres, 0.0, 0.0]))

    nothing = [Piece(k, {}, {}, {}) for k in range(3)]
    precise, vague = 1e-6 * np.eye(7), 1e6 * np.eye(7)
    chain = [Edge(0, 1, step(1.0), precise), Edge(1, 2, step(1.0), precise)]
    shortcut = Edge(0, 2, step(500.0), vague)
    assert settle(nothing, [*chain, shortcut], root=0)[2].translation[0] == pytest.approx(2.0, abs=0.01)
    assert settle(nothing, [shortcut, chain[0]], root=0)[2].translation[0] == pytest.approx(500.0)


# ------------------------------------------------------------------ chunks


def test_windows_overlap_by_half() -> None:
    assert [list(w)[:: len(w) - 1] for w in chunk_windows(20, 8)] == [[0, 7], [4, 11], [8, 15], [12, 19]]
    assert [list(w) for w in chunk_windows(5, 8)] == [[0, 1, 2, 3, 4]]
    for n in range(3, 60):
        assert set().union(*chunk_windows(n, 10)) == set(range(n))


def test_a_loop_is_the_most_similar_pair_of_chunks_that_are_no_neighbours() -> None:
    windows = chunk_windows(20, 8)
    similarity = np.zeros((20, 20))
    similarity[1, 14], similarity[2, 15], similarity[0, 10], similarity[3, 17] = 0.7, 0.9, 0.99, 0.5
    assert find_loops(windows, np.maximum(similarity, similarity.T), 0.6) == [(2, 15)]
    assert find_loops(windows, np.maximum(similarity, similarity.T), 0.95) == []


def test_the_published_chunks_have_sixty_images_and_loops_of_forty(tmp_path: Path) -> None:
    assert [list(w)[:: len(w) - 1] for w in chunk_windows(100, PUBLISHED.chunk)] == [[0, 59], [30, 89], [60, 99]]
    sizes: list[int] = []

    def infer(members: object) -> None:
        sizes.append(len(members))  # type: ignore[arg-type]

    loop = on_a_line([0.01 * min(k, 179 - k) for k in range(180)])  # there and back on the same way
    place_chunks(180, loop, infer, 0.5, PUBLISHED)
    assert sizes[:5] == [60] * 5 and 40 in sizes[5:] and max(sizes[5:]) <= 40


# ------------------------------------------------------------------ parts


def on_a_line(places: list[float]) -> RetrievalIndex:
    index = RetrievalIndex()
    for k, place in enumerate(places):
        index.add(k, np.array([np.cos(place), np.sin(place)], np.float32))
    return index


def test_the_graph_is_cut_where_it_is_weakest() -> None:
    places = [0.001 * k for k in range(20)] + [1.4 + 0.001 * k for k in range(20)]
    graph = retrieval_graph(40, on_a_line(places))
    assert np.abs(graph - graph.T).max() == 0.0 and graph.diagonal().max() == 0.0
    parts = halve(graph, np.arange(40), 20)
    assert sorted(sorted(part.tolist()) for part in parts) == [list(range(20)), list(range(20, 40))]
    assert all(len(part) <= 7 for part in halve(graph, np.arange(40), 7))
    assert sorted(i for part in halve(graph, np.arange(40), 7) for i in part) == list(range(40))


def test_a_visual_order_follows_the_line_and_interleaved_parts_span_it() -> None:
    shuffled = np.random.default_rng(0).permutation(90)
    order = hamiltonian_order(90, on_a_line([0.03 * place for place in shuffled]))
    places = shuffled[order].tolist()
    assert places in (list(range(90)), list(range(89, -1, -1)))
    windows = interleaved_windows(list(range(90)), 30)
    assert [part[:3] for part, _ in windows] == [[k, k + 5, k + 10] for k in range(5)]
    assert sorted(i for part, _ in windows for i in part) == list(range(90))
    for (part, borrowed), (following, _) in zip(windows, [*windows[1:], windows[0]], strict=True):
        assert len(part) + len(borrowed) <= 30 and borrowed == following[: len(borrowed)] and len(borrowed) >= 10
        assert max(part) - min(part) >= 80
    assert interleaved_windows([2, 0, 1], 30) == [([2, 0, 1], [])]
    assert hamiltonian_order(0, RetrievalIndex()) == []


def test_guests_are_the_nearest_images_outside() -> None:
    graph = retrieval_graph(30, on_a_line([0.05 * k for k in range(30)]))
    assert set(guests(graph, np.arange(10), 3)) == {10, 11, 12}
    assert guests(graph, np.arange(30), 3) == []


def test_pairs_that_share_most_come_first() -> None:
    def piece(number: int, *images: int) -> Piece:
        return Piece(number, dict.fromkeys(images, Rigid3()), {}, {})

    found = shared_most([piece(0, 1, 2, 3, 4), piece(1, 2, 3, 4, 5, 6, 7, 8), piece(2, 5, 6, 7, 8, 1)])
    assert found == [(1, 2), (0, 1)]
