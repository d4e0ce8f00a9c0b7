"""What a file is by its first bytes, and what to do about those that are no photographs of ours."""

from __future__ import annotations

from importlib.util import find_spec

HEAD_BYTES = 4096
JPEG_PNG_TIFF = frozenset({".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".mpo"})
HEIC = frozenset({".heic", ".heif", ".hif"})
RAW = frozenset({".dng"})
OTHER_RAW = frozenset({".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2", ".pef", ".iiq", ".3fr"})
VIDEO = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mts", ".m2ts", ".mkv", ".ts", ".lrv", ".lrf", ".insv"})
OTHER_PICTURES = frozenset({".webp", ".avif", ".jxl", ".jp2", ".bmp", ".gif", ".insp"})
SUFFIXES = JPEG_PNG_TIFF | HEIC | RAW | OTHER_RAW | OTHER_PICTURES  # files that are looked at as photographs

FRAMES_HELP = "take single frames out of it, for example with: ffmpeg -i VIDEO -vf fps=1 frame_%04d.jpg"
HEIC_HELP = 'install the extra: pip install "onthefly3r[heic]", or convert it to JPEG with its tags'
RAW_HELP = 'install the extra: pip install "onthefly3r[raw]", or develop it to JPEG or TIFF with its tags'
CONVERT_HELP = "convert it to JPEG or TIFF with its tags"

_HEIF_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}


def kind_of(head: bytes) -> str:
    """Return "jpeg", "png", "tiff", "dng", "heic", "" for unknown, or the English name of something else."""
    if head.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        if head[8:10] == b"CR":
            return "a Canon raw file"
        return "dng" if _has_dng_version(head) else "tiff"
    if head[4:8] == b"ftyp":
        return _of_brands({head[k : k + 4] for k in range(8, min(len(head), 64), 4)})
    if head[:4] == b"RIFF":
        return {b"AVI ": "an AVI video", b"WEBP": "a WebP picture"}.get(head[8:12], "")
    signatures = {
        b"FUJIFILM": "a Fuji raw file",
        b"IIRO": "an Olympus raw file",
        b"IIU\0": "a Panasonic raw file",
        b"GIF8": "a GIF picture",
        b"BM": "a BMP picture",
        b"\xff\x0a": "a JPEG XL picture",
        b"\0\0\0\x0cJXL ": "a JPEG XL picture",
        b"\0\0\0\x0cjP  ": "a JPEG 2000 picture",
        b"\x1a\x45\xdf\xa3": "a Matroska video",
        b"%PDF": "a PDF document",
        b"PK\x03\x04": "a zip archive",
    }
    return next((name for start, name in signatures.items() if head.startswith(start)), "")


def what_to_do(kind: str) -> str:
    """Return how a file of a kind that is not read can be used after all."""
    if "video" in kind:
        return FRAMES_HELP
    if kind == "heic":
        return HEIC_HELP
    return RAW_HELP if kind == "dng" else CONVERT_HELP


def can_read(kind: str) -> bool:
    """Return whether the package that reads this kind is installed."""
    module = {"heic": "pillow_heif", "dng": "rawpy"}.get(kind)
    return module is None or find_spec(module) is not None


def _of_brands(brands: set[bytes]) -> str:
    if brands & {b"avif", b"avis"}:
        return "an AVIF picture"
    if b"crx " in brands:
        return "a Canon raw file"
    return "heic" if brands & _HEIF_BRANDS else "an MP4 or QuickTime video"


def _has_dng_version(head: bytes) -> bool:
    """Return whether the first directory of a TIFF, if it lies in these bytes, holds the tag DNGVersion."""
    order = "little" if head[:2] == b"II" else "big"
    if head[2:4] not in (b"*\0", b"\0*"):
        return False
    start = int.from_bytes(head[4:8], order)  # type: ignore[arg-type]
    count = int.from_bytes(head[start : start + 2], order)  # type: ignore[arg-type]
    entries = range(start + 2, min(start + 2 + 12 * count, len(head) - 1), 12)
    return any(int.from_bytes(head[k : k + 2], order) == 50706 for k in entries)  # type: ignore[arg-type]
