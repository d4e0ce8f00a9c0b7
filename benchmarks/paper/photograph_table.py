"""The figures of the runs on real photographs as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .tables import markdown, shown


def photographs_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return one line for each set, order and strategy; ATE in per cent of the flying height of the reference."""
    lines = []
    for row in rows:
        ratios = [after / before for before, after in row["passes"] if before > 0.0]
        lines.append(
            [
                row["set"],
                row["order"],
                row["strategy"],
                shown(row["ate_percent"], 3) if row["ate_percent"] is not None else row["note"].split(":")[0] or "-",
                *(shown(row.get(key), 3) for key in ("are_deg", "rte_deg", "rre_deg")),
                f"{row['placed']}/{row['given']}",
                str(row["calls"]),
                f"{row['inferred'] / row['given']:.2f}",
                f"{row['seconds'] / row['given']:.2f}",
                f"{max(ratios):.3f} ({len(ratios)})" if ratios else "-",
            ]
        )
    head = ["Set", "Order", "Strategy", "ATE %", "ARE deg", "RTE deg", "RRE deg", "Placed", "Calls", "Inferred / image"]
    return markdown([*head, "s / image", "Passes: worst ratio"], lines)
