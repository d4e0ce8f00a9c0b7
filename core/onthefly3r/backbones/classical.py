"""The classical backbone: local features, incremental structure from motion of the subset, dense stereo; no network.

It stands behind the same contract as the neural models (Eq. 1): it sees only its subset, and answers in a frame
and scale of its own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..adjust.selfcal import IntrinsicsPrior, self_calibrate
from ..adjust.sparse_model import SparseModel
from ..features.extraction import FeatureStore
from ..features.matching import PairMatcher
from ..geometry.camera import Camera, PixelMap
from ..options import BackboneOptions
from ..records import Features, LocalModel, LocalView, Observations, Rejection, Subset, WorkingImage
from .base import BackboneSpec
from .dense import dense_views, sparse_view
from .local_sfm import local_sfm

MIN_IMAGES_TO_CALIBRATE = 8  # fewer cannot tell focal length from depth: the prior is held


class ClassicalBackbone:
    """RootSIFT, pycolmap's incremental mapper and rectified stereo on the processor."""

    def __init__(self, options: BackboneOptions, features: FeatureStore | None = None) -> None:
        self.spec = BackboneSpec("classical", "1", "GPL-2.0-or-later", confidence_threshold=0.5)
        self._options = options
        self._threads = options.threads or os.cpu_count() or 1
        if features is None:
            self._scratch = tempfile.TemporaryDirectory(prefix="onthefly3r-")
            features = FeatureStore(Path(self._scratch.name), options.features, options.threads)
        self._features = features
        self._matcher = PairMatcher(self._threads)
        self._thorough_matcher = PairMatcher(self._threads, thorough=True)  # of subsets that are tried harder
        self._checkpoint: Callable[[], None] = lambda: None

    def interrupt_with(self, checkpoint: Callable[[], None]) -> None:
        """Call `checkpoint` between pairs, between images and between the steps of a subset."""
        self._checkpoint = checkpoint

    def extract_features(self, images: Mapping[int, WorkingImage]) -> None:
        """Extract the local features of new images, all at once."""
        self._features.extract(images)

    def features_of(self, index: int, image: WorkingImage) -> Features:
        """Return the local features of an image, extracted on first demand; retrieval uses the same ones."""
        return self._features.features_of(index, image)

    def reconstruct(
        self, subset: Subset, images: Mapping[int, WorkingImage], calibrations: Mapping[str, Camera]
    ) -> LocalModel | Rejection:
        """Rebuild the subset: sparse points for all images, dense point maps for the new ones.

        A subset that asks for effort gets twice as many features and a thorough comparison of all pairs.
        """
        members = subset.members
        store = self._features.more() if subset.effort else self._features
        matcher = self._thorough_matcher if subset.effort else self._matcher
        features = {i: store.features_of(i, images[i]) for i in members}
        keys = {i: images[i].shot.camera_key for i in members}
        cameras = {keys[i]: _working_camera(images[i], calibrations) for i in members}
        held = frozenset(key for key in cameras if key in calibrations)
        matches = matcher.match(
            features,
            {i: cameras[keys[i]] for i in members},
            {i: keys[i] in held for i in members},
            members,
            self._checkpoint,
        )
        model = local_sfm(features, keys, cameras, held, matches, self._checkpoint)
        self._checkpoint()
        if model is None:
            verified = sum(len(found) > 0 for found in matches.values())
            numbers = {"images": float(len(members)), "verified_pairs": float(verified)}
            return Rejection(subset.new, "backbone", "too little overlap to reconstruct the subset", numbers)
        if not held >= set(cameras) and len(model.local_from_cam) >= MIN_IMAGES_TO_CALIBRATE:
            model = self._calibrate(model, features, keys, images, cameras, held)
            self._checkpoint()
        return self._to_local_model(model, subset, images, features, keys, calibrations)

    def _calibrate(
        self,
        model: SparseModel,
        features: Mapping[int, Features],
        keys: Mapping[int, str],
        images: Mapping[int, WorkingImage],
        cameras: Mapping[str, Camera],
        held: frozenset[str],
    ) -> SparseModel:
        sigma = {keys[i]: images[i].shot.focal_ratio_sigma for i in model.local_from_cam}
        priors = {key: IntrinsicsPrior(cameras[key], sigma[key]) for key in sigma if key not in held}
        return self_calibrate(model, features, keys, priors, held, self._options.principal_point).model

    def _to_local_model(
        self,
        model: SparseModel,
        subset: Subset,
        images: Mapping[int, WorkingImage],
        features: Mapping[int, Features],
        keys: Mapping[int, str],
        calibrations: Mapping[str, Camera],
    ) -> LocalModel:
        placed = model.local_from_cam
        grids = {i: _grid_size(images[i], self._options.dense_px) for i in placed}
        new = [i for i in subset.new if i in placed]
        rgb = {i: images[i].rgb for i in placed}
        dense = dense_views(new, rgb, model, keys, features, grids, threads=self._threads, checkpoint=self._checkpoint)
        views = {}
        for index in placed:
            found = dense.get(index) or sparse_view(index, model, keys, features[index], grids[index])
            width, height = grids[index]
            shot = images[index].shot
            views[index] = LocalView(
                camera=model.cameras[keys[index]].resized(width, height),
                grid_from_photo=PixelMap(width / shot.width_px, height / shot.height_px),
                local_from_cam=placed[index],
                points=found.points,
                confidence=found.confidence,
                recurring=found.sparse,  # keypoints are triangulated anew, references get no stereo
            )
        calibrated = {
            keys[i]: model.cameras[keys[i]].resized(images[i].shot.width_px, images[i].shot.height_px)
            for i in placed
            if keys[i] not in calibrations
        }
        notes = {"reprojection_px": model.mean_reprojection_px, "sparse_points": float(len(model.points))}
        observations = _observations(model, images, features)
        return LocalModel(views, calibrations=calibrated, observations=observations, notes=notes)


def _observations(
    model: SparseModel, images: Mapping[int, WorkingImage], features: Mapping[int, Features]
) -> Observations:
    tracks = [(index, track) for index, track in sorted(model.tracks.items()) if index in model.local_from_cam]
    pixels = [
        images[index].working_from_photo.inverse().apply(features[index].pixels[track.features].astype(float))
        for index, track in tracks
    ]
    return Observations(
        image=np.concatenate([np.full(len(track.points), index, np.int32) for index, track in tracks]),
        feature=np.concatenate([track.features for _, track in tracks]).astype(np.int32),
        pixel=np.concatenate(pixels).astype(np.float32),
        point=np.concatenate([track.points for _, track in tracks]).astype(np.int32),
        points=model.points.astype(np.float32),
    )


def _working_camera(image: WorkingImage, calibrations: Mapping[str, Camera]) -> Camera:
    height, width = image.rgb.shape[:2]
    known = calibrations.get(image.shot.camera_key)
    return known.resized(width, height) if known else replace(image.prior_camera, width=width, height=height)


def _grid_size(image: WorkingImage, longest_px: int) -> tuple[int, int]:
    height, width = image.rgb.shape[:2]
    factor = min(1.0, longest_px / max(height, width))
    return max(1, round(width * factor)), max(1, round(height * factor))
