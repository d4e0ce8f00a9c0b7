"""What the report says of accuracy: control and checkpoints apart, in the words of ASPRS, and what residuals are not.

ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023): RMSE_H, RMSE_V and RMSE_3D from at
least 30 checkpoints, survey error included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..records import ControlResidual, GeoReference

TESTABLE = 30  # checkpoints


def accuracy_report(reference: GeoReference) -> dict[str, Any]:
    """Return the accuracy part of the report as JSON values."""
    return {
        "statement": statement(reference),
        "control": _rmse([p for p in reference.control if p.role == "control"]),
        "checkpoints": _rmse([p for p in reference.control if p.role == "checkpoint"]),
        "points": [_row(point) for point in reference.control],
    }


def statement(reference: GeoReference) -> str:
    """Return in plain sentences what is known of the accuracy."""
    if not reference.control:
        return (
            "No checkpoints: residuals at camera positions say how well the positions fit one another, and are no "
            "accuracy of the result."
        )
    checked = [p for p in reference.control if p.role == "checkpoint"]
    if not checked:
        return (
            "Residuals of control points say how well the adjustment follows them, and are no accuracy of the result: "
            "there are no checkpoints."
        )
    found = _rmse(checked)
    figures = ", ".join(
        f"{name} {found[key]:.3f} m"
        for name, key in (("RMSE H", "rmse_h_m"), ("RMSE V", "rmse_v_m"), ("RMSE 3D", "rmse_3d_m"))
        if found[key] is not None
    )
    if len(checked) < TESTABLE:
        return (
            f"{figures} at {len(checked)} checkpoints. An ASPRS accuracy class (Edition 2, 2023) is not testable with "
            f"fewer than {TESTABLE} checkpoints."
        )
    return (
        f"{figures} at {len(checked)} checkpoints, as ASPRS Edition 2 (2023) asks for; the survey error of the "
        "checkpoints is to be added in quadrature."
    )


def _rmse(points: Sequence[ControlResidual]) -> dict[str, Any]:
    """Return root mean squares; a vertical one takes only points that have a height."""
    if not points:
        return {"points": 0, "rmse_h_m": None, "rmse_v_m": None, "rmse_3d_m": None}
    horizontal = [p.east_m**2 + p.north_m**2 for p in points]
    high = [p for p in points if np.isfinite(p.up_m)]
    space = [p.east_m**2 + p.north_m**2 + p.up_m**2 for p in high]
    return {
        "points": len(points),
        "rmse_h_m": float(np.sqrt(np.mean(horizontal))),
        "rmse_v_m": float(np.sqrt(np.mean([p.up_m**2 for p in high]))) if high else None,
        "rmse_3d_m": float(np.sqrt(np.mean(space))) if high else None,
    }


def _row(point: ControlResidual) -> dict[str, Any]:
    """Return one point; heights that are poorly seen say so."""
    row = {name: value for name, value in vars(point).items() if name != "enu_m"}
    if point.sigma_v_m > 3.0 * max(point.sigma_h_m, 0.01):
        row["note"] = "seen under flat angles: its height is poorly known"
    return row
