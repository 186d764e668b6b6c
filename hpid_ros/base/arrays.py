"""Arrays and vectors, by one name each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
"""Of any shape, which the docstring says."""

Vector = tuple[float, float, float]
"""In space: x, y, z."""
