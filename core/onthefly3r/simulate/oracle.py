"""A backbone and a descriptor that answer from the truth, with stated noise and faults on request.

They let every later stage be tested fast and against known errors. All lengths of the noise are stated for a
flying height of 100 m and grow with it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..backbones.base import BackboneSpec
from ..geometry.arrays import Float
from ..geometry.camera import Camera, PixelMap
from ..geometry.transforms import Rigid3, Sim3, rotation_exp
from ..records import LocalModel, LocalView, Rejection, Shot, Subset, WorkingImage
from .bends import BEND_FORMS, Bend, BendForm
from .flight import Survey, SurveyOptions, TrueView, plan_survey
from .landscape import BLOCK_SIZE_M

GRID_SIDE_PX = 224  # longest side of the point maps
STATED_ALTITUDE_M = 100.0
CACHED_DEPTH_MAPS = 600  # about 150 KB each
TOKEN_LENGTH = 64
CAMERA_KEY = "simulated"
REPEATED, BAD_PHOTOGRAPHS = 13, 17  # streams of random numbers beside the one of each call
COVISIBLE_WIDTHS = 0.6  # views whose footprints are less than so many widths apart see enough of the same ground


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a local model's errors; rotation and position are root mean squares of the length."""

    rotation_deg: float = 0.15
    position_m: float = 0.3
    depth: float = 0.002  # relative, once per pixel and once per image
    log_scale: float = 0.10
    bend_m: float = 0.0  # sag at one flying height from the middle, up or down; grows with the square of the extent
    bend_form: BendForm = "bowl"
    third_order_m: float = 0.0  # rise at one flying height in a direction drawn anew; grows with the cube of the extent
    repeated: float = 0.0  # share of the variance of a view's camera and depth error that is the same in every call
    confidence: Literal["honest", "flat", "inverted"] = "honest"  # flat tells nothing; inverted praises what is worst


@dataclass(frozen=True)
class Faults:
    """What goes wrong beyond noise; a bad view is 30 degrees and 40 m off, together with its points."""

    bad_references: int = 0  # so many in an affected subset
    bad_reference_rate: float = 0.0  # share of subsets affected
    bad_queries: int = 1
    bad_query_rate: float = 0.0
    in_seed: bool = False  # subsets without references are affected too
    bad_view_rate: float = 0.0  # chance of every view of every subset to be bad, whatever its role
    bad_photograph_rate: float = 0.0  # share of the survey's photographs that are bad in every subset
    strays: bool = False  # views that share no ground with the main group are put into its middle, or block on block
    doming_m: float = 0.0  # sag of every local model at one flying height from its middle
    rotation_deg: float = 30.0
    position_m: float = 40.0


class OracleBackbone:
    """Phi (Eq. 1) from the truth: point maps are ray-cast from the true cameras, then spoilt as stated.

    Each call draws anew from (seed, call number): the same subset is answered differently the next time.
    """

    def __init__(
        self,
        survey: Survey,
        noise: Noise | None = None,
        faults: Faults | None = None,
        seed: int = 0,
        tokens: bool = False,
        grid_side_px: int = GRID_SIDE_PX,
    ) -> None:
        self.spec = BackboneSpec("oracle", "1", "GPL-2.0-or-later", confidence_threshold=0.5, has_tokens=tokens)
        self.calls = 0
        self._survey = survey
        self._noise = noise or Noise()
        self._faults = faults or Faults()
        self._seed = seed
        self._grid = grid_camera(survey.views[0].camera, grid_side_px)
        self._unit_m = survey.options.altitude_m / STATED_ALTITUDE_M
        self._depths: OrderedDict[int, Float] = OrderedDict()
        shuffled = np.random.default_rng((seed, BAD_PHOTOGRAPHS)).permutation(len(survey.views))
        self.bad_photographs = frozenset(shuffled[: round(self._faults.bad_photograph_rate * len(shuffled))].tolist())

    def reconstruct(
        self, subset: Subset, images: Mapping[int, WorkingImage], calibrations: Mapping[str, Camera]
    ) -> LocalModel | Rejection:
        """Answer a subset in a random frame; shot indices are positions in `survey.views`."""
        rng = np.random.default_rng((self._seed, self.calls))
        self.calls += 1
        bad = self._draw_bad_views(subset, rng)
        moves = self._draw_strays(subset, rng) if self._faults.strays else {}
        centres = np.stack([self._survey.views[i].enu_from_cam.translation for i in subset.members])
        drawn_m = self._noise.bend_m * rng.standard_normal() if self._noise.bend_m else 0.0
        sags_m = self._faults.doming_m * BEND_FORMS["bowl"] + drawn_m * BEND_FORMS[self._noise.bend_form]
        cubic_m = self._noise.third_order_m * rng.standard_normal(2) if self._noise.third_order_m else np.zeros(2)
        bend = Bend(
            centres.mean(axis=0), sags_m * self._unit_m, self._survey.options.altitude_m, cubic_m * self._unit_m
        )
        scale = np.exp(self._noise.log_scale * rng.standard_normal()) / self._survey.options.altitude_m
        local_from_enu = Sim3(float(scale), rotation_exp(_random_rotation(rng)), rng.normal(0.0, 3.0, 3))
        context = _unit(rng.standard_normal(TOKEN_LENGTH))
        views = {
            i: self._view(i, i in bad, bend, local_from_enu @ moves.get(i, Sim3()), context, rng)
            for i in subset.members
        }
        known = {} if CAMERA_KEY in calibrations else {CAMERA_KEY: self._survey.views[0].camera}
        return LocalModel(views, calibrations=known, notes={"bad_views": float(len(bad | moves.keys()))})

    def true_depth(self, index: int) -> Float:
        """Return the z-depth (H, W) float32 in metres of a view's point map, NaN where it sees the sky."""
        if index not in self._depths:
            view, grid = self._survey.views[index], self._grid
            hits = self._survey.scene.view(grid, view.enu_from_cam, grid.pixel_centres())
            self._depths[index] = hits.distances.reshape(grid.height, grid.width).astype(np.float32)
            if len(self._depths) > CACHED_DEPTH_MAPS:
                self._depths.popitem(last=False)
        self._depths.move_to_end(index)
        return self._depths[index]

    def _draw_bad_views(self, subset: Subset, rng: np.random.Generator) -> set[int]:
        faults = self._faults
        hit_references, hit_queries = rng.random(2) < (faults.bad_reference_rate, faults.bad_query_rate)
        bad = set(self.bad_photographs.intersection(subset.members))
        if hit_references:
            count = min(faults.bad_references, len(subset.references))
            bad.update(int(i) for i in rng.permutation(subset.references)[:count])
        if hit_queries and (subset.references or faults.in_seed):
            bad.update(int(i) for i in rng.permutation(subset.new)[: faults.bad_queries])
        if faults.bad_view_rate:
            drawn = rng.random(len(subset.members)) < faults.bad_view_rate
            bad.update(i for i, hit in zip(subset.members, drawn, strict=True) if hit)
        return bad

    def _draw_strays(self, subset: Subset, rng: np.random.Generator) -> dict[int, Sim3]:
        """Return the wrong move (in ENU) of every view outside the main group of views that see the same ground."""
        members = list(subset.members)
        places = np.stack([footprint_centre(self._survey.views[i]) for i in members])
        groups = covisible_groups(places, COVISIBLE_WIDTHS * self._footprint_width_m())
        main = groups[0]
        moves: dict[int, Sim3] = {}
        for group in groups[1:]:
            shift, turn = self._look_alike_shift(places[main], places[group]), np.eye(3)
            if shift is None:  # nothing tells where it belongs
                stray_m = self._faults.position_m * self._unit_m
                shift = places[main].mean(axis=0) - places[group].mean(axis=0) + stray_m * _unit(rng.standard_normal(2))
                turn = np.asarray(rotation_exp(np.radians(self._faults.rotation_deg) * _unit(rng.standard_normal(3))))
            middle = np.append(places[group].mean(axis=0), 0.0)
            moves |= {members[k]: Sim3(1.0, turn, middle - turn @ middle + np.append(shift, 0.0)) for k in group}
        return moves

    def _look_alike_shift(self, main: Float, group: Float) -> Float | None:
        """Return the way (2,) from a block that the group sees to one that the main group sees, None without such."""
        corners = self._survey.scene.blocks
        seen_by_main, seen_by_group = (
            [c for c in corners if np.all((places >= c) & (places < c + BLOCK_SIZE_M), axis=-1).any()]
            for places in (main, group)
        )
        return np.asarray(seen_by_main[0] - seen_by_group[0]) if seen_by_main and seen_by_group else None

    def _footprint_width_m(self) -> float:
        return self._grid.width / self._grid.fx * self._survey.options.altitude_m

    def _view(
        self, index: int, is_bad: bool, bend: Bend, local_from_enu: Sim3, context: Float, rng: np.random.Generator
    ) -> LocalView:
        view, grid = self._survey.views[index], self._grid
        rays = grid.rays(grid.pixel_centres())
        bent_from_cam = bend.apply_to_pose(view.enu_from_cam)
        depth = self.true_depth(index).astype(float)
        if not bend.is_flat:
            bent_points = bend.apply(view.enu_from_cam.apply(depth[..., None] * rays))
            depth = bent_from_cam.inverse().apply(bent_points)[..., 2]
        rotation_deg, position_m = self._noise.rotation_deg, self._noise.position_m * self._unit_m
        error = self._errors(index, depth.shape, rng)
        depth = depth * (1.0 + self._noise.depth * error.pixels) * (1.0 + self._noise.depth * error.depth)
        turn = np.radians(rotation_deg / np.sqrt(3.0)) * error.turn
        shift = position_m / np.sqrt(3.0) * error.shift
        if is_bad:
            turn = turn + np.radians(self._faults.rotation_deg) * _unit(rng.standard_normal(3))
            shift = shift + self._faults.position_m * self._unit_m * _unit(rng.standard_normal(3))
        noisy_from_cam = Rigid3(bent_from_cam.rotation @ rotation_exp(turn), bent_from_cam.translation + shift)
        points = local_from_enu.apply(noisy_from_cam.apply(depth[..., None] * rays)).astype(np.float32)
        confidence = self._confidence(error.pixels, is_bad) + 0.03 * rng.standard_normal(depth.shape)
        confidence = np.where(np.isfinite(depth), np.clip(confidence, 0.0, 1.0), 0.0).astype(np.float32)
        return LocalView(
            camera=grid,
            grid_from_photo=PixelMap(grid.width / view.camera.width, grid.height / view.camera.height),
            local_from_cam=local_from_enu.apply_to_pose(noisy_from_cam),
            points=points,
            confidence=confidence,
            tokens=self._token(context, is_bad, rng) if self.spec.has_tokens else None,
        )

    def _errors(self, index: int, shape: tuple[int, ...], rng: np.random.Generator) -> UnitErrors:
        """Return the errors of a view, partly those that it has in every call."""
        drawn = UnitErrors.draw(shape, rng)
        share = self._noise.repeated
        if not share:
            return drawn
        own = UnitErrors.draw(shape, np.random.default_rng((self._seed, REPEATED, index)))
        fresh, kept = np.sqrt(1.0 - share), np.sqrt(share)
        return UnitErrors(
            fresh * drawn.pixels + kept * own.pixels,
            float(fresh * drawn.depth + kept * own.depth),
            fresh * drawn.turn + kept * own.turn,
            fresh * drawn.shift + kept * own.shift,
        )

    def _confidence(self, pixel_error: Float, is_bad: bool) -> Float:
        """Return confidences (H, W) that follow the error, that tell nothing, or that praise what is worst."""
        honest = 0.95 * np.exp(-0.25 * pixel_error**2)
        if self._noise.confidence == "flat":
            return np.full(pixel_error.shape, 0.8)
        if self._noise.confidence == "inverted":
            return np.full(pixel_error.shape, 0.95) if is_bad else 0.9 - 0.3 * honest
        return np.asarray(honest)

    @staticmethod
    def _token(context: Float, is_bad: bool, rng: np.random.Generator) -> Float:
        """Views of one place share a direction; a bad view's token is turned away from it (cosine about 0.6)."""
        stray = _unit(rng.standard_normal(TOKEN_LENGTH))
        return np.asarray(_unit(context + (1.3 if is_bad else 0.2) * stray), np.float32)


@dataclass(frozen=True, eq=False)
class UnitErrors:
    """Errors of one view in standard deviations."""

    pixels: Float  # (H, W) of the depths
    depth: float  # of all depths alike
    turn: Float  # (3,)
    shift: Float  # (3,)

    @classmethod
    def draw(cls, shape: tuple[int, ...], rng: np.random.Generator) -> UnitErrors:
        """Draw them all anew."""
        return cls(rng.standard_normal(shape), rng.standard_normal(), rng.standard_normal(3), rng.standard_normal(3))


class OracleDescriber:
    """Descriptors whose cosine follows the ground distance of the footprints: exp(-d^2 / (2 bandwidth^2)).

    Random Fourier features of the place where the optical axis meets the ground, a little of the heading, and
    noise. In look-alike blocks a second term depends only on the place within the block, with `confusion`.
    """

    def __init__(
        self,
        survey: Survey,
        bandwidth: float = 0.5,  # in footprint widths
        noise: float = 0.15,  # length of the noise relative to the descriptor
        confusion: float = 0.8,
        length: int = 512,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng((seed, 7))
        camera, altitude_m = survey.views[0].camera, survey.options.altitude_m
        self._survey = survey
        self._bandwidth_m = bandwidth * camera.width / camera.fx * altitude_m
        self._frequencies = rng.standard_normal((length, 2)) / self._bandwidth_m
        self._phases = rng.uniform(0.0, 2.0 * np.pi, length)
        self._noise, self._confusion, self._seed = noise, confusion, seed

    def fit(self, images: Mapping[int, WorkingImage]) -> None:
        """Nothing is learnt."""

    def describe(self, index: int, image: WorkingImage) -> Float:
        """Return the descriptor (D,) float32 of a view; the pixels are not looked at."""
        view = self._survey.views[index]
        place = footprint_centre(view)
        vector = self._features(place)
        for corner in self._survey.scene.blocks:
            offset = place - corner
            nearness = np.exp(-0.5 * float(np.sum((offset - BLOCK_SIZE_M / 2) ** 2)) / self._bandwidth_m**2)
            vector = vector + self._confusion * nearness * self._features(-offset)
        yaw = np.radians(view.attitude.yaw_deg)
        vector = np.append(_unit(vector), 0.25 * np.array([np.cos(yaw), np.sin(yaw)]))
        rng = np.random.default_rng((self._seed, 11, index))
        return np.asarray(_unit(_unit(vector) + self._noise * _unit(rng.standard_normal(len(vector)))), np.float32)

    def _features(self, place: Float) -> Float:
        return np.asarray(np.sqrt(2.0 / len(self._phases)) * np.cos(self._frequencies @ place + self._phases))


def footprint_centre(view: TrueView) -> Float:
    """Return where the optical axis meets the mean ground (2,) east, north in metres."""
    axis, centre = view.enu_from_cam.rotation[:, 2], view.enu_from_cam.translation
    return np.asarray(centre[:2] - axis[:2] * centre[2] / min(axis[2], -0.2))


def covisible_groups(places: Float, reach_m: float) -> list[list[int]]:
    """Return the rows of footprint centres (N, 2) in groups linked by distances below `reach_m`, largest first."""
    near = np.linalg.norm(places[:, None] - places[None], axis=-1) < reach_m
    group = np.arange(len(places))
    while True:  # every view takes the lowest number among its neighbours until nothing changes
        lowest = np.where(near, group, len(places)).min(axis=1)
        if np.array_equal(lowest, group):
            break
        group = lowest
    groups = [np.flatnonzero(group == number).tolist() for number in np.unique(group)]
    return sorted(groups, key=len, reverse=True)


def grid_camera(camera: Camera, side_px: int = GRID_SIDE_PX) -> Camera:
    """Return the camera of the point maps with so many pixels on the longest side."""
    ratio = side_px / max(camera.width, camera.height)
    return camera.resized(round(camera.width * ratio), round(camera.height * ratio))


def oracle_shots(survey: Survey) -> list[Shot]:
    """Return the shots of a survey as intake would, without files."""
    shots = []
    for view in survey.views:
        camera = view.camera
        shots.append(
            Shot(
                name=view.name,
                path=Path(view.name),
                width_px=camera.width,
                height_px=camera.height,
                camera_key=CAMERA_KEY,
                focal_ratio=camera.fx / max(camera.width, camera.height),
                focal_ratio_sigma=0.02,
                focal_source="exif 35 mm",
                time_s=view.time_s,
                gps=view.gps,
                attitude=view.attitude,
            )
        )
    return shots


def oracle_images(survey: Survey, side_px: int = GRID_SIDE_PX) -> dict[int, WorkingImage]:
    """Return grey images of the point maps' size by shot index, so that an engine runs without rendering."""
    grid = grid_camera(survey.views[0].camera, side_px)
    grey = np.full((grid.height, grid.width, 3), 128, np.uint8)
    images = {}
    for index, shot in enumerate(oracle_shots(survey)):
        images[index] = WorkingImage(shot, grey, PixelMap(grid.width / shot.width_px, grid.height / shot.height_px))
    return images


def scenario(images: int, strips: int, seed: int = 0, look_alike: bool = False) -> Survey:
    """Return a survey of the shape that the method's weaknesses were measured on: 100 m, overlaps 80 and 65 %."""
    return plan_survey(
        SurveyOptions(images=images, strips=strips, altitude_m=STATED_ALTITUDE_M, seed=seed, look_alike=look_alike)
    )


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))


def _random_rotation(rng: np.random.Generator) -> Float:
    """Return a rotation vector about a random axis by a random angle."""
    return np.asarray(rng.uniform(0.0, np.pi) * _unit(rng.standard_normal(3)))
