"""The numbers of the paper "On-the-Fly3R", table by table, so that measured ones can stand beside them.

Tables are cited by their label in the paper's source. ATE, Acc., Comp. and CD are in metres unless said otherwise, ARE,
RTE and RRE in degrees. None means that the method failed, OOM that it ran out of GPU memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

OOM = math.inf
OUTDOOR = {"HAV": 424, "SMBU": 563, "SZIT": 1215, "SZTU": 1500, "Residence": 2582, "Campus": 5871}  # images
INDOOR = ("Chess", "Fire", "Heads", "Office", "Pumpkin", "Kitchen", "Stairs")

# tab:pose_per_scene: ATE in each scene of OUTDOOR, then pose coverage in per cent over all images.
POSE_PER_SCENE: dict[str, tuple[float | None, ...]] = {
    "LingBot-Map": (180.43, 135.55, 295.06, 176.75, 73.04, 404.43, 100.0),
    "StreamVGGT": (263.77, 269.3, 384.35, 470.77, 134.32, 499.33, 100.0),
    "CUT3R": (210.17, 260.63, 365.24, 461.85, 133.19, 480.23, 100.0),
    "TTT3R": (123.59, 207.09, 313.12, 468.26, 115.58, 458.93, 100.0),
    "Scal3R": (51.21, 40.77, 168.44, 211.59, 44.76, 349.0, 100.0),
    "VGGT-SLAM": (115.28, 103.24, 87.25, 241.94, 16.49, 470.09, 100.0),
    "VGGT-Long": (54.16, 185.47, 166.04, 367.1, 44.38, 336.06, 100.0),
    "TALO": (None, None, None, None, 103.92, None, 21.24),
    "FastVGGT": (OOM, OOM, OOM, OOM, OOM, OOM, 0.0),
    "InfiniteVGGT": (216.15, 167.83, 310.41, 382.03, OOM, OOM, 30.46),
    "MERG3R": (50.02, 9.8, 145.13, 55.33, 5.74, 492.95, 100.0),
    "On-the-Fly3R (Pi3)": (7.73, 17.22, 23.72, 47.18, 3.28, 42.29, 89.81),
    "On-the-Fly3R (Pi3x)": (4.2, 14.47, 29.27, 28.82, 1.65, 32.95, 95.39),
    "On-the-Fly3R (VGGT-Omega)": (3.64, 93.54, 5.22, 97.46, 1.25, 16.0, 96.26),
}

# tab:pose_macro: means over the six scenes on the frames that On-the-Fly3R (Pi3x) accepted: ATE, ARE, RTE, RRE.
POSE_MACRO: dict[str, tuple[float, float, float, float]] = {
    "LingBot-Map": (205.62, 26.02, 43.01, 5.76),
    "StreamVGGT": (328.54, 126.41, 74.52, 15.81),
    "CUT3R": (311.52, 88.16, 46.25, 13.29),
    "TTT3R": (270.91, 47.44, 48.32, 13.81),
    "Scal3R": (142.88, 29.23, 18.11, 3.01),
    "VGGT-SLAM": (187.12, 29.22, 22.78, 6.49),
    "VGGT-Long": (187.88, 50.1, 22.78, 8.2),
    "MERG3R": (124.42, 26.29, 54.11, 22.89),
    "On-the-Fly3R (Pi3x)": (18.56, 2.78, 10.85, 1.52),
}

# tab:seven_scenes: ATE in centimetres in each scene of INDOOR (sequence 01, every fifth frame), then their mean.
SEVEN_SCENES: dict[str, tuple[float, ...]] = {
    "LingBot-Map": (3.93, 3.49, 3.16, 10.48, 13.82, 5.49, 14.39, 7.82),
    "StreamVGGT": (59.49, 56.65, 26.45, 50.79, 56.66, 40.66, 79.3, 52.86),
    "CUT3R": (59.51, 9.72, 19.09, 32.03, 38.64, 20.98, 31.73, 30.24),
    "TTT3R": (7.63, 4.48, 5.42, 11.31, 18.3, 7.1, 8.23, 8.93),
    "Scal3R": (4.81, 3.29, 1.79, 10.4, 14.09, 5.48, 1.95, 5.97),
    "VGGT-SLAM": (4.0, 2.8, 3.66, 9.53, 15.08, 5.0, 2.17, 6.04),
    "VGGT-Long": (4.93, 3.2, 2.18, 9.41, 14.86, 4.51, 4.49, 6.23),
    "TALO": (30.3, 7.68, 4.11, 13.71, 14.84, 3.97, 2.58, 11.03),
    "FastVGGT": (4.09, 3.18, 1.91, 11.24, 15.43, 5.55, 3.4, 6.4),
    "InfiniteVGGT": (7.4, 3.5, 4.56, 14.75, 14.08, 8.61, 30.09, 11.86),
    "MERG3R": (3.84, 2.63, 1.85, 8.29, 13.94, 3.91, 2.76, 5.32),
    "On-the-Fly3R (Pi3)": (3.9, 3.38, 3.8, 8.19, 13.42, 3.38, 2.95, 5.57),
    "On-the-Fly3R (Pi3x)": (4.04, 3.73, 3.55, 8.11, 14.23, 3.33, 2.38, 5.62),
    "On-the-Fly3R (VGGT-Omega)": (1.64, 2.02, 1.72, 2.38, 4.8, 1.97, 1.58, 2.3),
}


@dataclass(frozen=True)
class Geometry:
    """A row of tab:geometry_efficiency: cloud errors and time are means over the completed scenes, memory the peak."""

    scenes: str
    accuracy: float
    completeness: float
    chamfer: float
    s_per_frame: float
    peak_gpu_gb: float


GEOMETRY_EFFICIENCY = {
    "LingBot-Map": Geometry("6/6", 18.12, 18.02, 18.07, 0.382, 18.4),
    "StreamVGGT": Geometry("5/6", 47.8, 46.24, 47.02, 0.787, 13.78),
    "CUT3R": Geometry("6/6", 37.78, 57.84, 47.81, 0.776, 3.58),
    "TTT3R": Geometry("6/6", 30.8, 41.84, 36.32, 0.725, 6.2),
    "Scal3R": Geometry("6/6", 20.39, 30.68, 25.54, 2.272, 14.38),
    "VGGT-SLAM": Geometry("6/6", 17.07, 9.81, 13.44, 1.602, 21.46),
    "VGGT-Long": Geometry("6/6", 19.64, 18.31, 18.97, 2.328, 19.87),
    "MERG3R": Geometry("6/6", 24.69, 8.12, 16.41, 0.959, 16.36),
    "On-the-Fly3R (Pi3)": Geometry("6/6", 5.47, 5.77, 5.62, 0.736, 9.9),
    "On-the-Fly3R (Pi3x)": Geometry("6/6", 4.47, 3.22, 3.85, 0.814, 17.56),
    "On-the-Fly3R (VGGT-Omega)": Geometry("6/6", 7.26, 2.44, 4.85, 0.723, 9.9),
}

# tab:vfm_comparison, 58 images: ATE in SZIT and Residence, CD in SZIT and Residence, by backbone and mode.
VFM_COMPARISON = {
    ("MapAnything", "Vanilla"): (5.73, 3.62, 1.9, 1.82),
    ("MapAnything", "On-the-Fly3R"): (5.68, 2.42, 2.24, 2.14),
    ("Pi3", "Vanilla"): (3.38, 1.92, 1.41, 1.79),
    ("Pi3", "On-the-Fly3R"): (7.81, 2.3, 2.5, 2.02),
    ("Pi3x", "Vanilla"): (2.17, 1.34, 1.32, 1.33),
    ("Pi3x", "On-the-Fly3R"): (3.17, 1.2, 1.63, 1.35),
    ("VGGT", "Vanilla"): (5.88, 8.46, 1.81, 2.6),
    ("VGGT", "On-the-Fly3R"): (3.6, 2.56, 1.74, 1.5),
    ("VGGT-Omega", "Vanilla"): (2.19, 1.74, 1.47, 1.34),
    ("VGGT-Omega", "On-the-Fly3R"): (2.11, 1.13, 1.61, 1.21),
}


@dataclass(frozen=True)
class Ablation:
    """A case of tab:ablation: what is switched on, and ATE, ARE, RTE, RRE in two scenes."""

    dynamic_batching: bool
    validation_and_retry: bool
    pose_graph: bool
    hav: tuple[float, float, float, float]
    residence: tuple[float, float, float, float]


ABLATION = {
    1: Ablation(False, False, False, (208.76, 85.49, 37.03, 43.009), (3.37, 0.9, 7.63, 0.516)),
    2: Ablation(True, False, False, (193.51, 60.14, 24.03, 30.97), (2.4, 0.81, 4.11, 0.344)),
    3: Ablation(False, True, False, (30.94, 10.34, 19.4, 13.291), (3.2, 0.83, 7.43, 0.348)),
    4: Ablation(True, True, False, (4.51, 1.57, 8.4, 0.59), (2.34, 0.79, 4.1, 0.337)),
    5: Ablation(True, True, True, (3.64, 1.18, 10.03, 0.68), (1.25, 0.52, 1.58, 0.22)),
}
