"""A brushed DC motor behind a gearbox.

Source: any text on drives, for instance W. Leonhard, "Control of Electrical Drives", chapter 5
(armature equation without its inductance, back EMF, torque-speed line); the gearbox's loss in
proportion to the torque it carries, T. Verstraten et al., "Modeling and design of geared DC
motors for energy efficiency", Mechatronics 30 (2015).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.errors import SettingError

DRIVES = ("current", "voltage")


@dataclass(frozen=True)
class Motor:
    r"""What a torque and a voltage are to each other, at the rotor.

    .. math:: i = (V - k\,\omega) / R, \qquad \tau = k\,i

    With the supply's voltage this is the torque-speed line, from the stall torque ``k V / R`` to
    the no-load speed ``V / k``. The armature's inductance is left out: its time constant, some
    0.1 ms, is shorter than a physics step. The rotor's inertia is not here: it is in the physics,
    from the URDF (:mod:`hpid_ros.simulation.rotors`), and so is the gear's ratio.

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
