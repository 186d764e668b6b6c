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
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.robot.joint_description import JointDescription

LARGEST_BITS = 32


@dataclass(frozen=True)
class Pwm(Record):
    """A duty register of a number of bits with a direction pin, taken over at a rate.

    The ripple of one PWM period is not simulated: the mean voltage acts.
    """

    bits: int = quantity(
        "Resolution of the duty's magnitude: 2^bits - 1 steps", least=1, most=LARGEST_BITS
    )
    dead_band: float = quantity("Duties below it give nothing", default=0.0, least=0.0, below=1.0)
    rate: float = quantity(
        "How often the register is taken over; 0 is with every physics step",
        "Hz",
        default=0.0,
        least=0.0,
        most=NANOSECONDS,
    )

    def output(self, duty: float) -> float:
        """Return the duty that acts: the nearest step, or 0 in the dead band."""
        magnitude = min(abs(duty), 1.0)
        if magnitude < self.dead_band:
            return 0.0
        steps = 2**self.bits - 1
        return math.copysign(round(magnitude * steps) / steps, duty)

    def cycle(self, time_ns: int) -> int:
        """Return the number of the register's present cycle; a new one takes the register over."""
        return math.floor(time_ns * self.rate / NANOSECONDS) if self.rate else time_ns


DRIVES = ("current", "voltage")


@dataclass(frozen=True)
class Motor(Record):
    r"""A DC motor without inductance: voltage, current and torque at the rotor.

    .. math:: i = (V - k\,\omega) / R, \qquad \tau = k\,i

    With the supply's voltage this is the torque-speed line, from the stall torque ``k V / R`` to
    the no-load speed ``V / k``. The armature's inductance is left out: its time constant, some
    0.1 ms, is shorter than a physics step. The rotor's inertia is not here: it is in the physics,
    from the URDF (:mod:`hpid_ros.simulation.bullet`), and so is the gear's ratio.

    With the drive ``current`` an inner loop makes up for the back EMF as far as the supply
    reaches. ``voltage`` is a bare bridge: it gives the voltage that would give the torque at
    standstill, so that the back EMF brakes.
    """

    torque_constant: float = quantity("k, also the back EMF's", "N m/A", above=0.0)
    resistance: float = quantity("R of the armature with its bridge", "ohm", above=0.0)
    supply_voltage: float = quantity("Largest voltage either way", "V", above=0.0)
    viscous_friction: float = quantity("At the rotor", "N m s/rad", default=0.0, least=0.0)
    coulomb_friction: float = quantity("At the rotor", "N m", default=0.0, least=0.0)
    gear_efficiency: float = quantity("Of the gear, either way", default=1.0, above=0.0, most=1.0)
    drive: str = quantity(
        "Whether a current loop makes up for the back EMF", default="current", choices=DRIVES
    )

    def time_constant(self, rotor_inertia: float) -> float:
        """Return the mechanical time constant ``J R / k^2`` of the bare rotor, in [s]."""
        return rotor_inertia * self.resistance / self.torque_constant**2

    def duty(self, torque: float, speed: float) -> float:
        """Return the part of the supply's voltage that is asked for, in [-1, 1]."""
        voltage = self.resistance / self.torque_constant * torque
        if self.drive == "current":
            voltage += self.torque_constant * speed
        return min(max(voltage / self.supply_voltage, -1.0), 1.0)

    def torque(self, duty: float, speed: float) -> float:
        """Return the torque at the rotor, friction not taken off, in [N m]."""
        back_emf = self.torque_constant * speed
        return self.torque_constant * (duty * self.supply_voltage - back_emf) / self.resistance

    def gear_loss(self, torque: float, speed: float) -> float:
        """Return the friction of the gear, a torque that opposes motion, in the torque's unit.

        The output is ``efficiency * torque`` when the motor drives, and ``torque / efficiency``
        holds a load that drives the motor.
        """
        if torque * speed >= 0.0:
            return (1.0 - self.gear_efficiency) * abs(torque)
        return (1.0 / self.gear_efficiency - 1.0) * abs(torque)


LONGEST_DELAY = 1000  # control periods


@dataclass(frozen=True)
class DriveSettings(Record):
    """What a joint's drive consists of."""

    motor: Motor | None = quantity("Its motor; off is an ideal source of torque", default=None)
    pwm: Pwm | None = quantity(
        "Its bridge; off gives any voltage, or without a motor any torque", default=None
    )
    delay: int = quantity(
        "By which efforts act late", "control periods", default=0, least=0, most=LONGEST_DELAY
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
    """A joint's drive in a run; its past is the efforts under way and the bridge's register."""

    def __init__(
        self, settings: DriveSettings, joint: JointDescription, physics_period: float
    ) -> None:
        self.settings = settings
        self._ratio = joint.gear_ratio
        self._limit = joint.effort
        motor = settings.motor
        if motor is None and settings.pwm is not None and math.isinf(joint.effort):
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

    def reset(self, effort: float = 0.0) -> None:
        """Forget the past: one effort alone is under way, and the bridge gives nothing."""
        self._under_way = deque([effort] * self.settings.delay)
        self._effort = 0.0
        self._cycle = -1
        self._duty = 0.0

    def command(self, effort: float) -> None:
        """Take the effort of one control period."""
        self._under_way.append(effort)
        self._effort = self._under_way.popleft()

    def torque(self, time_ns: int, velocity: float) -> float:
        """Return the motor's torque in the next physics step, frictions not taken off."""
        motor = self.settings.motor
        if motor is None:
            if self.settings.pwm is None:
                return self._effort
            return self._bridge(time_ns, self._effort / self._limit) * self._limit
        speed = self._ratio * velocity
        duty = motor.duty(self._effort / self._ratio, speed)
        return self._ratio * motor.torque(self._bridge(time_ns, duty), speed)

    def brake(self, torque: float, velocity: float) -> float:
        """Return all Coulomb friction at the joint that acts with a motor's torque, in [N m]."""
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
