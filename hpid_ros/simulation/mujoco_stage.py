"""A stage of MuJoCo: its renderer on OpenGL without a screen, EGL or OSMesa."""

from __future__ import annotations

import ctypes.util
import logging
import math
import os
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import LibraryError, RobotDescriptionError
from hpid_ros.base.units import Numbers
from hpid_ros.robot.shapes import Body
from hpid_ros.simulation.stage import FARTHEST, FIELD, LIGHT, NEAREST, Picture, StageSettings


def triangles_of(file: Path) -> tuple[Numbers, NDArray[np.int32]]:
    """Return corners, (N, 3), in the file's units, and triangles of three corners each, (M, 3).

    Faces of more corners become fans. Everything but corners and faces is passed over.
    """
    corners: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                corners.append([float(word) for word in words[:3]])
            elif kind == "f":
                first, *rest = (_place(word, len(corners)) for word in words)
                faces += [(first, one, other) for one, other in pairwise(rest)]
        found = np.array(corners).reshape(-1, 3), np.array(faces, dtype=np.int32).reshape(-1, 3)
        if not faces or not 0 <= found[1].min() <= found[1].max() < len(corners):
            raise ValueError("no faces, or of corners that are not there")
    except (OSError, ValueError) as error:
        raise RobotDescriptionError(f"cannot read mesh {file}: {error}") from None
    return found


def _place(word: str, known: int) -> int:
    """Return which corner a face names: counted from 1, or backwards from those before it."""
    number = int(word.partition("/")[0])
    return number - 1 if number > 0 else known + number


_SHADOW = 2048  # pixels of the shadow map, along an edge
_SAMPLES = 4  # for each pixel
_MOST_SHAPES = 10_000
_FORMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
_logger = logging.getLogger(__name__)


class MujocoStage:
    """:class:`~hpid_ros.simulation.stage.Stage` in MuJoCo."""

    def __init__(self, settings: StageSettings) -> None:
        self._context: Any = None
        self._renderer: Any = None
        self._model = _model(settings)
        self._data = mujoco.MjData(self._model)
        self._camera = _camera(settings)
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self._model, _MOST_SHAPES)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = settings.is_lit
        # Meshes of which some faces are the wrong way round are common.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False
        self._rectangle = mujoco.MjrRect(0, 0, settings.width, settings.height)
        self._context = _gl_context(settings.width, settings.height)
        self._context.make_current()
        scale = mujoco.mjtFontScale.mjFONTSCALE_100.value
        self._renderer = mujoco.MjrContext(self._model, scale)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)

    def draw(self, placements: Numbers) -> Picture:
        """Return a picture."""
        data = self._data
        data.mocap_pos[:] = placements[:, :3]
        data.mocap_quat[:] = placements[:, [6, 3, 4, 5]]
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        parts = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, parts, self._scene
        )
        height, width = self._rectangle.height, self._rectangle.width
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        depth = np.empty((height, width), dtype=np.float32)
        self._context.make_current()
        mujoco.mjr_render(self._rectangle, self._scene, self._renderer)
        mujoco.mjr_readPixels(pixels, depth, self._rectangle, self._renderer)
        # 0 at the nearest, 1 at the farthest, and not evenly between.
        near = NEAREST * self._model.stat.extent
        share = 1.0 - depth[::-1].astype(float) * (1.0 - NEAREST / FARTHEST)
        return Picture(pixels[::-1], near / share)

    def close(self) -> None:
        """Free OpenGL."""
        for each in (self._renderer, self._context):
            if each is not None:
                each.free()
        self._renderer = self._context = None


def _model(settings: StageSettings) -> Any:
    """Return a model in which each body hangs on nothing and is put where it is told."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    # Without one the background is black.
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=(1.0, 1.0, 1.0),
        rgb2=(1.0, 1.0, 1.0),
        width=8,
        height=8,
    )
    for number, body in enumerate(settings.bodies):
        _add(spec, number, body)
    _light(spec, settings)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of textures, which are not drawn
            model = spec.compile()
    except ValueError as error:
        line = " ".join(str(error).split())
        raise RobotDescriptionError(f"MuJoCo cannot draw the robot: {line}") from None
    visual = model.vis
    visual.global_.offwidth, visual.global_.offheight = settings.width, settings.height
    visual.global_.fovy = math.degrees(FIELD)
    visual.quality.shadowsize, visual.quality.offsamples = _SHADOW, _SAMPLES
    visual.headlight.ambient[:], visual.headlight.diffuse[:] = 0.60, 0.18
    visual.headlight.specular[:] = 0.02
    model.stat.extent = settings.view.distance
    model.stat.center[:] = settings.view.target
    visual.map.znear, visual.map.zfar = NEAREST, FARTHEST
    return model


def _add(spec: Any, number: int, body: Body) -> None:
    size, mesh = body.size, {}
    if body.form == "box":
        size = tuple(edge / 2.0 for edge in size)
    elif body.form == "cylinder":
        size = (size[0], size[1] / 2.0, 0.0)
    elif body.form == "sphere":
        size = (size[0], 0.0, 0.0)
    else:
        name = f"mesh{number}"
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # an open one has no volume
        spec.add_mesh(name=name, scale=size, inertia=shell, **_source(body.mesh))
        size, mesh = (0.0, 0.0, 0.0), {"meshname": name}
    holder = spec.worldbody.add_body(name=f"body{number}", mocap=True)
    holder.add_geom(
        type=_FORMS[body.form],
        size=size,
        rgba=(*body.color, 1.0),
        contype=0,
        conaffinity=0,
        **mesh,
    )


def _source(file: Path | None) -> dict[str, Any]:
    """Return where a mesh comes from, as MuJoCo takes it."""
    if file is None or file.suffix.lower() != ".obj":
        return {"file": str(file)}
    corners, triangles = triangles_of(file)
    return {"uservert": corners.ravel().tolist(), "userface": triangles.ravel().tolist()}


def _light(spec: Any, settings: StageSettings) -> None:
    view = settings.view
    c, s = math.cos(view.azimuth), math.sin(view.azimuth)
    away, aside, up = LIGHT
    towards = np.array([away * c - aside * s, away * s + aside * c, up])
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=np.asarray(view.target) + view.distance * towards,
        dir=-towards,
        castshadow=settings.is_lit,
        diffuse=(0.32, 0.32, 0.32),
        specular=(0.05, 0.05, 0.05),
    )


def _camera(settings: StageSettings) -> Any:
    camera, view = mujoco.MjvCamera(), settings.view
    camera.lookat[:] = view.target
    camera.distance = view.distance
    camera.azimuth = math.degrees(view.azimuth) + 180.0  # where it looks, not where it stands
    camera.elevation = -math.degrees(view.elevation)
    return camera


def _gl_context(width: int, height: int) -> Any:
    """Return a context of OpenGL that needs no screen.

    MuJoCo chooses one when it is imported, by an environment variable; its parts do not ask.
    """
    is_mesa = os.environ.get("PYOPENGL_PLATFORM") == "osmesa" or not ctypes.util.find_library(
        "EGL"
    )
    try:
        if is_mesa:
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    # PyOpenGL fails by whatever it trips over where the system's library is not there.
    except Exception as error:
        _logger.debug("no OpenGL: %r", error)
        raise LibraryError(
            "MuJoCo finds no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri (or "
            "libosmesa6), or draw with PyBullet, which needs none (pip install pybullet)"
        ) from None
