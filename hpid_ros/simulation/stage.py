"""The protocol of stages, and the choice of one: who takes pictures on this machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.settings import require_engine

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


Pixels = NDArray[np.uint8]
"""A picture: rows from above, columns, red green blue."""

LIGHT = (0.35, -0.5, 1.0)
"""Where the light comes from, about z from the camera's azimuth: x towards it, z up."""


class Picture(NamedTuple):
    """What a camera sees."""

    pixels: Pixels  # its colours
    # [m] how far away along the line of sight's middle each pixel is, (rows, columns)
    depth: Numbers


class Stage(Protocol):
    """Bodies before a white background, and a camera."""

    def draw(self, placements: Numbers) -> Picture:
        """Return a picture."""

    def close(self) -> None:
        """Free what draws; a second call does nothing."""


class StageSettings(NamedTuple):
    """What is on a stage."""

    bodies: Sequence[Body]  # the K bodies
    view: View  # the camera
    width: int  # of a picture, in pixels
    height: int  # of a picture, in pixels
    is_lit: bool = True  # whether bodies throw shadows, and edges are smoothed: twice the work


MESHES = {"pybullet": frozenset({".obj", ".stl", ".dae"}), "mujoco": frozenset({".obj", ".stl"})}
"""Suffixes of the mesh files that each engine reads."""


def open_stage(engine: str, settings: StageSettings) -> Stage:
    """Return a stage of an engine.

    PyBullet's draws by itself, wherever PyBullet is installed. MuJoCo's needs OpenGL, for which it
    needs no screen.
    """
    require_engine(engine)
    # Imported where it is asked for, as the engines themselves.
    if engine == "mujoco":
        from hpid_ros.simulation.mujoco_stage import MujocoStage

        return MujocoStage(settings)
    from hpid_ros.simulation.bullet_stage import BulletStage

    return BulletStage(settings)
