"""The pose graph against known truth, and gtsam's conventions, which are not ours."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.graph.posegraph import (
    MEDIAN_MISFIT,
    PosePrior,
    consistent_priors,
    default_solver,
    floored,
    optimise_frames,
    optimise_submaps,
)
from onthefly3r.graph.sightings import (
    FRAMES,
    ViewNoise,
    misfits_at_camera,
    shared_sightings,
    submap_edges,
    tangent,
    view_edge,
    view_noise,
)
from onthefly3r.graph.solver import PoseGraphSolver
from onthefly3r.graph.sparse_solver import SparseSolver
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import Edge, Frame, FrameEdge, Sighting, Submap

SIGMA = np.array([0.002, 0.002, 0.002, 0.02, 0.02, 0.02, 0.002])  # rotation rad, translation, log scale
COVARIANCE = np.diag(SIGMA**2)
CAMERA = Camera(56, 42, 38.0, 38.0, 28.0, 21.0)


def exp(step: np.ndarray) -> Sim3:
    """A small similarity of [rotation, translation, log scale]."""
    return Sim3(float(np.exp(step[6])), rotation_exp(step[:3]), step[3:6])


def ring(count: int = 12, seed: int = 0) -> dict[int, Sim3]:
    """Submaps around a circle of radius 5, each with a frame, scale and size of its own."""
    rng = np.random.default_rng(seed)
    poses = {}
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        rotation = rotation_exp(np.array([0.0, 0.0, angle]) + 0.1 * rng.standard_normal(3))
        place = 5.0 * np.array([np.cos(angle), np.sin(angle), 0.1 * np.sin(3 * angle)])
        poses[k] = Sim3(float(np.exp(0.3 * rng.standard_normal())), rotation, place)
    return poses


def measured(truth: dict[int, Sim3], source: int, target: int, rng: np.random.Generator, bend: float = 0.0) -> Edge:
    error = exp(SIGMA * rng.standard_normal(7) + bend * np.array([0, 0, 0.01, 0, 0, 0, 0.01]))
    return Edge(source, target, truth[source].inverse() @ truth[target] @ error, COVARIANCE)


def chained(edges: list[Edge], first: Sim3) -> dict[int, Sim3]:
    """Poses as the online registration leaves them: one edge after the other."""
    poses = {0: first}
    for edge in edges:
        if edge.target == max(poses) + 1 and edge.source in poses:
            poses[edge.target] = poses[edge.source] @ edge.source_from_target
    return poses


def errors(poses: dict[int, Sim3], truth: dict[int, Sim3]) -> np.ndarray:
    return np.array([np.linalg.norm(poses[k].translation - truth[k].translation) for k in truth])


def sighting(edge: Edge) -> Sighting:
    """The one frame of the source, as the target saw it again."""
    seen = edge.source_from_target.inverse()
    return Sighting(100 + edge.source, edge.target, edge.source_from_target, Rigid3(seen.rotation, seen.translation))


def state_of(work: Path, poses: dict[int, Sim3], edges: list[Edge]) -> MapState:
    """A map whose submaps hold one frame each, at their origins."""
    state = MapState(Store(work))
    for k, pose in poses.items():
        frame = Frame(100 + k, k, CAMERA, PixelMap(1.0, 1.0), Rigid3(), 1.0)
        state.commit(Submap(k, pose, (frame,), tuple(sighting(e) for e in edges if e.target == k)), [])
    state.set_spacing(0.1)
    return state


@pytest.fixture(params=["sparse", "gtsam"])
def solver(request: pytest.FixtureRequest) -> PoseGraphSolver:
    """Each of the two solvers."""
    if request.param == "sparse":
        return SparseSolver()
    pytest.importorskip("gtsam")
    from onthefly3r.graph.gtsam_solver import GtsamSolver

    return GtsamSolver()


@pytest.mark.parametrize("seed", range(4))
def test_gtsam_similarities_mean_s_times_r_p_plus_t(seed: int) -> None:
    pytest.importorskip("gtsam")
    from onthefly3r.graph.gtsam_solver import from_similarity3, to_similarity3

    rng = np.random.default_rng(seed)
    first, second = (exp(rng.standard_normal(7)) for _ in range(2))
    point = rng.standard_normal(3)
    there = to_similarity3(first)
    np.testing.assert_allclose(there.transformFrom(point), first.apply(point), atol=1e-12)
    assert not np.allclose(there.translation(), first.translation)  # the trap
    back = from_similarity3(to_similarity3(first) * to_similarity3(second))
    np.testing.assert_allclose(back.matrix(), (first @ second).matrix(), atol=1e-12)
    np.testing.assert_allclose(from_similarity3(to_similarity3(first).inverse()).matrix(), first.inverse().matrix())


def test_a_closed_ring_gets_better_and_its_first_submap_stays(solver: PoseGraphSolver) -> None:
    truth, rng = ring(), np.random.default_rng(1)
    edges = [measured(truth, k, (k + 1) % 12, rng, bend=2.0) for k in range(12)]
    drifted = chained(edges, truth[0])
    solved = solver.solve_sim3(drifted, edges, [], fixed=0)
    np.testing.assert_allclose(solved[0].matrix(), truth[0].matrix(), atol=1e-9)
    assert errors(drifted, truth).max() > 1.0
    assert errors(solved, truth).max() < 0.35 * errors(drifted, truth).max()
    scales = np.array([solved[k].scale / truth[k].scale for k in truth])
    assert np.abs(np.log(scales)).max() < 0.08


def test_consistent_edges_are_met_exactly(solver: PoseGraphSolver) -> None:
    truth = ring()
    silent = [Edge(a, b, truth[a].inverse() @ truth[b], COVARIANCE) for a in range(12) for b in range(a)]
    rng = np.random.default_rng(2)
    moved = {k: pose @ exp(0.05 * rng.standard_normal(7)) if k else pose for k, pose in truth.items()}
    solved = solver.solve_sim3(moved, silent, [], fixed=0)
    assert errors(solved, truth).max() < 1e-4


def test_a_wrong_loop_is_outvoted(solver: PoseGraphSolver) -> None:
    truth, rng = ring(), np.random.default_rng(3)
    edges = [measured(truth, k, (k + step) % 12, rng) for k in range(12) for step in (1, 2)]
    wrong = Edge(2, 8, Sim3(1.0, np.eye(3), np.array([9.0, 0.0, 0.0])), COVARIANCE)
    alone = solver.solve_sim3(truth, edges, [], fixed=0)
    with_wrong = solver.solve_sim3(truth, [*edges, wrong], [], fixed=0)
    assert errors(with_wrong, truth).max() < errors(alone, truth).max() + 0.1


def test_frames_of_the_papers_graph(tmp_path: Path, solver: PoseGraphSolver) -> None:
    """SE(3): relative poses round a ring; only cameras move."""
    truth = {k: Rigid3(pose.rotation, pose.translation) for k, pose in ring().items()}
    rng = np.random.default_rng(4)
    edges = []
    for k in range(12):
        error = exp(np.append(0.02 * np.ones(3), np.zeros(4)) + 0.001 * rng.standard_normal(7))
        relative = truth[k].inverse() @ truth[(k + 1) % 12] @ Rigid3(error.rotation, error.translation)
        edges.append(FrameEdge(100 + k, 100 + (k + 1) % 12, relative, 0.01, 0.05, "ref"))
    drifted = {0: truth[0]}
    for k in range(11):
        drifted[k + 1] = drifted[k] @ edges[k].source_from_target
    state = state_of(tmp_path, {k: Sim3(1.0, p.rotation, p.translation) for k, p in drifted.items()}, [])
    state.frame_edges.extend(edges)
    optimise_frames(state, solver)
    before = max(np.linalg.norm(drifted[k].translation - truth[k].translation) for k in truth)
    after = max(np.linalg.norm(state.map_from_cam(100 + k).translation - truth[k].translation) for k in truth)
    assert after < 0.5 * before
    assert rotation_angle_deg(state.map_from_cam(100).rotation @ truth[0].rotation.T) < 1e-6
    np.testing.assert_array_equal(state.map_from_submap[5].translation, drifted[5].translation)


def test_cameras_follow_their_submaps_and_a_tree_stays_as_it_is(tmp_path: Path, solver: PoseGraphSolver) -> None:
    truth, rng = ring(), np.random.default_rng(5)
    chain = [measured(truth, k, k + 1, rng, bend=2.0) for k in range(11)]
    drifted = chained(chain, truth[0])
    lonely = state_of(tmp_path / "lonely", drifted, [])
    assert optimise_submaps(lonely, solver) == 0.0
    tree = state_of(tmp_path / "tree", drifted, chain)
    assert optimise_submaps(tree, solver) == 0.0
    loop = Edge(0, 11, truth[0].inverse() @ truth[11], COVARIANCE)
    state = state_of(tmp_path / "loop", drifted, [*chain, loop])
    shift = optimise_submaps(state, solver)
    moved = np.array([state.map_from_cam(100 + k).translation - drifted[k].translation for k in truth])
    assert shift == pytest.approx(np.abs(moved).max() / 0.1)
    assert errors(state.map_from_submap, truth).max() < errors(drifted, truth).max()
    unseen = state.frames[111]  # by any other submap
    np.testing.assert_allclose(  # but for what little bend these few sightings show
        state.map_from_cam(111).translation,
        state.map_from_submap[11].apply(unseen.submap_from_cam.translation),
        atol=0.01,
    )


NOISE = ViewNoise(0.002, 0.03, 0.003)


def block(work: Path, seed: int, n_submaps: int = 12, n_frames: int = 60, seen: int = 9) -> tuple[MapState, dict]:
    """Submaps that see frames of one another, every view with `NOISE` of its own; and where the cameras are.

    Submap 0 sees all, so that nothing drifts: what is left is the noise of single views.
    """
    rng = np.random.default_rng(seed)
    truth = {
        k: Sim3(float(np.exp(0.3 * rng.standard_normal())), pose.rotation, pose.translation)
        for k, pose in ring(n_submaps, seed).items()
    }
    cameras = {
        i: Rigid3(rotation_exp(0.3 * rng.standard_normal(3)), rng.uniform(-3.0, 3.0, 3)) for i in range(n_frames)
    }

    def view(k: int, i: int) -> tuple[Sim3, Rigid3]:
        """submap_from_scene of this view, which is off about the camera, and the camera in the submap."""
        off = NOISE.rotation_rad * rng.standard_normal(3), NOISE.position * rng.standard_normal(3)
        about = Sim3(1.0, np.eye(3), cameras[i].translation)
        noise = Sim3(float(np.exp(NOISE.log_scale * rng.standard_normal())), rotation_exp(off[0]), off[1])
        submap_from_scene = truth[k].inverse() @ about @ noise @ about.inverse()
        return submap_from_scene, submap_from_scene.apply_to_pose(cameras[i])

    state = MapState(Store(work))
    own = {i: (i % n_submaps, *view(i % n_submaps, i)) for i in range(n_frames)}
    for k, pose in truth.items():
        frames = tuple(Frame(i, k, CAMERA, PixelMap(1.0, 1.0), cam, 1.0) for i, (s, _, cam) in own.items() if s == k)
        others = [i for i in own if own[i][0] < k]
        again = [int(i) for i in rng.permutation(others)[:seen]]
        sightings = []
        for i in again:
            submap_from_scene, submap_from_cam = view(k, i)
            sightings.append(Sighting(i, k, own[i][1] @ submap_from_scene.inverse(), submap_from_cam))
        state.commit(Submap(k, pose, frames, tuple(sightings)), [])
    state.set_spacing(0.1)
    return state, cameras


def rms(state: MapState, cameras: dict[int, Rigid3], of: set[int]) -> float:
    return float(
        np.sqrt(np.mean([((state.map_from_cam(i).translation - cameras[i].translation) ** 2).sum() for i in of]))
    )


def test_a_frame_goes_to_the_mean_of_what_several_submaps_say(tmp_path: Path, solver: PoseGraphSolver) -> None:
    better = []
    for seed in range(4):
        state, cameras = block(tmp_path / str(seed), seed)
        count = {i: sum(seen.frame == i for seen in state.sightings) for i in cameras}
        often = {i for i, n in count.items() if n >= 2}
        before = rms(state, cameras, often)
        optimise_submaps(state, solver)
        better.append(rms(state, cameras, often) / before)
    # Three views or more each; the submaps, true before, take their share of the noise.
    assert np.mean(better) < 0.8


@pytest.mark.parametrize("unit", [1.0, 50.0])
def test_the_noise_of_views_is_what_the_misfits_show(tmp_path: Path, unit: float, solver: PoseGraphSolver) -> None:
    """Whatever the map's unit; views placed wrong do not count."""
    state, _ = block(tmp_path, 3, n_submaps=30, n_frames=120, seen=12)
    change = Sim3(unit, np.eye(3), np.zeros(3))
    sightings = shared_sightings(state)
    assert len(sightings) == len({seen.frame for seen in state.sightings}) + len(state.sightings)
    nodes = {k: change @ pose for k, pose in state.map_from_submap.items()}
    nodes |= {FRAMES + seen.frame: change @ state.submap_pose_of(seen.frame) for seen in sightings}
    scales = {k: nodes[k].scale for k in state.map_from_submap}
    wrong = Sim3(1.0, np.eye(3), np.array([3.0, 0.0, 0.0]))
    sightings[3::20] = [replace(seen, frame_from_submap=seen.frame_from_submap @ wrong) for seen in sightings[3::20]]
    noise = ViewNoise(0.01, 0.1 * unit, 0.01)
    for _ in range(2):
        edges = [view_edge(seen, scales[seen.submap], noise) for seen in sightings]
        solved = solver.solve_sim3(nodes, edges, [], fixed=0)
        noise = view_noise(misfits_at_camera(solved, sightings), sightings, 1e-9)
    assert noise.rotation_rad == pytest.approx(NOISE.rotation_rad, rel=0.2)
    assert noise.position == pytest.approx(unit * NOISE.position, rel=0.2)
    assert noise.log_scale == pytest.approx(NOISE.log_scale, rel=0.2)


def test_a_camera_errs_about_its_own_centre() -> None:
    """The covariance of an edge, against the scatter of views that turn, move and stretch about the camera."""
    rng = np.random.default_rng(8)
    centre = np.array([1.0, -2.0, 3.0])
    about, scale = Sim3(1.0, np.eye(3), centre), 4.0
    steps = []
    for _ in range(4000):
        turn, shift, stretch = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal()
        noise = Sim3(
            float(np.exp(NOISE.log_scale * stretch)),
            rotation_exp(NOISE.rotation_rad * turn),
            NOISE.position / scale * shift,
        )
        steps.append(tangent(about @ noise @ about.inverse()))
    edge = view_edge(Sighting(5, 2, Sim3(), Rigid3(np.eye(3), centre)), scale, NOISE)
    assert (edge.source, edge.target) == (FRAMES + 5, 2)
    whitening = np.linalg.inv(np.linalg.cholesky(edge.covariance))
    np.testing.assert_allclose(whitening @ np.cov(np.array(steps).T) @ whitening.T, np.eye(7), atol=0.1)


def prior_on(pose: Sim3, submap: int, sigma: float = 0.02) -> PosePrior:
    return PosePrior(submap, pose, np.diag(1.0 / (SIGMA * sigma / 0.02) ** 2))


def test_priors_unbend_a_chain_and_wrong_ones_are_dropped(tmp_path: Path, solver: PoseGraphSolver) -> None:
    truth, rng = ring(), np.random.default_rng(6)
    chain = [measured(truth, k, k + step, rng, bend=4.0 * step) for k in range(11) for step in (1, 2) if k + step < 12]
    # A submap is fitted to several references, so that no view of it agrees to the last digit.
    fitted = {k: pose @ exp(SIGMA * rng.standard_normal(7)) for k, pose in chained(chain, truth[0]).items()}
    state = state_of(tmp_path, fitted, chain)
    priors = [prior_on(truth[k], k) for k in range(1, 12)]
    priors[4] = prior_on(replace(truth[5], translation=truth[5].translation + 3.0), 5)
    before = errors(state.map_from_submap, truth).max()
    optimise_submaps(state, solver, priors)
    after = errors(state.map_from_submap, truth)
    assert before > 2.0 and after[1:].max() < 0.15
    assert after[0] < 0.4  # no prior of its own: as far off as two bent edges lead it
    assert [p.submap for p in consistent_priors(priors, chain)] == [1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert consistent_priors(priors[:1], []) == priors[:1]  # no one to ask


def test_a_prior_may_leave_directions_open(solver: PoseGraphSolver) -> None:
    """A position alone: three of seven directions."""
    truth = ring(2)
    information = np.zeros((7, 7))
    information[3:6, 3:6] = np.eye(3) / 0.01**2
    edge = Edge(0, 1, truth[0].inverse() @ truth[1], COVARIANCE)
    target = replace(truth[0], translation=truth[0].translation + np.array([1.0, 2.0, 3.0]))
    solved = solver.solve_sim3(truth, [edge], [PosePrior(0, target, information)], fixed=0)
    np.testing.assert_allclose(solved[0].translation, target.translation, atol=1e-3)
    np.testing.assert_allclose((solved[0].inverse() @ solved[1]).matrix(), edge.source_from_target.matrix(), atol=1e-4)


def test_submaps_that_saw_the_same_frame_are_tied(tmp_path: Path) -> None:
    state, _ = block(tmp_path, 9)
    edges = submap_edges(shared_sightings(state), state, NOISE)
    assert len(edges) == len(state.sightings)
    misfits = []
    for edge in edges:
        source, target = (state.map_from_submap[k] for k in (edge.source, edge.target))
        step = tangent(edge.source_from_target.inverse() @ source.inverse() @ target)
        misfits.append(step @ np.linalg.solve(edge.covariance, step))
    assert float(np.median(misfits)) == pytest.approx(MEDIAN_MISFIT, rel=0.15)
    drawn = np.random.default_rng(0).chisquare(7, 200_000)
    assert float(np.median(drawn)) == pytest.approx(MEDIAN_MISFIT, abs=0.05)


def test_tangent_is_the_inverse_of_the_small_motion() -> None:
    step = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0, 0.05])
    np.testing.assert_allclose(tangent(exp(step)), step, atol=1e-12)


def test_floored_keeps_what_is_known_and_makes_the_rest_invertible() -> None:
    vector = np.arange(1.0, 8.0)
    singular = np.outer(vector, vector)
    result = floored(singular)
    np.linalg.inv(result)
    np.testing.assert_allclose(result, singular, atol=1e-6)


def test_the_sparse_solver_is_chosen_where_gtsam_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("gtsam") is not None:
        from onthefly3r.graph.gtsam_solver import GtsamSolver

        assert isinstance(default_solver(), GtsamSolver)
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert isinstance(default_solver(), SparseSolver)
