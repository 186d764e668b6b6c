"""Pictures of bodies by MuJoCo's renderer, on OpenGL without a screen: EGL or OSMesa."""

from __future__ import annotations

import ctypes.util
import logging
import math
import os
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hpid_ros.base.errors import LibraryError, RobotDescriptionError
from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.shapes import Shape

FIELD = math.radians(30.0)
"""Angle from a picture's lower to its upper edge, in [rad]."""
_NEAREST, _FARTHEST = 0.016, 4.0  # nothing beyond is drawn; over the distance of the camera
_LIGHT = (0.35, -0.5, 1.0)  # to the light, about z from the camera's azimuth: x to it, z up
_SHADOW = 2048  # pixels of the shadow map, along an edge
_SAMPLES = 4  # for each pixel
_MOST_SHAPES = 10_000
_FLOOR, _THICKNESS = (0.93, 0.94, 0.96, 1.0), 0.004
_FORMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_logger = logging.getLogger(__name__)

Pixels = NDArray[np.uint8]
"""A picture: rows from above, columns, red green blue."""


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


class Stage:
    """Bodies on a floor before a white background, and a camera.

    A body's placement is x y z in [m] and a unit quaternion x y z w.
    """

    def __init__(self, bodies: Sequence[Sequence[Shape]], width: int, height: int) -> None:
        self._width, self._height = width, height
        self._context: Any = None
        self._renderer: Any = None
        self._camera = mujoco.MjvCamera()
        self._options = mujoco.MjvOption()
        self._model = _model(bodies, width, height)
        self._data = mujoco.MjData(self._model)

    def corners(self, placements: Numbers) -> Numbers:
        """Return points that enclose all bodies at N instants, (M, 3), in [m]."""
        middle, half = np.split(self._model.geom_aabb[1:, None], 2, axis=2)  # without the floor
        found = []
        for each in placements:
            self._place(each)
            turns = self._data.geom_xmat[1:].reshape(-1, 3, 3)
            offsets = np.einsum("gij,gcj->gci", turns, middle + half * _CORNERS)
            found.append(self._data.geom_xpos[1:, None] + offsets)
        return np.concatenate(found).reshape(-1, 3)

    def open(self, view: View, floor: tuple[float, float, float], radius: float) -> None:
        """Set camera and floor: its middle, and how far from there bodies are at most, in [m]."""
        model, camera = self._model, self._camera
        model.stat.extent, model.stat.center[:] = view.distance, view.target
        # None of the floor's edges but the far one is seen, which is parallel to the picture.
        model.geom_size[0] = 1.8 * radius, 6.0 * radius, _THICKNESS / 2.0
        model.geom_sameframe[0] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # it is moved here
        model.geom_pos[0] = floor - np.array([0.0, 0.0, _THICKNESS / 2.0])
        model.geom_quat[0] = math.cos(view.azimuth / 2.0), 0.0, 0.0, math.sin(view.azimuth / 2.0)
        light = Rotation.from_euler("z", view.azimuth).apply(_LIGHT)
        model.light_pos[0], model.light_dir[0] = view.target + view.distance * light, -light
        camera.lookat[:], camera.distance = view.target, view.distance
        camera.azimuth = math.degrees(view.azimuth) + 180.0  # where it looks, not where it stands
        camera.elevation = -math.degrees(view.elevation)
        self._scene = mujoco.MjvScene(model, _MOST_SHAPES)
        # Meshes of which some faces are the wrong way round are common.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False
        self._context = gl_context(self._width, self._height)
        self._context.make_current()
        self._renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)

    def draw(self, placements: Numbers) -> Pixels:
        """Return a picture."""
        self._place(placements)
        mujoco.mj_camlight(self._model, self._data)
        parts = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._camera, parts, self._scene
        )
        rectangle = mujoco.MjrRect(0, 0, self._width, self._height)
        pixels = np.empty((self._height, self._width, 3), dtype=np.uint8)
        self._context.make_current()
        mujoco.mjr_render(rectangle, self._scene, self._renderer)
        mujoco.mjr_readPixels(pixels, None, rectangle, self._renderer)
        return pixels[::-1]

    def close(self) -> None:
        """Free OpenGL; a second call does nothing."""
        for each in (self._renderer, self._context):
            if each is not None:
                each.free()
        self._renderer = self._context = None

    def _place(self, placements: Numbers) -> None:
        self._data.mocap_pos[:] = placements[:, :3]
        self._data.mocap_quat[:] = placements[:, [6, 3, 4, 5]]
        mujoco.mj_kinematics(self._model, self._data)


def _model(bodies: Sequence[Sequence[Shape]], width: int, height: int) -> Any:
    """Return a model in which each body hangs on nothing and is put where it is told."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    white = (1.0, 1.0, 1.0)  # without a sky the background is black
    sky, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_FLAT
    spec.add_texture(name="sky", type=sky, builtin=flat, rgb1=white, rgb2=white, width=8, height=8)
    spec.worldbody.add_geom(type=_FORMS["box"], size=(1.0, 1.0, 1.0), rgba=_FLOOR)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=(0.32, 0.32, 0.32),
        specular=(0.05, 0.05, 0.05),
    )
    for shapes in bodies:
        body = spec.worldbody.add_body(mocap=True)
        for shape in shapes:
            _add(spec, body, shape)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of textures, which are not drawn
            model = spec.compile()
    except ValueError as error:
        line = " ".join(str(error).split())
        raise RobotDescriptionError(f"MuJoCo cannot draw the robot: {line}") from None
    visual = model.vis
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.global_.fovy = math.degrees(FIELD)
    visual.quality.shadowsize, visual.quality.offsamples = _SHADOW, _SAMPLES
    visual.headlight.ambient[:], visual.headlight.diffuse[:] = 0.60, 0.18
    visual.headlight.specular[:] = 0.02
    visual.map.znear, visual.map.zfar = _NEAREST, _FARTHEST
    return model


def _add(spec: Any, body: Any, shape: Shape) -> None:
    size, mesh = shape.size, {}
    if shape.form == "box":
        size = tuple(edge / 2.0 for edge in size)
    elif shape.form == "cylinder":
        size = (size[0], size[1] / 2.0, 0.0)
    elif shape.form == "sphere":
        size = (size[0], 0.0, 0.0)
    else:
        name = f"mesh{len(spec.meshes)}"
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # an open one has no volume
        spec.add_mesh(name=name, scale=size, inertia=shell, **_source(shape.mesh))
        size, mesh = (0.0, 0.0, 0.0), {"meshname": name}
    x, y, z, w = Rotation.from_matrix(shape.rotation).as_quat()
    body.add_geom(
        type=_FORMS[shape.form],
        size=size,
        pos=shape.position,
        quat=(w, x, y, z),
        rgba=shape.color,
        contype=0,
        conaffinity=0,
        **mesh,
    )


def _source(file: Path | None) -> dict[str, Any]:
    """Return where a mesh comes from; MuJoCo takes three corners of each face of an .obj."""
    if file is None or file.suffix.lower() != ".obj":
        return {"file": str(file)}
    corners, triangles = triangles_of(file)
    return {"uservert": corners.ravel().tolist(), "userface": triangles.ravel().tolist()}


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
                numbers = [int(word.partition("/")[0]) for word in words]
                # Counted from 1, or backwards from those before it.
                first, *rest = (n - 1 if n > 0 else len(corners) + n for n in numbers)
                faces += [(first, one, other) for one, other in pairwise(rest)]
        found = np.array(corners).reshape(-1, 3), np.array(faces, dtype=np.int32).reshape(-1, 3)
        if not faces or not 0 <= found[1].min() <= found[1].max() < len(corners):
            raise ValueError("no faces, or of corners that are not there")
    except (OSError, ValueError) as error:
        raise RobotDescriptionError(f"cannot read mesh {file}: {error}") from None
    return found


def gl_context(width: int, height: int) -> Any:
    """Return a context of OpenGL that needs no screen.

    MuJoCo chooses one when it is imported, by an environment variable; its parts do not ask.
    """
    is_mesa = os.environ.get("PYOPENGL_PLATFORM") == "osmesa"
    try:
        if is_mesa or not ctypes.util.find_library("EGL"):
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    # PyOpenGL fails by whatever it trips over where the system's library is not there.
    except Exception as error:
        _logger.debug("no OpenGL: %r", error)
        raise LibraryError(
            "MuJoCo finds no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri (or "
            "libosmesa6)"
        ) from None
