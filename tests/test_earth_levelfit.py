"""The robust loss of the fit to positions against its closed form."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.earth.levelfit import TUKEY, _tukey, _tukey_cost


@given(st.floats(-4.0, 4.0))
def test_loss_and_weight_belong_together(ratio: float) -> None:
    """The derivative of the loss is the residual times its weight."""
    step = 1e-5
    slope = float(_tukey_cost(np.array(ratio + step)) - _tukey_cost(np.array(ratio - step))) / (2.0 * step)
    assert abs(slope - ratio * float(_tukey(np.array(ratio)))) < 1e-6


def test_loss_is_quadratic_for_small_residuals_and_constant_for_blunders() -> None:
    assert abs(float(_tukey_cost(np.array(0.01))) / (0.5 * 0.01**2) - 1.0) < 1e-4
    assert float(_tukey_cost(np.array(2.0 * TUKEY))) == float(_tukey_cost(np.array(50.0 * TUKEY)))
    assert float(_tukey(np.array(2.0 * TUKEY))) == 0.0
