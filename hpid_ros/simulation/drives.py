"""One joint's drive: what becomes of a commanded effort on its way to the joint.

In the order of the signal: the command arrives, late by whole control periods if the bus is
slow; the controller's board asks for a duty; the H-bridge gives it in steps and at its own rate;
the motor turns it into torque at its present speed; the gear multiplies it and takes its loss.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hpid_ros.errors import SettingError
from hpid_ros.robot.joints import JointDescription
from hpid_ros.simulation.motor import Motor
from hpid_ros.simulation.pwm import Pwm

LONGEST_DELAY = 1000  # control periods


@dataclass(frozen=True)
class DriveSettings:
    """What a joint's drive consists of.

    Attributes:
        motor: Its motor; None is an ideal source of torque.
        pwm: Its bridge; None gives any voltage, or without a motor any torque.
        delay: Control periods by which efforts act late.

    Raises:
        SettingError: The delay is out of its range.
    """

    motor: Motor | None = None
    pwm: Pwm | None = None
    delay: int = 0

    def __post_init__(self) -> None:
        whole = isinstance(self.delay, int) and not isinstance(self.delay, bool)
        if not (whole and 0 <= self.delay <= LONGEST_DELAY):
            raise SettingError(
                f"delay {self.delay!r} must be a whole number from 0 to {LONGEST_DELAY}"
            )

    @property
    def is_ideal(self) -> bool:
        """Whether the effort acts as it is, at once."""
        return self.motor is None and self.pwm is None and self.delay == 0

    @property
    def has_gear_loss(self) -> bool:
        """Whether the gear takes a part of the torque."""
        return self.motor is not None and self.motor.gear_efficiency < 1.0


class Drive:
    """A joint's drive in a run; its past is the efforts under way and the bridge's register.

    Args:
        settings: What it consists of.
        joint: The joint, whose gear ratio, effort limit and own friction count.
        physics_period: Time between two physics steps, in [s].

    Raises:
        SettingError: The bridge has neither a motor nor an effort limit to give a part of, or
            the motor is faster than the physics can follow.
    """

    def __init__(
        self, settings: DriveSettings, joint: JointDescription, physics_period: float
    ) -> None:
        self.settings = settings
        self._ratio = joint.gear_ratio
        self._limit = joint.effort
        motor = settings.motor
        if motor is None and settings.pwm is not None and not 0.0 < joint.effort < math.inf:
            raise SettingError(
                f"pwm of joint {joint.name!r} needs a motor or an effort limit in the URDF"
            )
        if motor is not None and joint.rotor_inertia > 0.0:
            time_constant = motor.time_constant(joint.rotor_inertia)
            if physics_period > time_constant:
                raise SettingError(
                    f"the motor of joint {joint.name!r} has a mechanical time constant of "
                    f"{time_constant:.2g} s, shorter than the physics step of "
                    f"{physics_period:.2g} s: use more physics_steps"
                )
        self.damping = joint.damping
        """Viscous friction of joint and motor, at the joint, in [N m s/rad]."""
        self.friction = joint.friction
        """Coulomb friction of joint and motor, at the joint, in [N m]; the gear's loss is more."""
        if motor is not None:
            self.damping += motor.viscous_friction * joint.gear_ratio**2
            self.friction += motor.coulomb_friction * abs(joint.gear_ratio)
        self.reset()

    def reset(self) -> None:
        """Forget the past: no effort is under way, and the bridge gives nothing."""
        self._under_way = deque([0.0] * self.settings.delay)
        self._effort = 0.0
        self._cycle = -1
        self._duty = 0.0

    def command(self, effort: float) -> None:
        """Take the effort of one control period.

        Args:
            effort: Within the joint's limit, in [N m].
        """
        self._under_way.append(effort)
        self._effort = self._under_way.popleft()

    def torque(self, time_ns: int, velocity: float) -> float:
        """Return the motor's torque in the next physics step, frictions not taken off.

        Args:
            time_ns: Simulated time, in [ns]; it does not go back between resets.
            velocity: Of the joint, in [rad/s].

        Returns:
            The torque at the joint, in [N m].
        """
        motor = self.settings.motor
        if motor is None:
            if self.settings.pwm is None:
                return self._effort
            return self._bridge(time_ns, self._effort / self._limit) * self._limit
        speed = self._ratio * velocity
        duty = motor.duty(self._effort / self._ratio, speed)
        return self._ratio * motor.torque(self._bridge(time_ns, duty), speed)

    def brake(self, torque: float, velocity: float) -> float:
        """Return all Coulomb friction at the joint beside a motor's torque, in [N m].

        Args:
            torque: From :meth:`torque`, in [N m].
            velocity: Of the joint, in [rad/s].
        """
        motor = self.settings.motor
        loss = 0.0 if motor is None else motor.gear_loss(torque, velocity)
        return self.friction + loss

    def _bridge(self, time_ns: int, duty: float) -> float:
        """Return the duty that acts now when this one is asked for."""
        pwm = self.settings.pwm
        if pwm is None:
            return duty
        cycle = pwm.cycle(time_ns)
        if cycle != self._cycle:
            self._cycle = cycle
            self._duty = pwm.output(duty)
        return self._duty
