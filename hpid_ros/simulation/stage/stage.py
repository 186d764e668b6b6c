"""The protocol of stages, and the choice of one: who takes pictures on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.settings import require_engine
from hpid_ros.simulation.stage.view import View

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
        from hpid_ros.simulation.stage.mujoco_stage import MujocoStage

        return MujocoStage(settings)
    from hpid_ros.simulation.stage.bullet_stage import BulletStage

    return BulletStage(settings)
