"""The studio: a robot on a floor, its references as a pale double, from one side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.rendering.framing import framed
from hpid_ros.rendering.motion import Motion, Stand, corners
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.stage import Stage, open_stage
from hpid_ros.simulation.stage.stage import Picture, Pixels, StageSettings
from hpid_ros.simulation.stage.view import FIELD

_FLOOR, _THICKNESS = (0.93, 0.94, 0.96), 0.004
_DEEP, _WIDE = 3.6, 12.0
"""Edges of the floor over half of what the robot needs of it: none but the far one is seen."""
_DOUBLE, _SHARE = (0.10, 0.66, 0.36), 0.45
_IN_FRONT = 0.006
"""How much nearer the double is where it is drawn over the robot, over the camera's distance."""
_LEAST = 0.1
"""What moves less is not drawn anew, over the height of a pixel; of a body's turn over 1 m."""


class Studio:
    """Takes pictures of the motions of one robot, all from the same place."""

    def __init__(
        self,
        stand: Stand,
        motions: Sequence[Motion],
        engine: str,
        size: tuple[int, int],
        side: tuple[float, float],
    ) -> None:
        self._motions = motions
        robot = [shape.body for shape in stand.shapes]
        boxes = stand.boxes
        points = np.concatenate(
            [
                corners([*robot, *boxes], np.concatenate([places, each.boxes], axis=1))
                for each in motions
                for places in (each.robot, each.wanted)
                if places is not None
            ]
        )
        floor, self._floor = _floor(points, side[0])
        view = framed(points, *side, size[0] / size[1])
        self._nearer = _IN_FRONT * view.distance
        self._least = _LEAST * 2.0 * math.tan(FIELD / 2.0) * view.distance / size[1]
        self._drawn: dict[tuple[int, int], tuple[Numbers, Picture]] = {}
        self._stages: list[Stage] = []
        try:
            bodies = (floor, *boxes, *robot)
            self._stages.append(open_stage(engine, StageSettings(bodies, view, *size)))
            if any(each.wanted is not None for each in motions):
                double = [body._replace(color=_DOUBLE) for body in robot]
                settings = StageSettings(double, view, *size, is_lit=False)
                self._stages.append(open_stage(engine, settings))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free what draws."""
        while self._stages:
            self._stages.pop().close()

    def shoot(self, number: int, k: int) -> Pixels:
        """Return the picture of one of the motions at its k-th instant."""
        motion = self._motions[number]
        places = np.concatenate([self._floor[None], motion.boxes[k], motion.robot[k]])
        picture = self._draw(0, number, places)
        if motion.wanted is None:
            return picture.pixels
        return self._with_double(picture, self._draw(1, number, motion.wanted[k]))

    def _draw(self, stage: int, number: int, places: Numbers) -> Picture:
        """Return the picture of bodies, the last one while nothing moves that could be seen."""
        last = self._drawn.get((stage, number))
        if last is not None and abs(places - last[0]).max() < self._least:
            return last[1]
        picture = self._stages[stage].draw(places)
        self._drawn[stage, number] = places, picture
        return picture

    def _with_double(self, picture: Picture, double: Picture) -> Pixels:
        """Return a picture with the double where it stands before everything else."""
        shown = double.depth < picture.depth - self._nearer
        mixed = (1.0 - _SHARE) * picture.pixels[shown] + _SHARE * double.pixels[shown]
        pixels: Pixels = picture.pixels.copy()
        pixels[shown] = mixed.round()
        return pixels


def _floor(points: Numbers, azimuth: float) -> tuple[Body, Numbers]:
    """Return a floor below everything, one edge along the picture, and its placement."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = (low[:2] + high[:2]) / 2.0
    radius = float(np.linalg.norm(points[:, :2] - (x, y), axis=1).max())
    turn = math.sin(azimuth / 2.0), math.cos(azimuth / 2.0)
    place = np.array([x, y, low[2] - _THICKNESS / 2.0, 0.0, 0.0, *turn])
    return Body("box", (_DEEP * radius, _WIDE * radius, _THICKNESS), _FLOOR), place
