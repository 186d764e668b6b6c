"""One joint's drive: H-bridge, DC motor and gearbox between a commanded effort and the joint.

Source: any text on drives, for instance W. Leonhard, "Control of Electrical Drives", chapter 5
(armature equation without its inductance, back EMF, torque-speed line); the gearbox's loss in
proportion to the torque it carries, T. Verstraten et al., "Modeling and design of geared DC
motors for energy efficiency", Mechatronics 30 (2015).

In the order of the signal: the command arrives, late by whole control periods if the bus is
slow; the controller's board asks for a duty; the H-bridge gives it in steps and at its own rate;
the motor turns it into torque at its present speed; the gear multiplies it and takes its loss.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.robot.description import JointDescription

LARGEST_BITS = 32


@dataclass(frozen=True)
class Pwm:
    """A duty register of a number of bits beside a direction pin, taken over at a rate.

    The ripple of one PWM period is not simulated: the mean voltage acts.

    Attributes:
        bits: Resolution of the duty's magnitude: 2^bits - 1 steps from 0 to 1.
        dead_band: Duties smaller than this give nothing, in [0, 1).
        rate: How often the register is taken over, in [Hz]; 0 is with every physics step.

    Raises:
        SettingError: A value is out of its range.
    """

    bits: int
    dead_band: float = 0.0
    rate: float = 0.0

    def __post_init__(self) -> None:
        whole = isinstance(self.bits, int) and not isinstance(self.bits, bool)
        if not (whole and 1 <= self.bits <= LARGEST_BITS):
            raise SettingError(
                f"pwm.bits {self.bits!r} must be a whole number from 1 to {LARGEST_BITS}"
            )
        if not 0.0 <= self.dead_band < 1.0:
            raise SettingError(f"pwm.dead_band {self.dead_band!r} must be in [0, 1)")
        if not (math.isfinite(self.rate) and 0.0 <= self.rate <= NANOSECONDS):
            raise SettingError(f"pwm.rate {self.rate!r} must be a number from 0 to 1e9 [Hz]")

    @property
    def resolution(self) -> float:
        """Smallest step of the duty."""
        return 1.0 / (2**self.bits - 1)

    def output(self, duty: float) -> float:
        """Return the duty that acts: the nearest step, or 0 in the dead band.

        Args:
            duty: The duty asked for; held to [-1, 1].
        """
        magnitude = min(abs(duty), 1.0)
        if magnitude < self.dead_band:
            return 0.0
        steps = 2**self.bits - 1
        return math.copysign(round(magnitude * steps) / steps, duty)

    def cycle(self, time_ns: int) -> int:
        """Return the number of the register's present cycle; a new one takes the register over.

        Args:
            time_ns: Simulated time, in [ns].
        """
        return math.floor(time_ns * self.rate / NANOSECONDS) if self.rate else time_ns


DRIVES = ("current", "voltage")


@dataclass(frozen=True)
class Motor:
    r"""What a torque and a voltage are to each other, at the rotor.

    .. math:: i = (V - k\,\omega) / R, \qquad \tau = k\,i

    With the supply's voltage this is the torque-speed line, from the stall torque ``k V / R`` to
    the no-load speed ``V / k``. The armature's inductance is left out: its time constant, some
    0.1 ms, is shorter than a physics step. The rotor's inertia is not here: it is in the physics,
    from the URDF (:mod:`hpid_ros.simulation.world.model`), and so is the gear's ratio.

    Attributes:
        torque_constant: k, also the back EMF's, in [N m/A] or [V s/rad].
        resistance: R of the armature with its bridge, in [ohm].
        supply_voltage: Largest voltage either way, in [V].
        viscous_friction: Of rotor and bearings, at the rotor, in [N m s/rad].
        coulomb_friction: Of brushes and bearings, at the rotor, in [N m].
        gear_efficiency: Of the gear driving its load, in (0, 1]; the same when driven by it.
        drive: ``current``, an inner loop that makes up for the back EMF as far as the supply
            reaches; or ``voltage``, a bare bridge: the voltage that would give the torque at
            standstill, so that the back EMF brakes.

    Raises:
        SettingError: A value is out of its range.
    """

    torque_constant: float
    resistance: float
    supply_voltage: float
    viscous_friction: float = 0.0
    coulomb_friction: float = 0.0
    gear_efficiency: float = 1.0
    drive: str = "current"

    def __post_init__(self) -> None:
        for name in ("torque_constant", "resistance", "supply_voltage"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(f"motor.{name} {value!r} must be a finite number > 0")
        for name in ("viscous_friction", "coulomb_friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise SettingError(f"motor.{name} {value!r} must be a finite number >= 0")
        if not 0.0 < self.gear_efficiency <= 1.0:
            raise SettingError(f"motor.gear_efficiency {self.gear_efficiency!r} must be in (0, 1]")
        if self.drive not in DRIVES:
            raise SettingError(f"motor.drive {self.drive!r} must be one of {', '.join(DRIVES)}")

    @property
    def stall_torque(self) -> float:
        """Largest torque at standstill, in [N m]."""
        return self.torque_constant * self.supply_voltage / self.resistance

    @property
    def no_load_speed(self) -> float:
        """Speed at which the back EMF equals the supply, in [rad/s]."""
        return self.supply_voltage / self.torque_constant

    def time_constant(self, rotor_inertia: float) -> float:
        """Return the mechanical time constant ``J R / k^2`` of the bare rotor, in [s].

        Args:
            rotor_inertia: J, in [kg m^2].
        """
        return rotor_inertia * self.resistance / self.torque_constant**2

    def duty(self, torque: float, speed: float) -> float:
        """Return the part of the supply's voltage that is asked for, in [-1, 1].

        Args:
            torque: Torque wanted at the rotor, in [N m].
            speed: Speed of the rotor, in [rad/s].
        """
        voltage = self.resistance / self.torque_constant * torque
        if self.drive == "current":
            voltage += self.torque_constant * speed
        return min(max(voltage / self.supply_voltage, -1.0), 1.0)

    def torque(self, duty: float, speed: float) -> float:
        """Return the torque at the rotor, friction not taken off, in [N m].

        Args:
            duty: Part of the supply's voltage at the terminals, in [-1, 1].
            speed: Speed of the rotor, in [rad/s].
        """
        back_emf = self.torque_constant * speed
        return self.torque_constant * (duty * self.supply_voltage - back_emf) / self.resistance

    def gear_loss(self, torque: float, speed: float) -> float:
        """Return the friction of the gear, a torque that opposes motion, in the torque's unit.

        The output is ``efficiency * torque`` when the motor drives, and ``torque / efficiency``
        holds a load that drives the motor.

        Args:
            torque: The motor's torque, at either side of the gear.
            speed: Speed at the same side.
        """
        if torque * speed >= 0.0:
            return (1.0 - self.gear_efficiency) * abs(torque)
        return (1.0 / self.gear_efficiency - 1.0) * abs(torque)


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
