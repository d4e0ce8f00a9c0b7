"""Completeness and accuracy of clouds of simulated surveys against the true surface, by what the surface is.

    python benchmarks/dense_truth.py RUN [RUN ...] [--cloud FILE] [--option images=40 ...]

RUN is the output folder of a run over the photographs of a simulated survey (`onthefly3r demo` keeps one); `--option`
names what its survey was simulated with, where that is not the default. The cloud is moved by the similarity that fits
the cameras best, as `evaluate` does. Completeness: the share of surface samples that three photographs see, with a
point of the cloud within 1 and 2 ground sampling distances (GSD).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
from scipy.spatial import cKDTree

from onthefly3r.evaluate.readers import read_trajectory_csv
from onthefly3r.geometry.arrays import Float
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.simulate.flight import Survey, SurveyOptions, plan_survey
from onthefly3r.simulate.landscape import GROUND, ROOF, TREE, WALL

KINDS = (("ground", GROUND), ("roofs", ROOF), ("walls", WALL), ("trees", TREE))
SAMPLES, ERROR_SAMPLES = 3000, 10_000
SEEN_BY = 3
LEAST_SLANT = 0.17  # cosine between ray and normal of a photograph that sees a sample
MARGIN_PX = 2.0


def samples(survey: Survey, material: int, rng: np.random.Generator) -> Float:
    """Return points (N, 3) of one kind of surface that at least three photographs see."""
    scene = survey.scene
    sides = scene.triangles[:, 1:] - scene.triangles[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    faces = np.flatnonzero(scene.material == material)
    chosen = rng.choice(faces, SAMPLES, p=area[faces] / area[faces].sum())
    s, t = rng.random((2, len(chosen), 1))
    s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
    points = scene.triangles[chosen, 0] + s * sides[chosen, 0] + t * sides[chosen, 1]
    normals, seen = scene.normals[chosen], np.zeros(len(points), int)
    for view in survey.views:
        pixels = view.camera.project(view.enu_from_cam.inverse().apply(points))
        size = np.array([view.camera.width, view.camera.height])
        inside = ((pixels > MARGIN_PX) & (pixels < size - MARGIN_PX)).all(axis=1)
        rays = points - view.enu_from_cam.translation
        length = np.linalg.norm(rays, axis=1)
        rows = np.flatnonzero(inside & (-(rays * normals).sum(axis=1) / length > LEAST_SLANT))
        if len(rows):
            hit = scene.cast(view.enu_from_cam.translation, rays[rows]).distances
            seen[rows] += np.abs(hit - 1.0) * length[rows] < 0.05
    return points[seen >= SEEN_BY]


def in_truth(run: Path, points: Float, survey: Survey) -> Float:
    """Return points of the run's CRS in the frame of the survey, by the similarity that fits its cameras."""
    geo = json.loads((run / "report.json").read_text(encoding="utf-8"))["georeference"]
    world = WorldFrame(geo["crs"], geo["vertical"], survey.origin)
    poses = read_trajectory_csv(run / "trajectory.csv")
    true = {view.name: view.enu_from_cam.translation for view in survey.views}
    rows = [row for row, name in enumerate(poses.names) if name in true]
    centres = np.array([true[poses.names[row]] for row in rows])
    fit = weighted_similarity(world.to_enu(poses.centres)[rows], centres, np.ones(len(rows)))
    return fit.apply(world.to_enu(points))


def main() -> None:
    """Print one block per run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--cloud", type=Path, help="LAS, LAZ or NPZ (array P) in the CRS of the run")
    parser.add_argument("--option", action="append", default=[], help="NAME=VALUE of the simulated survey")
    parser.add_argument("--first", type=int, help="only the first photographs of the survey took part")
    given = parser.parse_args()
    values = {name: json.loads(value) for name, _, value in (text.partition("=") for text in given.option)}
    survey = plan_survey(SurveyOptions(**values))
    survey = replace(survey, views=survey.views[: given.first])
    assert isinstance(survey.origin, EnuFrame)
    gsd = survey.options.altitude_m / survey.views[0].camera.fx
    rng = np.random.default_rng(0)
    surface = {name: samples(survey, material, rng) for name, material in KINDS}
    for run in given.runs:
        path = given.cloud or next(run / name for name in ("cloud.laz", "cloud.las") if (run / name).exists())
        if path.suffix == ".npz":
            points = np.load(path)["P"]
        else:
            cloud = laspy.read(path)
            points = np.column_stack([cloud.x, cloud.y, cloud.z])
        points = in_truth(run, points, survey)
        tree = cKDTree(points)
        print(f"{path}: {len(points)} points, GSD {gsd:.3f} m")
        for name, wanted in surface.items():
            distance = tree.query(wanted)[0]
            print(f"  {name:6} complete at 1/2 GSD {(distance < gsd).mean():.3f} {(distance < 2 * gsd).mean():.3f}")
        errors = survey.scene.distance_to_surface(
            points[rng.choice(len(points), min(ERROR_SAMPLES, len(points)), False)]
        )
        print(
            f"  error mean {errors.mean():.3f} m, median {np.median(errors):.3f}, p99 {np.percentile(errors, 99):.3f}, "
            f"largest {errors.max():.2f}; beyond 1 m {(errors > 1.0).mean():.5f}"
        )


if __name__ == "__main__":
    main()
