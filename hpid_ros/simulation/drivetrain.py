"""All drives of a world, between the efforts and Bullet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hpid_ros.robot.joints import JointDescription
from hpid_ros.simulation.bullet import pybullet
from hpid_ros.simulation.drives import Drive
from hpid_ros.simulation.scene import Scene
from hpid_ros.simulation.settings import WorldSettings


class Drivetrain:
    """Turns the efforts of one control period into torques, physics step by physics step.

    The friction of motors and gears joins the joints' own in Bullet's solver: viscous friction as
    joint damping, Coulomb friction and the gears' loss as an implicit constraint with a largest
    torque, which sticks truly and cannot chatter about zero speed.

    Args:
        client: PyBullet's client.
        scene: The robot.
        settings: Settings of the world.
        joints: The driven joints, in the settings' order.

    Raises:
        SettingError: A drive does not fit its joint.
    """

    def __init__(
        self,
        client: int,
        scene: Scene,
        settings: WorldSettings,
        joints: Sequence[JointDescription],
    ) -> None:
        self._client, self._scene = client, scene
        self._period_ns, self._steps = settings.control_period_ns, settings.physics_steps
        self._drives = [
            Drive(drive, joint, settings.physics_period)
            for drive, joint in zip(settings.drives, joints, strict=True)
        ]
        self._has_gear_loss = any(drive.has_gear_loss for drive in settings.drives)
        for index, drive in zip(scene.driven, self._drives, strict=True):
            pybullet.changeDynamics(
                scene.body, index, jointDamping=drive.damping, physicsClientId=client
            )
        self._set_brakes([drive.friction for drive in self._drives])

    def reset(self) -> None:
        """Forget the past of every drive."""
        for drive in self._drives:
            drive.reset()

    def step(
        self, period: int, efforts: Sequence[float], advance: Callable[[Sequence[float]], None]
    ) -> tuple[float, ...]:
        """Drive one control period.

        Args:
            period: Its number.
            efforts: Within the joints' limits, in [N m].
            advance: Takes one physics step with these torques.

        Returns:
            The mean torque of each motor at its joint, in [N m].
        """
        for drive, effort in zip(self._drives, efforts, strict=True):
            drive.command(effort)
        sums = [0.0] * len(self._drives)
        for step in range(self._steps):
            # Rounded up, so that a cycle of the bridge that begins with a step is seen in it.
            time_ns = period * self._period_ns - (-step * self._period_ns // self._steps)
            velocities = self._velocities()
            torques = [
                drive.torque(time_ns, velocity)
                for drive, velocity in zip(self._drives, velocities, strict=True)
            ]
            if self._has_gear_loss:
                each = zip(self._drives, torques, velocities, strict=True)
                self._set_brakes([drive.brake(torque, speed) for drive, torque, speed in each])
            advance(torques)
            sums = [total + torque for total, torque in zip(sums, torques, strict=True)]
        return tuple([total / self._steps for total in sums])

    def _velocities(self) -> list[float]:
        states = pybullet.getJointStates(
            self._scene.body, self._scene.driven, physicsClientId=self._client
        )
        return [state[1] for state in states]

    def _set_brakes(self, frictions: Sequence[float]) -> None:
        pybullet.setJointMotorControlArray(
            self._scene.body,
            self._scene.driven,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[0.0] * len(frictions),
            forces=frictions,
            physicsClientId=self._client,
        )
