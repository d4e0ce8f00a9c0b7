"""One place to import pycolmap: what must come before it, how loud it may be, and what it may change."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import threading
import zlib  # noqa: F401 - must be loaded before pycolmap, else PNG and deflate writers of this process abort
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

from ..geometry.camera import Camera

ACTION_BYTES = 512  # more than any system's struct sigaction


@lru_cache(maxsize=1)
def load_pycolmap() -> Any:
    """Return the pycolmap module with its chatter silenced, and the caller's signal handlers as they were."""
    with keeping_signal_handlers():
        import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    return pycolmap


def to_pycolmap_camera(camera: Camera, camera_id: int) -> Any:
    """Return the camera as pycolmap's OPENCV model, its focal length marked as known."""
    pycolmap = load_pycolmap()

    made = pycolmap.Camera(
        model="OPENCV",
        width=camera.width,
        height=camera.height,
        params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        camera_id=camera_id,
    )
    made.has_prior_focal_length = True
    return made


@contextlib.contextmanager
def keeping_signal_handlers() -> Iterator[None]:
    """Put back the signal handlers that the block replaces: pycolmap's end the process with a stack trace."""
    numbers = [number for number in signal.valid_signals() if number not in _uncatchable()]
    if os.name == "nt":
        before = {number: signal.getsignal(number) for number in numbers}
        yield
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                if handler is not None:
                    signal.signal(number, handler)
        return
    # Through the C library: handlers that are not Python's are kept too, from any thread.
    library = ctypes.CDLL(None)
    kept = {number: ctypes.create_string_buffer(ACTION_BYTES) for number in numbers}
    for number, action in kept.items():
        library.sigaction(int(number), None, action)
    try:
        yield
    finally:
        for number, action in kept.items():
            library.sigaction(int(number), action, None)


def _uncatchable() -> set[int]:
    return {getattr(signal, name) for name in ("SIGKILL", "SIGSTOP") if hasattr(signal, name)}
