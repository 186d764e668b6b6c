"""Where a picture is taken from."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers, Vector

FIELD = math.radians(30.0)
"""Angle from a picture's lower to its upper edge, in [rad]."""
NEAREST, FARTHEST = 0.016, 4.0
"""What is nearer or farther is not drawn; over the distance of the camera."""


class View(NamedTuple):
    """A camera that looks at a point, its picture upright."""

    target: Vector  # [m] the point in the middle of the picture
    distance: float  # [m] from the camera to it
    azimuth: float  # [rad] where the camera stands, about z from x
    elevation: float  # [rad] how far above the point it stands, less than a right angle

    @property
    def axes(self) -> Numbers:
        """Rows: unit vectors to the right, up, and from the target to the camera, (3, 3)."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        low, high = math.cos(self.elevation), math.sin(self.elevation)
        return np.array([[-s, c, 0.0], [-high * c, -high * s, low], [low * c, low * s, high]])

    @property
    def eye(self) -> Numbers:
        """Where the camera is, (3,), in [m]."""
        return np.asarray(self.target) + self.distance * self.axes[2]
