"""Every option of the engine, one frozen slice per stage: the single source of names, defaults, units and help.

The command line, the Python interface and the QGIS dialogs are all built from these fields.
Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from .errors import OptionError
from .option_fields import CheckedOptions, option

Preset = Literal["default", "paper"]


@dataclass(frozen=True)
class IntakeOptions(CheckedOptions):
    """Which photographs are read, and how."""

    recursive: bool = option(True, "read the photographs of sub-folders too")
    min_side_px: int = option(
        200, "minimum length of the shorter side; smaller photographs are refused", unit="px", minimum=16, advanced=True
    )
    focal_35mm: float | None = option(
        None,
        "35-mm equivalent focal length; it replaces the value in the EXIF tags",
        unit="mm",
        minimum=1.0,
        maximum=5000.0,
        advanced=True,
        example="24",
    )
    limit: int | None = option(
        None,
        "maximum number of photographs; the first ones in capture order are used",
        unit="images",
        minimum=1,
        example="50",
    )
    shuffle_seed: int | None = option(
        None,
        "seed of a random order in which the photographs are used; default: capture order",
        minimum=0,
        advanced=True,
        example="3",
    )


@dataclass(frozen=True)
class SelectionOptions(CheckedOptions):
    """Seed, retrieval and dynamic subsets (paper Sec. III-B and III-C)."""

    seed_size: int = option(30, "number of images in the first reconstruction (N0)", unit="images", minimum=3)
    batching: Literal["dynamic", "fixed"] = option(
        "dynamic",
        "how subsets are built: dynamic chooses images by their similarity; fixed takes the images in order of "
        "arrival, the first reconstruction included, with the images placed last as references (the paper's ablation)",
        choices=("dynamic", "fixed"),
        advanced=True,
    )
    batch_size: int = option(5, "maximum number of new images in one subset (B_max)", unit="images", minimum=1)
    references: int = option(5, "number of references retrieved for each image (k_r)", unit="images", minimum=3)
    subset_references: int = option(8, "maximum number of references in one subset (R_k)", unit="images", minimum=3)
    min_shared_references: int = option(
        2,
        "minimum number of references that an image shares with the batch that it joins (tau_o)",
        unit="images",
        minimum=0,
        advanced=True,
    )
    min_similarity: float = option(
        0.0,
        "minimum similarity between an image and the batch that it joins (tau_s)",
        minimum=-1.0,
        maximum=1.0,
        advanced=True,
    )
    lookahead: int = option(
        40,
        "number of waiting images from which a batch is chosen; 1 keeps the order of arrival, from the first "
        "reconstruction on",
        unit="images",
        minimum=1,
        advanced=True,
    )
    gps_candidates: bool = option(True, "use GPS positions to propose references; the images decide", advanced=True)
    descriptor: Literal["vlad", "efficientnet", "supscene", "megaloc"] = option(
        "vlad",
        "descriptor that images are compared by: vlad needs no download, the others are neural networks",
        choices=("vlad", "efficientnet", "supscene", "megaloc"),
        advanced=True,
    )
    descriptor_weights: str | None = option(
        None,
        "weights of supscene or megaloc: a file, a folder, or a hub id with its revision",
        advanced=True,
        example="megaloc.safetensors",
    )

    @property
    def in_order(self) -> bool:
        """Whether the map begins with the first images and takes the others as they arrive, as in the paper."""
        return self.batching == "fixed" or self.lookahead == 1


@dataclass(frozen=True)
class BackboneOptions(CheckedOptions):
    """The frozen local reconstructor."""

    backbone: str = option(
        "classical", "local reconstructor; the command `backbones` lists all of them", example="vggt"
    )
    working_px: int = option(
        1000,
        "length of the longer side to which photographs are reduced for the reconstruction",
        unit="px",
        minimum=200,
        maximum=8000,
    )
    features: int = option(
        2500, "maximum number of local features per image", unit="features", minimum=200, advanced=True
    )
    dense_px: int = option(
        500, "length of the longer side of the dense point maps", unit="px", minimum=64, maximum=8000
    )
    principal_point: Literal["auto", "free", "held"] = option(
        "auto",
        "the principal point of the cameras: auto estimates it where the photographs tell it and holds it in the "
        "middle of the image where they do not, free always estimates it, held never",
        choices=("auto", "free", "held"),
        advanced=True,
    )
    threads: int = option(0, "number of processor cores; 0 uses all", unit="cores", minimum=0)
    weights: str | None = option(
        None,
        "weights of a neural backbone: a file, a folder, or a hub id with its revision",
        example="owner/name@revision",
    )
    device: Literal["auto", "cuda", "mps", "cpu"] = option(
        "auto",
        "device that neural networks run on; auto uses the GPU if there is one",
        choices=("auto", "cuda", "mps", "cpu"),
    )
    max_gpu_memory_gib: float | None = option(
        None,
        "maximum GPU memory of a neural backbone; default: all of it",
        unit="GiB",
        minimum=0.5,
        advanced=True,
        example="6",
    )


@dataclass(frozen=True)
class RegistrationOptions(CheckedOptions):
    """Alignment, validation, rejection and retry (paper Sec. III-D and III-E)."""

    min_references: int = option(
        3, "minimum number of references that must agree", unit="images", minimum=1, advanced=True
    )
    reference_points: int = option(
        2000, "number of compact reference points per image (P_i)", unit="points", minimum=50, advanced=True
    )
    alpha: float = option(
        50.0, "maximum shift of a reference, in scene spacings (tau_t = alpha * l_scene)", minimum=1.0, advanced=True
    )
    max_rotation_deg: float = option(
        10.0, "maximum rotation of a reference camera against the map", unit="deg", minimum=0.1, advanced=True
    )
    max_scale_ratio: float = option(
        2.0, "maximum factor between the scale of a subset and the expected scale", minimum=1.01, advanced=True
    )
    validation: bool = option(
        True, "check every subset before it enters the map, drop bad references and try again (V&R)", advanced=True
    )
    reference_gate: float = option(
        6.0,
        "maximum shift of a reference, as a multiple of the median shift of all references; 0 disables the test",
        minimum=0.0,
        advanced=True,
    )
    fragments: bool = option(
        True,
        "let photographs that hang together apart from the map begin a part of their own, and join parts that meet; "
        "off keeps the single map of the paper",
        advanced=True,
    )
    validate_queries: bool = option(
        True, "check the new images against the map too, not only the references", advanced=True
    )
    gps_check: bool = option(
        True, "require a second reconstruction of an image that is placed far from its GPS position", advanced=True
    )
    max_retries: int = option(
        3, "maximum number of times that a rejected image is tried again", unit="times", minimum=0, advanced=True
    )


@dataclass(frozen=True)
class PoseGraphOptions(CheckedOptions):
    """Drift removal (paper Sec. III-F)."""

    pose_graph: Literal["sim3", "se3", "none"] = option(
        "sim3",
        "sim3 moves submaps and frames together with their points; se3 is the paper's graph of frames; none disables "
        "it",
        choices=("sim3", "se3", "none"),
        advanced=True,
    )
    gps_priors: bool = option(
        True,
        "use GPS positions, weighted by their accuracy, against the bending of a large map (requires sim3)",
        advanced=True,
    )
    refine: bool = option(
        True,
        "adjust all cameras and their intrinsics together at the end (requires a local reconstructor that matches "
        "features)",
        advanced=True,
    )


@dataclass(frozen=True)
class GeoreferenceOptions(CheckedOptions):
    """From the map to the Earth."""

    crs: str | None = option(
        None, "projected CRS of the result; default: UTM zone of the median position", example="EPSG:32633"
    )
    force_crs: bool = option(
        False, "accept a CRS whose lengths are wrong by more than 0.2 % where the survey lies", advanced=True
    )
    vertical: Literal["auto", "ellipsoidal", "egm96", "egm2008"] = option(
        "auto",
        "reference of the photographs' heights; auto uses what the tags state",
        choices=("auto", "ellipsoidal", "egm96", "egm2008"),
    )
    positions: str | None = option(
        None,
        "file of camera positions, which replace those in the tags: the first line names a CRS, each further line has "
        "name, x, y, z and, if known, yaw, pitch, roll in degrees (pitch 0 looks down)",
        example="geo.txt",
    )
    gps: Literal["adjust", "fit"] = option(
        "adjust",
        "adjust lets camera positions take part in the adjustment of the cameras; fit only fits the finished map to "
        "them, as the paper does",
        choices=("adjust", "fit"),
        advanced=True,
    )
    control: str | None = option(
        None,
        "file of ground control: gcp_list.txt, a CSV with a header (label, x, y, z, image, px, py) or GeoJSON points; "
        "labels that begin with CHK- are checkpoints",
        example="gcp_list.txt",
    )
    control_marks: str | None = option(
        None,
        "second CSV with the marks (image, label, px, py) where the control file has the points only",
        example="marks.csv",
        advanced=True,
    )
    checkpoints: str | None = option(
        None,
        "labels of control points that take no part in the adjustment and check it, separated by commas",
        example="P3,P7",
    )
    local: bool = option(
        False,
        "write local coordinates without a CRS; the unit is the metre if positions or the local reconstructor give the "
        "scale",
    )
    gps_sigma_h_m: float = option(
        3.0, "standard deviation of horizontal positions that state none", unit="m", minimum=0.001
    )
    gps_sigma_v_m: float = option(5.0, "standard deviation of heights that state none", unit="m", minimum=0.001)


@dataclass(frozen=True)
class ExportOptions(CheckedOptions):
    """The files in the output folder."""

    allow_partial: bool = option(
        False, "take a result for one, exit code 0, even if it holds fewer than half of the photographs"
    )
    cloud: bool = option(
        True, "write the point cloud; without it, cameras, footprints, COLMAP model and report are written"
    )
    format: Literal["laz", "las", "copc"] = option(
        "laz",
        "point cloud format: LAZ, LAS, or COPC, a LAZ that QGIS and other viewers open at once however large it is",
        choices=("laz", "las", "copc"),
    )
    quality: Literal["preview", "standard", "full"] = option(
        "standard",
        "how the cloud is made: preview corrects the point maps that the map was built with; standard makes new ones "
        "with the final cameras from photographs of 800 px; full makes them from photographs of 1600 px",
        choices=("preview", "standard", "full"),
    )
    spacing_m: float | None = option(
        None,
        "voxel size of the cloud; default: the ground sampling distance of the point maps",
        example="0.1",
        unit="m",
        minimum=0.0001,
    )
    min_confidence: float = option(0.5, "minimum confidence of a point of the cloud", minimum=0.0, maximum=1.0)
    stray_filter: bool = option(True, "remove isolated points")
    ground: bool = option(True, "classify the points of the ground (class 2), and write a terrain model from them")
    rasters: bool = option(True, "write the surface model, the terrain model and their confidence as GeoTIFF")
    raster_m: float | None = option(
        None,
        "pixel size of the surface and terrain models; default: the spacing of the cloud",
        unit="m",
        minimum=0.0001,
        example="0.1",
    )
    fill_holes: float = option(
        0.0,
        "close holes of the surface model whose middle is at most this far from their edge",
        unit="m",
        minimum=0.0,
        maximum=1000.0,
        example="2",
    )
    orthophoto: Literal["best", "fast", "none"] = option(
        "best",
        "best lays the photographs on the surface model at their full resolution; fast makes it four times coarser; "
        "none leaves it out",
        choices=("best", "fast", "none"),
    )
    ortho_m: float | None = option(
        None,
        "pixel size of the orthophoto; default: the ground sampling distance of the photographs",
        unit="m",
        minimum=0.0001,
        example="0.05",
    )
    boundary: str | None = option(
        None,
        "GeoJSON file of polygons in longitude and latitude (WGS 84); the cloud keeps the points inside any of them",
        example="field.geojson",
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
    named: frozenset[str] | None = field(default=None, compare=False, repr=False)  # what the user set, if known

    def __post_init__(self) -> None:
        """Refuse options that have no effect together; raises `OptionError`."""
        flat = self.to_flat()
        for first in CONTRADICTIONS:
            if first.holds(flat):
                raise OptionError(first.told)

    def to_named(self) -> dict[str, Any]:
        """Return `{name: value}` of what the user set and of the preset; what differs from the defaults if unknown."""
        flat = self.to_flat()
        if self.named is not None:
            return {name: value for name, value in flat.items() if name in self.named}
        defaults = DEFAULT_VALUES | {"preset": "default"} | (PAPER_VALUES if self.preset == "paper" else {})
        return {"preset": self.preset} | {name: value for name, value in flat.items() if value != defaults[name]}

    @classmethod
    def from_flat(cls, values: Mapping[str, Any]) -> Options:
        """Build options from `{name: value}`; raises `OptionError` for unknown names, bad values and contradictions.

        What `values` names wins over the preset, also where it equals the default.
        """
        remaining = dict(values)
        preset = remaining.pop("preset", "default")
        if preset not in get_args(Preset):
            raise OptionError(f"preset: {preset!r} is not one of {', '.join(get_args(Preset))}")
        base = dict(PAPER_VALUES) if preset == "paper" else {}
        base.update(remaining)
        slices: dict[str, Any] = {}
        for slice_name, slice_class in slice_classes().items():
            names = [f.name for f in dataclasses.fields(slice_class)]
            slices[slice_name] = slice_class(**{name: base.pop(name) for name in names if name in base})
        if base:
            known = ", ".join(sorted(f.name for _, f in iterate_options()))
            raise OptionError(f"unknown option {', '.join(sorted(base))}; known options: {known}")
        return cls(preset=preset, **slices, named=frozenset(values))

    def to_flat(self) -> dict[str, Any]:
        """Return `{name: value}` of all options, the inverse of `from_flat`."""
        flat: dict[str, Any] = {"preset": self.preset}
        for slice_name in slice_classes():
            flat.update(dataclasses.asdict(getattr(self, slice_name)))
        return flat


# What the paper does where our default differs; later improvements switched off. A look-ahead of one means the paper's
# seed too: the first images that retrieval connects. What the preset leaves as it is, `PAPER_NOTES` says.
PAPER_VALUES: dict[str, Any] = {
    "lookahead": 1,
    "subset_references": 5,
    "gps_candidates": False,
    "reference_gate": 0.0,
    "fragments": False,
    "validate_queries": False,
    "gps_check": False,
    "max_retries": 0,
    "reference_points": 5000,
    "pose_graph": "se3",
    "refine": False,
    "quality": "preview",
}


# Where a run with the preset is not the paper's experiment, for the documentation.
PAPER_NOTES = (
    "The first reconstruction takes the first N0 images that retrieval connects, in order of arrival "
    "(`--lookahead 1`), and its cameras have edges among themselves in the SE(3) graph.",
    "Each image keeps up to 5,000 reference points, but an alignment uses at most 500 of each, evenly spread.",
    "tau_s (`--min-similarity`) is 0: the paper gives no value. An image joins a batch by the references it shares.",
    "The descriptor stays `vlad` and the local reconstructor `classical`, which need no download. The paper's are "
    "SupScene and Pi3X: `--descriptor supscene --backbone pi3x` with their weights.",
)


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


@dataclass(frozen=True)
class Contradiction:
    """Two options of which the first has no effect while the second has a certain value."""

    name: str
    other: str
    other_values: tuple[Any, ...]
    told: str

    def holds(self, flat: Mapping[str, Any]) -> bool:
        """Return whether the values `{name: value}` contradict each other."""
        return flat[self.name] != DEFAULT_VALUES[self.name] and flat[self.other] in self.other_values


DEFAULT_VALUES: dict[str, Any] = {item.name: item.default for _, item in iterate_options()}

CONTRADICTIONS = (
    Contradiction("crs", "local", (True,), "crs: --local writes coordinates without a CRS; use only one of the two"),
    Contradiction("force_crs", "crs", (None,), "force_crs: no CRS is named; name one with --crs"),
    Contradiction(
        "boundary", "local", (True,), "boundary: --local has no place on the Earth to clip at; use only one of the two"
    ),
    Contradiction(
        "weights",
        "backbone",
        ("classical",),
        "weights: the backbone classical has no weights; name a neural one with --backbone",
    ),
    Contradiction(
        "max_gpu_memory_gib",
        "backbone",
        ("classical",),
        "max_gpu_memory_gib: the backbone classical uses no GPU; name a neural one with --backbone",
    ),
    Contradiction(
        "descriptor_weights",
        "descriptor",
        ("vlad", "efficientnet"),
        "descriptor_weights: this descriptor has no weights of its own; choose supscene or megaloc with --descriptor",
    ),
    *(
        Contradiction(name, "cloud", (False,), f"{name}: --no-cloud writes no cloud; use only one of the two")
        for name in ("spacing_m", "min_confidence", "boundary", "stray_filter")
    ),
)


def over_earlier(earlier: Mapping[str, Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """Return earlier values overridden by named ones; an earlier value that contradicts a named one is left out."""
    kept = dict(earlier)
    flat = DEFAULT_VALUES | kept | dict(named)
    for contradiction in CONTRADICTIONS:
        if contradiction.holds(flat):
            kept.pop(contradiction.other if contradiction.name in named else contradiction.name, None)
    return kept | dict(named)
