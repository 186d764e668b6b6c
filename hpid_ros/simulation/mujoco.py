"""A robot in MuJoCo, as a world asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from hpid_ros.base.errors import RunError
from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.mujoco_model import build_model, soften
from hpid_ros.simulation.physics import PAYLOAD_EDGE, SETTLING_TIME, Pose, Twist, require_staying
from hpid_ros.simulation.settings import WorldSettings

_LOCK = 1e6  # [N m]
_FAR = 1e3  # [m]
_KEPT = ("body_mass", "body_inertia", "dof_damping", "dof_frictionloss")


_failures: list[str] = []
_BENIGN = "Linesearch"  # a step of the solver that it repairs itself


def _note(text: str) -> None:
    """Take a warning of MuJoCo, which would write it into a file of the working folder."""
    if not text.startswith(_BENIGN):
        _failures.append(" ".join(text.split()))


mujoco.set_mju_user_warning(_note)


class MujocoPhysics:
    """:class:`~hpid_ros.simulation.physics.Physics` in MuJoCo."""

    def __init__(self, settings: WorldSettings, description: RobotDescription) -> None:
        self._settings, self._description = settings, description
        self._built = build_model(settings, description)
        self.model: Any = self._built.model
        self.data: Any = mujoco.MjData(self.model)
        self._positions = np.array([self._built.positions[name] for name in settings.joints])
        self._velocities = np.array([self._built.velocities[name] for name in settings.joints])
        self._payload = self._built.links.get(settings.payload_link)
        if self._payload is not None:
            self._bare = (
                float(self.model.body_mass[self._payload]),
                self.model.body_inertia[self._payload].copy(),
            )
        self._root = self._built.links[description.root]
        self._held: int | None = None
        self._is_pushed = False
        self._is_current = True
        self._viewer: Any = None
        self._place()
        if settings.gui:
            self._show()

    def joint_states(self) -> Sequence[tuple[float, float]]:
        data = self.data
        positions, velocities = data.qpos[self._positions], data.qvel[self._velocities]
        return list(zip(positions.tolist(), velocities.tolist(), strict=True))

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        data = self.data
        data.qfrc_applied[self._velocities] = torques
        mujoco.mj_step(self.model, data, steps)
        if _failures:
            line = _failures[0]
            _failures.clear()
            raise RunError(f"MuJoCo: {line}")
        self._is_current = False
        if self._is_pushed:
            data.xfrc_applied[:] = 0.0
            self._is_pushed = False
        if self._viewer is not None:
            self._viewer.sync()

    def set_damping(self, damping: Sequence[float]) -> None:
        self.model.dof_damping[self._velocities] = damping

    def brake(self, forces: Sequence[float]) -> None:
        self.model.dof_frictionloss[self._velocities] = forces

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        self._follow()
        body = self._built.links[link]
        arm = self.data.xpos[body] - self.data.xipos[body]
        self.data.xfrc_applied[body, :3] += force
        self.data.xfrc_applied[body, 3:] += np.asarray(torque) + np.cross(arm, force)
        self._is_pushed = True

    def load(self, mass: float) -> None:
        body = self._payload
        own_mass, own_moments = self._bare
        self.model.body_mass[body] = own_mass + mass
        self.model.body_inertia[body] = own_moments + mass * PAYLOAD_EDGE**2 / 6.0
        self._renew()

    def link_pose(self, link: str) -> Pose:
        return self._pose(self._built.links[link])

    def root_pose(self) -> Pose:
        return self._pose(self._root)

    def root_twist(self) -> Twist:
        if self._settings.fixed_base:
            return Twist((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._follow()
        at = self.model.body_dofadr[self._root]
        linear, angular = self.data.qvel[at : at + 3], self.data.qvel[at + 3 : at + 6]
        turn = self.data.xmat[self._root].reshape(3, 3)
        return Twist(_vector(turn.T @ linear), _vector(angular))

    def brick_pose(self, index: int) -> Pose:
        return self._pose(self._built.bricks[index])

    def hold(self, index: int) -> None:
        self._follow()
        weld, model, data = self._built.welds[index], self.model, self.data
        hand = self._built.links[self._settings.workplace.gripper.link]
        brick = self._built.bricks[index]
        inverse, turn, place = np.empty(4), np.empty(4), np.empty(3)
        mujoco.mju_negQuat(inverse, data.xquat[hand])
        mujoco.mju_mulQuat(turn, inverse, data.xquat[brick])
        mujoco.mju_rotVecQuat(place, data.xpos[brick] - data.xpos[hand], inverse)
        # Anchor in the brick's frame, the brick's pose in the hand's, scale of the torque.
        model.eq_data[weld, :11] = (0.0, 0.0, 0.0, *place, *turn, 1.0)
        data.eq_active[weld] = 1
        self._held = weld

    def release(self) -> None:
        if self._held is not None:
            self.data.eq_active[self._held] = 0
        self._held = None

    def grip_force(self) -> Vector:
        data = self.data
        is_equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        rows = np.flatnonzero(is_equality & (data.efc_id == self._held))
        return _vector(data.efc_force[rows[:3]])

    def keep(self) -> None:
        data = self.data
        self._start = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
        self._constants = {name: getattr(self.model, name).copy() for name in _KEPT}

    def restart(self) -> None:
        for name, values in self._constants.items():
            getattr(self.model, name)[:] = values
        self._renew()
        self._begin(*self._start)

    def close(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
        self._viewer = self.data = None

    def _begin(self, positions: Numbers, velocities: Numbers, warm: Numbers) -> None:
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = positions, velocities, warm
        self._held, self._is_pushed, self._is_current = None, False, False

    def _renew(self) -> None:
        """Bring the constants of the model up to date with its masses."""
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        soften(self.model, self._built.touches)

    def _follow(self) -> None:
        """Bring the poses up to date with the positions; a step leaves those of its beginning."""
        if not self._is_current:
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            self._is_current = True

    def _pose(self, body: int) -> Pose:
        self._follow()
        w, x, y, z = self.data.xquat[body].tolist()
        return Pose(_vector(self.data.xpos[body]), (x, y, z, w))

    def _place(self) -> None:
        """Put everything where it is at time 0."""
        settings, built = self._settings, self._built
        start = settings.start(self._description)
        if settings.payload_mass:
            self.load(settings.payload_mass)
        nothing = np.zeros(self.model.nv)
        positions = self.model.qpos0.copy()
        for name, position in start.items():
            positions[built.positions[name]] = position
        self._begin(positions, nothing, nothing)
        if not settings.is_touched:
            return
        if not settings.fixed_base:
            self._put_on_ground()
        self._settle()
        for name, position in start.items():
            self.data.qpos[built.positions[name]] = position
        self._begin(self.data.qpos.copy(), nothing, nothing)
        for brick, body in zip(settings.workplace.bricks, built.bricks, strict=True):
            require_staying(brick, self._pose(body))

    def _put_on_ground(self) -> None:
        """Set the robot down so that its lowest point touches the ground."""
        mujoco.mj_kinematics(self.model, self.data)
        ground = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, "__ground")
        gaps = [
            mujoco.mj_geomDistance(self.model, self.data, shape, ground, _FAR, None)
            for shape in self._built.shapes
        ]
        if gaps:
            at = self.model.jnt_qposadr[self.model.body_jntadr[self._root]]
            self.data.qpos[at + 2] -= min(gaps)
            self._is_current = False

    def _settle(self) -> None:
        """Let the robot sink into its tyres with every joint locked."""
        model, joints = self.model, list(self._built.velocities.values())
        free = model.dof_frictionloss[joints].copy()
        model.dof_frictionloss[joints] = _LOCK
        for _ in range(max(1, round(SETTLING_TIME / self._settings.physics_period))):
            mujoco.mj_step(model, self.data)
        model.dof_frictionloss[joints] = free
        self._is_current = False

    def _show(self) -> None:
        import mujoco.viewer

        self._viewer = mujoco.viewer.launch_passive(self.model, self.data)


def _vector(values: Numbers) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
