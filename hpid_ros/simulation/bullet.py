"""A robot in PyBullet, as a world asks for it."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.base.units import Vector
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.bullet_scene import (
    Client,
    Scene,
    box_pose,
    brake_joints,
    build_scene,
    bullet_urdf,
    pybullet,
)
from hpid_ros.simulation.physics import Pose, Twist
from hpid_ros.simulation.settings import WorldSettings

_ROOT = -1  # Bullet's index of a robot's root link
_UNYIELDING = 1e5  # [N], far beyond any grip: the constraint itself never gives way


class BulletPhysics:
    """:class:`~hpid_ros.simulation.physics.Physics` in a PyBullet of its own."""

    def __init__(self, settings: WorldSettings, description: RobotDescription) -> None:
        self._settings, self._description = settings, description
        self._urdf = bullet_urdf(description, is_shown=settings.gui)
        self._client = Client(settings.gui)
        self._damping: Sequence[float] | None = None
        self._brakes: Sequence[float] | None = None
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def _build(self) -> None:
        self._held: int | None = None  # the constraint
        self._scene: Scene = build_scene(
            self._client, self._urdf, self._description, self._settings
        )

    def joint_states(self) -> Sequence[tuple[float, float]]:
        states: Sequence[tuple[float, float]] = self._client.getJointStates(
            self._scene.body, self._scene.driven
        )
        return states

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        for _ in range(steps):
            # Bullet forgets applied torques after every step.
            self._client.setJointMotorControlArray(
                self._scene.body, self._scene.driven, pybullet.TORQUE_CONTROL, forces=torques
            )
            self._client.stepSimulation()

    def set_damping(self, damping: Sequence[float]) -> None:
        self._damping = damping
        for index, value in zip(self._scene.driven, damping, strict=True):
            self._client.changeDynamics(self._scene.body, index, jointDamping=value)

    def brake(self, forces: Sequence[float]) -> None:
        """Set the Coulomb friction of each driven joint.

        It is an implicit constraint with a largest torque, which sticks truly and cannot chatter
        about zero speed.
        """
        self._brakes = forces
        brake_joints(self._client, self._scene.body, self._scene.driven, forces)

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        client, body, index = self._client, self._scene.body, self._scene.links[link]
        origin, centre = self._pose(index).position, self._centre_of_mass(index)
        x, y, z = (a - b for a, b in zip(origin, centre, strict=True))
        fx, fy, fz = force
        tx, ty, tz = torque
        client.applyExternalForce(body, index, force, centre, pybullet.WORLD_FRAME)
        client.applyExternalTorque(
            body,
            index,
            (tx + y * fz - z * fy, ty + z * fx - x * fz, tz + x * fy - y * fx),
            pybullet.WORLD_FRAME,
        )

    def load(self, mass: float) -> None:
        self._scene.load_payload(self._client, mass)

    def link_pose(self, link: str) -> Pose:
        return self._pose(self._scene.links[link])

    def root_pose(self) -> Pose:
        return self._pose(_ROOT)

    def root_twist(self) -> Twist:
        client = self._client
        origin, orientation = self._pose(_ROOT)
        (vx, vy, vz), angular = client.getBaseVelocity(self._scene.body)
        wx, wy, wz = angular
        x, y, z = (a - b for a, b in zip(origin, self._centre_of_mass(_ROOT), strict=True))
        linear = (vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x)
        _, inverse = client.invertTransform((0.0, 0.0, 0.0), orientation)
        return Twist(client.rotateVector(inverse, linear), client.rotateVector(inverse, angular))

    def brick_pose(self, index: int) -> Pose:
        return box_pose(self._client, self._scene.bricks[index])

    def hold(self, index: int) -> None:
        robot, body, client = self._scene.body, self._scene.bricks[index], self._client
        link = self._scene.links[self._settings.workplace.gripper.link]
        # Bullet wants the frame as the link's centre of mass sees it.
        state = client.getLinkState(robot, link)
        inverse = client.invertTransform(state[0], state[1])
        brick = box_pose(client, body)
        position, orientation = client.multiplyTransforms(
            *inverse, brick.position, brick.orientation
        )
        self._held = client.createConstraint(
            robot,
            link,
            body,
            -1,
            pybullet.JOINT_FIXED,
            (0.0, 0.0, 0.0),
            position,
            (0.0, 0.0, 0.0),
            orientation,
        )
        client.changeConstraint(self._held, maxForce=_UNYIELDING)

    def release(self) -> None:
        if self._held is not None:
            self._client.removeConstraint(self._held)
        self._held = None

    def grip_force(self) -> Vector:
        state = self._client.getConstraintState(self._held)
        return state[0], state[1], state[2]

    def keep(self) -> None:
        self._at_start: int = self._client.saveState()

    def restart(self) -> None:
        if self._scene.bricks:
            # Of bricks that were moved Bullet keeps contacts that are not in the saved state.
            self._client.removeState(self._at_start)
            self._client.resetSimulation()
            self._build()
            if self._damping is not None and self._brakes is not None:
                self.set_damping(self._damping)
                self.brake(self._brakes)
            self.keep()
            return
        if self._scene.payload is not None:
            self.load(self._settings.payload_mass)
        self._client.restoreState(self._at_start)

    def close(self) -> None:
        self._client.close()

    def _pose(self, index: int) -> Pose:
        """Return the pose of a link's URDF frame."""
        client, body = self._client, self._scene.body
        if index != _ROOT:
            state = client.getLinkState(body, index)
            return Pose(state[4], state[5])
        # Of the root Bullet gives the principal frame at the centre of mass.
        centre = client.getBasePositionAndOrientation(body)
        frame = client.invertTransform(*client.getDynamicsInfo(body, _ROOT)[3:5])
        return Pose(*client.multiplyTransforms(*centre, *frame))

    def _centre_of_mass(self, index: int) -> Vector:
        """Return a link's centre of mass in the world, in [m]."""
        body = self._scene.body
        if index == _ROOT:
            centre: Vector = self._client.getBasePositionAndOrientation(body)[0]
        else:
            centre = self._client.getLinkState(body, index)[0]
        return centre
