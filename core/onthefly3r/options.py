"""Every option of the engine, one frozen slice per stage: the single source of names, defaults, units and help.

The command line, the Python interface and the QGIS dialogs are all built from these fields.
Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_type_hints

from .errors import OptionError

Preset = Literal["default", "paper"]


def option(
    default: Any,
    help: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    minimum: float | None = None,
    maximum: float | None = None,
    advanced: bool = False,
) -> Any:
    """Declare one option: `unit` and the bounds appear in every user interface and are checked."""
    metadata = {
        "help": help,
        "unit": unit,
        "choices": choices,
        "minimum": minimum,
        "maximum": maximum,
        "advanced": advanced,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class IntakeOptions:
    """Which photographs are read, and how."""

    recursive: bool = option(True, "look for photographs in sub-folders too")
    min_side_px: int = option(200, "photographs with a shorter side are refused", unit="px", minimum=16, advanced=True)
    focal_35mm: float | None = option(
        None, "35-mm equivalent focal length; replaces what the EXIF tags say", unit="mm", minimum=1.0, advanced=True
    )
    limit: int | None = option(None, "use only the first photographs in capture order", unit="images", minimum=1)
    shuffle_seed: int | None = option(
        None, "feed the photographs in a random order drawn from this seed", minimum=0, advanced=True
    )


@dataclass(frozen=True)
class SelectionOptions:
    """Seed, retrieval and dynamic subsets (paper Sec. III-B and III-C)."""

    seed_size: int = option(30, "images of the first joint reconstruction (N0)", unit="images", minimum=3)
    batching: Literal["dynamic", "fixed"] = option(
        "dynamic",
        "dynamic builds subsets by retrieval; fixed takes the images as they arrive, with the last placed ones as "
        "references (the paper's ablation)",
        choices=("dynamic", "fixed"),
        advanced=True,
    )
    batch_size: int = option(5, "most new images in one subset (B_max)", unit="images", minimum=1)
    references: int = option(5, "references retrieved per image (k_r)", unit="images", minimum=3)
    subset_references: int = option(8, "most references in one subset (R_k)", unit="images", minimum=3)
    min_shared_references: int = option(
        2, "references an image must share with the batch it joins (tau_o)", unit="images", minimum=0, advanced=True
    )
    min_similarity: float = option(
        0.0,
        "similarity to the batch that an image must reach to join it (tau_s)",
        minimum=-1.0,
        maximum=1.0,
        advanced=True,
    )
    lookahead: int = option(
        40,
        "waiting images among which a batch may be filled; 1 keeps the strict arrival order",
        unit="images",
        minimum=1,
        advanced=True,
    )
    gps_candidates: bool = option(
        True, "let GPS positions propose reference candidates (they never decide)", advanced=True
    )
    descriptor: Literal["vlad", "efficientnet", "supscene", "megaloc"] = option(
        "vlad",
        "what images are compared by: vlad needs nothing further, the others are neural networks",
        choices=("vlad", "efficientnet", "supscene", "megaloc"),
        advanced=True,
    )
    descriptor_weights: str | None = option(
        None, "weights of supscene or megaloc: a file, a folder, or a hub id with its revision", advanced=True
    )


@dataclass(frozen=True)
class BackboneOptions:
    """The frozen local reconstructor."""

    backbone: str = option("classical", "local reconstructor")
    working_px: int = option(
        1000, "longest side to which photographs are reduced for reconstruction", unit="px", minimum=200, maximum=8000
    )
    features: int = option(2500, "most local features per image", unit="features", minimum=200, advanced=True)
    dense_px: int = option(500, "longest side of the dense point maps", unit="px", minimum=64, maximum=8000)
    principal_point: bool = option(
        False,
        "estimate the principal point of the cameras too; it is held in the middle of the image otherwise, as COLMAP "
        "does by default",
        advanced=True,
    )
    threads: int = option(0, "processor cores to use; 0 takes all", unit="cores", minimum=0)
    weights: str | None = option(
        None, "weights of a neural backbone: a file, a folder, or a hub id with its revision (owner/name@revision)"
    )
    device: Literal["auto", "cuda", "mps", "cpu"] = option(
        "auto",
        "where neural networks run; auto takes the GPU where there is one",
        choices=("auto", "cuda", "mps", "cpu"),
    )
    max_gpu_memory_gib: float | None = option(
        None, "most GPU memory a neural backbone may take; default: all of it", unit="GiB", minimum=0.5, advanced=True
    )


@dataclass(frozen=True)
class RegistrationOptions:
    """Alignment, validation, rejection and retry (paper Sec. III-D and III-E)."""

    min_references: int = option(3, "fewest references that must agree", unit="images", minimum=1, advanced=True)
    reference_points: int = option(
        2000, "compact reference points kept per image (P_i)", unit="points", minimum=50, advanced=True
    )
    alpha: float = option(
        50.0, "largest reference shift in scene spacings (tau_t = alpha * l_scene)", minimum=1.0, advanced=True
    )
    max_rotation_deg: float = option(
        10.0, "largest rotation of a reference camera against the map", unit="deg", minimum=0.1, advanced=True
    )
    max_scale_ratio: float = option(
        2.0, "largest factor by which a subset's scale may differ from the expected one", minimum=1.01, advanced=True
    )
    validation: bool = option(
        True, "check every subset before it may touch the map, drop bad references, retry (V&R)", advanced=True
    )
    reference_gate: float = option(
        6.0,
        "a reference is also bad when it is shifted by so many medians of the references' shifts; 0 switches it off",
        minimum=0.0,
        advanced=True,
    )
    validate_queries: bool = option(True, "check new images against the map, not only references", advanced=True)
    gps_check: bool = option(
        True, "ask for a second reconstruction of an image that lands far from its GPS position", advanced=True
    )
    max_retries: int = option(3, "how often a rejected image is tried again", unit="times", minimum=0, advanced=True)


@dataclass(frozen=True)
class PoseGraphOptions:
    """Drift removal (paper Sec. III-F)."""

    pose_graph: Literal["sim3", "se3", "none"] = option(
        "sim3",
        "sim3 moves submaps and frames with their points, se3 is the paper's frame graph, none switches it off",
        choices=("sim3", "se3", "none"),
        advanced=True,
    )
    gps_priors: bool = option(
        True, "let GPS positions keep a large map from bending, as far as they are accurate (sim3 only)", advanced=True
    )
    refine: bool = option(
        True,
        "adjust all cameras and their intrinsics together at the end, where the local reconstructor matches features",
        advanced=True,
    )


@dataclass(frozen=True)
class GeoreferenceOptions:
    """From the map to the Earth."""

    crs: str | None = option(None, "projected target CRS, e.g. EPSG:32633; default: UTM zone of the median position")
    vertical: Literal["auto", "ellipsoidal", "egm96", "egm2008"] = option(
        "auto",
        "what the photographs' heights refer to; auto decides from the tags and says so",
        choices=("auto", "ellipsoidal", "egm96", "egm2008"),
    )
    positions: str | None = option(
        None,
        "position file (geo.txt: a CRS, then name x y z per line, perhaps yaw pitch roll in degrees, pitch 0 looks "
        "down); replaces the positions in the tags",
    )
    local: bool = option(False, "write local coordinates without a CRS, in metres where positions tell the scale")
    gps_sigma_h_m: float = option(3.0, "horizontal accuracy of positions without their own", unit="m", minimum=0.001)
    gps_sigma_v_m: float = option(5.0, "vertical accuracy of positions without their own", unit="m", minimum=0.001)


@dataclass(frozen=True)
class ExportOptions:
    """The files in the output folder."""

    cloud: bool = option(True, "write the point cloud; off leaves cameras, footprints, COLMAP model and report")
    format: Literal["laz", "las"] = option("laz", "point cloud format", choices=("laz", "las"))
    spacing_m: float | None = option(
        None,
        "voxel size of the fused cloud; default: the ground sampling distance of the point maps",
        unit="m",
        minimum=0.0001,
    )
    min_confidence: float = option(0.5, "least confidence of an exported point", minimum=0.0, maximum=1.0)
    stray_filter: bool = option(True, "drop isolated points")
    boundary: str | None = option(
        None, "GeoJSON file of polygons (WGS 84 longitude, latitude): points outside them are left out of the cloud"
    )


@dataclass(frozen=True)
class Options:
    """All options of one run; field names are unique across the slices."""

    preset: Preset = "default"
    intake: IntakeOptions = field(default_factory=IntakeOptions)
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    backbone: BackboneOptions = field(default_factory=BackboneOptions)
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    pose_graph: PoseGraphOptions = field(default_factory=PoseGraphOptions)
    georeference: GeoreferenceOptions = field(default_factory=GeoreferenceOptions)
    export: ExportOptions = field(default_factory=ExportOptions)

    @classmethod
    def from_flat(cls, values: Mapping[str, Any]) -> Options:
        """Build options from `{name: value}`; raises `OptionError` for unknown names and bad values."""
        remaining = dict(values)
        preset = remaining.pop("preset", "default")
        if preset not in get_args(Preset):
            raise OptionError(f"preset: {preset!r} is not one of {', '.join(get_args(Preset))}")
        base = dict(PAPER_VALUES) if preset == "paper" else {}
        base.update(remaining)
        slices: dict[str, Any] = {}
        for slice_name, slice_class in slice_classes().items():
            names = [f.name for f in dataclasses.fields(slice_class)]
            chosen = {name: base.pop(name) for name in names if name in base}
            for name, value in chosen.items():
                _check(slice_class, name, value)
            slices[slice_name] = slice_class(**chosen)
        if base:
            known = ", ".join(sorted(f.name for _, f in iterate_options()))
            raise OptionError(f"unknown option {', '.join(sorted(base))}; known options: {known}")
        return cls(preset=preset, **slices)

    def to_flat(self) -> dict[str, Any]:
        """Return `{name: value}` of all options, the inverse of `from_flat`."""
        flat: dict[str, Any] = {"preset": self.preset}
        for slice_name in slice_classes():
            flat.update(dataclasses.asdict(getattr(self, slice_name)))
        return flat


# What the paper does where our default differs; later improvements switched off.
PAPER_VALUES: dict[str, Any] = {
    "lookahead": 1,
    "subset_references": 5,
    "gps_candidates": False,
    "reference_gate": 0.0,
    "validate_queries": False,
    "gps_check": False,
    "max_retries": 0,
    "reference_points": 5000,
    "pose_graph": "se3",
    "refine": False,
}


def slice_classes() -> dict[str, type]:
    """Return the option slices by their name in `Options`, in order of the pipeline."""
    return {
        "intake": IntakeOptions,
        "selection": SelectionOptions,
        "backbone": BackboneOptions,
        "registration": RegistrationOptions,
        "pose_graph": PoseGraphOptions,
        "georeference": GeoreferenceOptions,
        "export": ExportOptions,
    }


def iterate_options() -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """Yield (slice name, field) of every option, for building user interfaces."""
    for slice_name, slice_class in slice_classes().items():
        for item in dataclasses.fields(slice_class):
            yield slice_name, item


def check(options_slice: Any) -> None:
    """Check every field of an option slice against its type and bounds; raises `OptionError`."""
    for item in dataclasses.fields(options_slice):
        _check(type(options_slice), item.name, getattr(options_slice, item.name))


def _check(slice_class: type, name: str, value: Any) -> None:
    item = next(f for f in dataclasses.fields(slice_class) if f.name == name)
    hint = get_type_hints(slice_class)[name]
    allowed = get_args(hint) or (hint,)
    if value is None:
        if type(None) not in allowed:
            raise OptionError(f"{name}: a value is needed")
        return
    if item.metadata["choices"]:
        if value not in item.metadata["choices"]:
            raise OptionError(f"{name}: {value!r} is not one of {', '.join(item.metadata['choices'])}")
        return
    numeric_float = float in allowed and isinstance(value, int | float) and not isinstance(value, bool)
    exact = any(isinstance(a, type) and type(value) is a for a in allowed)
    if not (numeric_float or exact):
        raise OptionError(f"{name}: {value!r} is not a {' or '.join(getattr(a, '__name__', str(a)) for a in allowed)}")
    low, high = item.metadata["minimum"], item.metadata["maximum"]
    unit = f" {item.metadata['unit']}" if item.metadata["unit"] else ""
    if low is not None and not value >= low:
        raise OptionError(f"{name}: {value} is below the least allowed value {low}{unit}")
    if high is not None and not value <= high:
        raise OptionError(f"{name}: {value} is above the greatest allowed value {high}{unit}")
