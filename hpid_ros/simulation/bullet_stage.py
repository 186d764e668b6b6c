"""A stage of PyBullet: its TinyRenderer, which computes every pixel itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hpid_ros.base.units import Numbers
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.bullet_scene import captured, connected, disconnect, pybullet
from hpid_ros.simulation.stage import (
    FARTHEST,
    FIELD,
    LIGHT,
    NEAREST,
    Picture,
    Pixels,
    StageSettings,
)

_FINER = 2
"""Pixels along an edge of which one of the picture is the mean: the renderer smooths nothing."""
_AMBIENT, _DIFFUSE, _SPECULAR = 0.60, 0.42, 0.04


class BulletStage:
    """:class:`~hpid_ros.simulation.stage.Stage` in PyBullet."""

    def __init__(self, settings: StageSettings) -> None:
        self._settings = settings
        self._finer = _FINER if settings.is_lit else 1
        self._client = connected(gui=False)
        with captured():
            self._bodies = [self._add(body) for body in settings.bodies]
        view = settings.view
        self._looks = {
            "viewMatrix": pybullet.computeViewMatrix(
                view.eye.tolist(), view.target, (0.0, 0.0, 1.0)
            ),
            "projectionMatrix": pybullet.computeProjectionMatrixFOV(
                math.degrees(FIELD),
                settings.width / settings.height,
                NEAREST * view.distance,
                FARTHEST * view.distance,
            ),
            "lightDirection": _light(view.azimuth),
            "lightColor": (1.0, 1.0, 1.0),
            "lightDistance": 3.0 * view.distance,
            "shadow": int(settings.is_lit),
            "lightAmbientCoeff": _AMBIENT,
            "lightDiffuseCoeff": _DIFFUSE,
            "lightSpecularCoeff": _SPECULAR,
            "renderer": pybullet.ER_TINY_RENDERER,
        }

    def draw(self, placements: Numbers) -> Picture:
        """Return a picture."""
        for body, (*position, x, y, z, w) in zip(self._bodies, placements.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(
                body, position, (x, y, z, w), physicsClientId=self._client
            )
        width, height = (self._finer * each for each in self._size)
        image = pybullet.getCameraImage(width, height, **self._looks, physicsClientId=self._client)
        pixels = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)[..., :3]
        middle = self._finer // 2
        depth = np.asarray(image[3]).reshape(height, width)[
            middle :: self._finer, middle :: self._finer
        ]
        # Bullet's is that of OpenGL: 0 at the nearest, 1 at the farthest, and not evenly between.
        far = FARTHEST * self._settings.view.distance
        share = 1.0 - depth * (1.0 - NEAREST / FARTHEST)
        return Picture(_mean(pixels, self._finer), far * NEAREST / FARTHEST / share)

    def close(self) -> None:
        """Free the simulation."""
        disconnect(self._client)
        self._client = -1

    @property
    def _size(self) -> tuple[int, int]:
        return self._settings.width, self._settings.height

    def _add(self, body: Body) -> int:
        visual = pybullet.createVisualShape(
            **_form(body), rgbaColor=(*body.color, 1.0), physicsClientId=self._client
        )
        added: int = pybullet.createMultiBody(
            0.0, -1, visual, useMaximalCoordinates=True, physicsClientId=self._client
        )
        return added


def _form(body: Body) -> dict[str, Any]:
    if body.form == "box":
        half = [edge / 2.0 for edge in body.size]
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
    if body.form == "sphere":
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": body.size[0]}
    if body.form == "cylinder":
        radius, length = body.size
        return {"shapeType": pybullet.GEOM_CYLINDER, "radius": radius, "length": length}
    mesh = {"fileName": str(body.mesh), "meshScale": body.size}
    return {"shapeType": pybullet.GEOM_MESH, **mesh}


def _light(azimuth: float) -> tuple[float, float, float]:
    """Return the direction to the light in the world."""
    away, aside, up = LIGHT
    c, s = math.cos(azimuth), math.sin(azimuth)
    return away * c - aside * s, away * s + aside * c, up


def _mean(pixels: Pixels, finer: int) -> Pixels:
    if finer == 1:
        return pixels
    height, width, _ = pixels.shape
    blocks = pixels.reshape(height // finer, finer, width // finer, finer, 3)
    return np.asarray(blocks.mean(axis=(1, 3)).round(), dtype=np.uint8)
