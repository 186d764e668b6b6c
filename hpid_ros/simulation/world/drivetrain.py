"""All drives and sensors of a world, between the robot's board and the physics."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable, Sequence

from hpid_ros.base.errors import SettingError
from hpid_ros.robot.description import JointDescription
from hpid_ros.simulation.drives import Drive
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.physics import Physics


class EffortLimits:
    """Holds efforts to what the joints' motors can give."""

    def __init__(self, joints: Sequence[JointDescription]) -> None:
        self._joints = joints
        self._limits = [min(joint.effort, sys.float_info.max) for joint in joints]

    def hold(self, efforts: Sequence[float]) -> list[float]:
        """Return the torques at the joints for their commanded efforts, all in [N m]."""
        if len(efforts) != len(self._limits):
            raise SettingError(f"{len(efforts)} efforts for {len(self._limits)} driven joints")
        held = [float(effort) for effort in efforts]
        for index, (effort, limit) in enumerate(zip(held, self._limits, strict=True)):
            if not -limit <= effort <= limit:
                if not math.isfinite(effort):
                    name = self._joints[index].name
                    raise SettingError(f"effort {effort} of joint {name!r} is not finite")
                held[index] = math.copysign(limit, effort)
        return held


class Drivetrain:
    """Turns the efforts of one control period into torques, physics step by physics step.

    The friction of motors and gears joins the joints' own in the engine's solver: viscous friction
    as joint damping, Coulomb friction and the gears' loss as what a joint is braked with.
    """

    def __init__(
        self,
        physics: Physics,
        settings: WorldSettings,
        joints: Sequence[JointDescription],
    ) -> None:
        self._physics = physics
        self._period_ns, self._steps = settings.control_period_ns, settings.physics_steps
        self._drives = [
            Drive(drive, joint, settings.physics_period)
            for drive, joint in zip(settings.drives, joints, strict=True)
        ]
        self._has_gear_loss = any(drive.has_gear_loss for drive in settings.drives)
        physics.set_damping([drive.damping for drive in self._drives])
        physics.brake([drive.friction for drive in self._drives])

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
            velocities = [state[1] for state in self._physics.joint_states()]
            torques = [
                drive.torque(time_ns, velocity)
                for drive, velocity in zip(self._drives, velocities, strict=True)
            ]
            if self._has_gear_loss:
                each = zip(self._drives, torques, velocities, strict=True)
                self._physics.brake([drive.brake(torque, speed) for drive, torque, speed in each])
            advance(torques)
            sums = [total + torque for total, torque in zip(sums, torques, strict=True)]
        return tuple([total / self._steps for total in sums])


class Sensors:
    """Encoders with noise, with the zero that a homing run found, and with differences.

    What is drawn by chance comes from a stream of each joint's own, which neither the other
    joints nor the number of readings change.
    """

    def __init__(self, settings: WorldSettings, start: Sequence[float]) -> None:
        self._encoders = settings.encoders
        self._noise = settings.position_noises
        self._chances = [stream(settings.seed, "noise", joint) for joint in settings.joints]
        self._period = settings.control_period_ns * 1e-9
        self._has_differences = settings.velocity == "differences"
        self._offsets = [0.0] * len(settings.joints)
        for index, homing in enumerate(settings.homings):
            if homing is not None:
                chance = stream(settings.seed, "homing", settings.joints[index])
                self._offsets[index] = homing.error(
                    start[index], self._period, self._encoders[index], chance
                )
        self.positions = self._read(start)
        """Measured positions, in [rad]."""
        self.velocities = (0.0,) * len(start) if self._has_differences else None
        """Measured velocities, in [rad/s]; None where none are."""

    @property
    def offsets(self) -> tuple[float, ...]:
        """What the readings are wrong by since homing, in [rad]."""
        return tuple(self._offsets)

    def sample(self, positions: Sequence[float]) -> None:
        """Measure once; called once a control period."""
        before, self.positions = self.positions, self._read(positions)
        if self._has_differences:
            self.velocities = tuple(
                [
                    (now - then) / self._period
                    for now, then in zip(self.positions, before, strict=True)
                ]
            )

    def _read(self, positions: Sequence[float]) -> tuple[float, ...]:
        each = zip(
            self._encoders, positions, self._noise, self._chances, self._offsets, strict=True
        )
        return tuple(
            [
                encoder.read(position + (noise * chance.gauss(0.0, 1.0) if noise else 0.0)) + off
                for encoder, position, noise, chance, off in each
            ]
        )


def stream(seed: int, purpose: str, joint: str) -> random.Random:
    """Return a joint's own source of chance, the same in every process."""
    return random.Random(f"{seed} {purpose} {joint}")
