"""Array types used in signatures; shapes and frames are said where the arrays are fields."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Bool = NDArray[np.bool_]
Int = NDArray[np.integer[Any]]
UInt8 = NDArray[np.uint8]
