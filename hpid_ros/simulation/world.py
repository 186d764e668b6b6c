"""The simulated robot: efforts in, measured positions out, one control period at a time."""

from __future__ import annotations

import math
import random
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import mul
from types import TracebackType
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import Vector
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.simulation.drives import Drive
from hpid_ros.simulation.gripper import Gripper
from hpid_ros.simulation.physics import Physics, Pose, Twist, require_meshes
from hpid_ros.simulation.settings import (
    Event,
    PayloadChange,
    VelocityFilter,
    WorldSettings,
    checked_vector,
    require_engine,
    require_mass,
)


class Drivetrain:
    """Turns the efforts of one control period into torques, physics step by physics step.

    The friction of motors and gears joins the joints' own in the engine's solver: viscous friction
    as joint damping, Coulomb friction and the gears' loss as what a joint is braked with.
    """

    def __init__(
        self, physics: Physics, settings: WorldSettings, joints: Sequence[JointDescription]
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

    def reset(self, efforts: Sequence[float]) -> None:
        for drive, effort in zip(self._drives, efforts or [0.0] * len(self._drives), strict=True):
            drive.reset(effort)

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
        self._reports = [
            VelocityReport(each, position, stream(settings.seed, "velocity", joint))
            for each, position, joint in zip(
                settings.velocity_filters, start, settings.joints, strict=False
            )
        ]
        self.offsets = [0.0] * len(settings.joints)
        """What the readings are wrong by since homing, in [rad]."""
        for index, homing in enumerate(settings.homing):
            if homing is not None:
                chance = stream(settings.seed, "homing", settings.joints[index])
                self.offsets[index] = homing.error(
                    start[index], self._period, self._encoders[index], chance
                )
        self.positions = self._read(start)
        """Measured positions, in [rad]."""
        self.velocities = (0.0,) * len(start) if self._has_differences else None
        """Measured velocities, in [rad/s]; None where none are."""

    def sample(self, positions: Sequence[float]) -> None:
        """Measure once; called once a control period."""
        before, self.positions = self.positions, self._read(positions)
        if self._has_differences and self._reports:
            each = zip(self._reports, self.positions, positions, strict=True)
            self.velocities = tuple(
                [report.update(seen, true, self._period) for report, seen, true in each]
            )
        elif self._has_differences:
            self.velocities = tuple(
                [
                    (now - then) / self._period
                    for now, then in zip(self.positions, before, strict=True)
                ]
            )

    def _read(self, positions: Sequence[float]) -> tuple[float, ...]:
        each = zip(
            self._encoders, positions, self._noise, self._chances, self.offsets, strict=True
        )
        return tuple(
            [
                encoder.read(position + (noise * chance.gauss(0.0, 1.0) if noise else 0.0)) + off
                for encoder, position, noise, chance, off in each
            ]
        )


class VelocityReport:
    """A joint's velocity as its driver reports it: differences behind a filter of its own."""

    def __init__(self, how: VelocityFilter, start: float, chance: random.Random) -> None:
        self._how, self._chance, self._before = how, chance, start
        self._inputs = deque([0.0] * len(how.forward), maxlen=len(how.forward))
        self._outputs = deque([0.0] * len(how.back), maxlen=len(how.back))

    def update(self, seen: float, true: float, period: float) -> float:
        """Return the next velocity, in [rad/s], from a measured and a true position, in [rad]."""
        how = self._how
        position = true if how.noise is not None else seen
        self._inputs.appendleft((position - self._before) / period)
        self._before = position
        value = sum(map(mul, how.forward, self._inputs))
        value -= sum(map(mul, how.back, self._outputs))
        self._outputs.appendleft(value)
        return value + self._chance.gauss(0.0, how.noise) if how.noise else value


def stream(seed: int, purpose: str, joint: str) -> random.Random:
    """Return a joint's own source of chance, the same in every process."""
    return random.Random(f"{seed} {purpose} {joint}")


class Pulse(NamedTuple):
    """A wrench under way."""

    link: str  # name of the link
    force: Vector  # [N] on the origin of its frame, in the world frame
    torque: Vector  # [N m] in the world frame
    steps_left: int  # physics steps that it still acts


class DisturbanceSchedule:
    """The schedule of a world, and what is asked for besides."""

    def __init__(
        self, physics: Physics, description: RobotDescription, settings: WorldSettings
    ) -> None:
        self._physics = physics
        self._description, self._settings = description, settings
        self.begin()

    def begin(self) -> None:
        """Be at time 0, with nothing done yet."""
        self._pulses: list[Pulse] = []
        self._pending: list[Event] = self._settings.disturbances.in_order()[::-1]

    @property
    def is_pushing(self) -> bool:
        return bool(self._pulses)

    def advance(self, now_ns: int) -> None:
        while self._pending and self._pending[-1].start_ns <= now_ns:
            event = self._pending.pop()
            if isinstance(event, PayloadChange):
                self.load(event.mass)
            else:
                self.push(event.link, event.force, event.torque, event.duration_ns)

    def apply(self) -> None:
        """Apply all pushes to the next physics step, and drop those that are over."""
        for pulse in self._pulses:
            self._physics.push(pulse.link, pulse.force, pulse.torque)
        if self._pulses:
            left = (pulse._replace(steps_left=pulse.steps_left - 1) for pulse in self._pulses)
            self._pulses = [pulse for pulse in left if pulse.steps_left]

    def push(
        self, link: str, force: Sequence[float], torque: Sequence[float], duration_ns: int
    ) -> None:
        settings = self._settings
        steps = round(duration_ns * settings.physics_steps / settings.control_period_ns)
        name = self._description.link(link)
        pulse = Pulse(
            name, checked_vector("force", force), checked_vector("torque", torque), max(1, steps)
        )
        self._pulses.append(pulse)

    def load(self, mass: float) -> None:
        self._description.link(self._settings.payload_link)
        self._physics.load(require_mass("payload_mass", mass))


class World:
    """A robot in a physics engine, driven by joint torques.

    There is no control inside. The same sequence of calls gives the same numbers to the last
    bit, in any process. Joints that are not driven move freely against their friction. At time 0
    the robot rests, as :class:`~hpid_ros.simulation.physics.Physics` says.
    """

    def __init__(
        self, settings: WorldSettings, description: RobotDescription | None = None
    ) -> None:
        """Build the robot; ``description`` is that of the settings, where it is loaded already."""
        self.settings = settings
        self.description = description or RobotDescription.load(settings.robot_description)
        self.description.require_sound()
        joints = self.description.select(settings.joints)
        settings.start(self.description)
        self._limits = [min(joint.effort, sys.float_info.max) for joint in joints]
        self._encoders = settings.encoders
        for link in settings.links:
            self.description.link(link)
        self._states: Sequence[Sequence[float]] | None = None
        self._physics = build_physics(settings, self.description)
        try:
            self._drivetrain = (
                None if settings.has_ideal_drives else Drivetrain(self._physics, settings, joints)
            )
        except BaseException:
            self.close()
            raise
        self._schedule = DisturbanceSchedule(self._physics, self.description, settings)
        self._physics.keep()
        self._begin()

    def __enter__(self) -> World:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the engine; a second call does nothing."""
        self._physics.close()

    def reset(self, seed: int | None = None) -> None:
        """Go back to time 0; what follows is what would follow in a fresh world."""
        if seed is not None:
            self.settings = replace(self.settings, seed=seed)
        self._encoders = self.settings.encoders
        self._physics.restart()
        self._begin()

    @property
    def time_ns(self) -> int:
        """Simulated time, a whole number of control periods, in [ns]."""
        return self._periods * self.settings.control_period_ns

    def read(self) -> tuple[float, ...]:
        """Return the encoders' positions of the driven joints, in [rad]."""
        if self._sensors is not None:
            return self._sensors.positions
        return tuple(
            [
                encoder.read(state[0])
                for encoder, state in zip(self._encoders, self._joint_states(), strict=True)
            ]
        )

    def read_velocities(self) -> tuple[float, ...] | None:
        """Return the measured velocities of the driven joints, in [rad/s]; None if unmeasured."""
        return None if self._sensors is None else self._sensors.velocities

    def true_positions(self) -> tuple[float, ...]:
        """Return the exact positions of the driven joints, in [rad]."""
        return tuple([state[0] for state in self._joint_states()])

    def true_velocities(self) -> tuple[float, ...]:
        """Return the exact velocities of the driven joints, in [rad/s]."""
        return tuple([state[1] for state in self._joint_states()])

    def applied_efforts(self) -> tuple[float, ...]:
        """Return what the motors gave in the last control period, in [N m]; 0 at time 0.

        It is at the joint, their mean over the period; friction and gear loss are not taken off.
        """
        return self._applied

    def step(self, efforts: Sequence[float]) -> None:
        """Advance by one control period; the efforts stand in every physics step of it.

        Args:
            efforts: Commanded effort of each driven joint, in [N m]; held to the URDF's limits.

        Raises:
            SettingError: There is not one finite effort for each driven joint.
        """
        torques = self._held(efforts)
        self._schedule.advance(self.time_ns)
        if self.gripper is not None:
            self.gripper.actuate(self.time_ns)
        if self._drivetrain is None:
            self._advance(torques, self.settings.physics_steps)
            self._applied = tuple(torques)
        else:
            self._applied = self._drivetrain.step(self._periods, torques, self._advance)
        self._periods += 1
        self._states = None
        if self.gripper is not None:
            self.gripper.update(self.time_ns)
        if self._sensors is not None:
            self._sensors.sample(self.true_positions())

    def _held(self, efforts: Sequence[float]) -> list[float]:
        """Return efforts held to what the joints' motors can give, in [N m]."""
        if len(efforts) != len(self._limits):
            raise SettingError(f"{len(efforts)} efforts for {len(self._limits)} driven joints")
        held = [float(effort) for effort in efforts]
        for index, (effort, limit) in enumerate(zip(held, self._limits, strict=True)):
            if not -limit <= effort <= limit:
                if not math.isfinite(effort):
                    name = self.settings.joints[index]
                    raise SettingError(f"effort {effort} of joint {name!r} is not finite")
                held[index] = math.copysign(limit, effort)
        return held

    def link_pose(self, name: str) -> Pose:
        """Return the pose of a link's frame."""
        return self._physics.link_pose(self.description.link(name))

    def base_pose(self) -> Pose:
        """Return the pose of the robot's root link."""
        return self._physics.root_pose()

    def base_velocity(self) -> Twist:
        """Return the velocity of the robot's root link, in that link's frame."""
        return self._physics.root_twist()

    def apply_wrench(
        self, link: str, force: Sequence[float], torque: Sequence[float], duration_ns: int
    ) -> None:
        """Push a link from the next step on."""
        if duration_ns <= 0:
            raise SettingError(f"duration {duration_ns} ns of a wrench must be positive")
        self._schedule.push(link, force, torque, duration_ns)

    def set_payload(self, mass: float) -> None:
        """Change the payload, a solid cube at the payload link; until the next reset."""
        self._schedule.load(mass)

    def _begin(self) -> None:
        self._periods = 0
        self._applied = (0.0,) * len(self.settings.joints)
        self._states = None
        self._schedule.begin()
        settings = self.settings
        self.gripper: Gripper | None = None
        if settings.workplace.bricks:
            self.gripper = Gripper(self._physics, settings.workplace, settings.physics_period)
        if self._drivetrain is not None:
            self._drivetrain.reset(settings.initial_efforts)
        is_bare = self.settings.has_bare_encoders
        self._sensors: Sensors | None = (
            None if is_bare else Sensors(self.settings, self.true_positions())
        )

    def _joint_states(self) -> Sequence[Sequence[float]]:
        """Return the states of the driven joints, asked for once a period."""
        states = self._states
        if states is None:
            states = self._states = self._physics.joint_states()
        return states

    def _advance(self, torques: Sequence[float], steps: int = 1) -> None:
        """Take physics steps with these torques at the driven joints, in [N m]."""
        if self.gripper is None and not self._schedule.is_pushing:
            self._physics.advance(torques, steps)
            return
        for _ in range(steps):
            self._schedule.apply()
            self._physics.advance(torques)
            if self.gripper is not None:
                self.gripper.sample_contacts()


def build_physics(settings: WorldSettings, description: RobotDescription) -> Physics:
    """Return the engine of a world, at time 0."""
    require_engine(settings.engine)
    require_meshes(description, settings.is_touched)
    # Imported where it is asked for: either takes a while, and one of them may not be installed.
    if settings.engine == "mujoco":
        from hpid_ros.simulation.mujoco import MujocoPhysics

        return MujocoPhysics(settings, description)
    from hpid_ros.simulation.bullet import BulletPhysics

    return BulletPhysics(settings, description)
