"""The camera's place: as near as everything stays in the picture."""

from __future__ import annotations

import math

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.simulation.stage import View
from hpid_ros.simulation.stage.view import FIELD

_ROUNDS = 8
_AIR = 1.1
"""How much wider than what is in it a picture is."""


def framed(points: Numbers, azimuth: float, elevation: float, aspect: float) -> View:
    """Return the view from one side that holds some points, them in its middle."""
    axes = View((0.0, 0.0, 0.0), 1.0, azimuth, elevation).axes
    right, up, near = axes @ points.T
    high = math.tan(FIELD / 2.0) / _AIR
    wide = high * aspect
    x, y, z = ((each.min() + each.max()) / 2.0 for each in (right, up, near))
    distance = 0.0
    for _ in range(_ROUNDS):
        reach = np.maximum(abs(right - x) / wide, abs(up - y) / high)
        distance = float((reach + near - z).max())
        depth = distance - (near - z)
        # Nearer points weigh more: the middle of what is seen is not that of the points.
        x += _middle((right - x) / depth) * distance
        y += _middle((up - y) / depth) * distance
    tx, ty, tz = (axes.T @ (x, y, z)).tolist()
    return View((tx, ty, tz), distance, azimuth, elevation)


def _middle(values: Numbers) -> float:
    return float(values.min() + values.max()) / 2.0
