"""When so many positions disagree that the place on the Earth is doubtful."""

from __future__ import annotations

import numpy as np

from onthefly3r.geometry.transforms import Sim3
from onthefly3r.records import GeoReference
from onthefly3r.run.verdict import doubtful_positions


def tied(used: int, outliers: int) -> GeoReference:
    residuals = dict.fromkeys(range(used + outliers), (0.0, 0.0, 0.0))
    here = Sim3(1.0, np.eye(3), np.zeros(3))
    return GeoReference(
        here, 47.0, 8.0, 400.0, "EPSG:32632", "ellipsoidal", "Sim(3)", used, outliers, 0.1, 0.1, residuals
    )


def test_a_third_of_the_positions_is_doubtful() -> None:
    assert doubtful_positions(tied(12, 6))[0].startswith("6 of 18 positions disagree with the map")
    assert doubtful_positions(tied(13, 5)) == []
    assert doubtful_positions(None) == []
