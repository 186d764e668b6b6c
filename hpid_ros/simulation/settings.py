"""What a simulated world is made of."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hpid_ros.errors import SettingError, unknown_name
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.encoders import Encoder


@dataclass(frozen=True)
class WorldSettings:
    """Settings of a :class:`~hpid_ros.simulation.world.World`.

    Attributes:
        robot_description: Path of a URDF, or its XML text.
        joints: Driven joints, in the order of every reading and every command.
        control_period_ns: Time between two commands, in [ns].
        physics_steps: Physics steps in one control period.
        initial_positions: Positions at time 0, by joint, in [rad]; others start at 0.
        encoder_counts: Counts per revolution of each joint's output shaft, one number for all
            or a tuple along ``joints``; 0 is an ideal sensor.
        seed: Of what is drawn by chance: where each encoder's counts begin.
        fixed_base: The robot's root is held at the world's origin, as on a test stand, and
            there is no ground; otherwise the robot stands on the ground.
        payload_mass: Mass at the payload link, in [kg].
        payload_link: Link that carries the payload.
        gravity: Acceleration of gravity, in [m/s^2].
        gui: Show PyBullet's window.

    Raises:
        SettingError: A value is out of its range.
    """

    robot_description: str | Path
    joints: tuple[str, ...]
    control_period_ns: int = 1_000_000
    physics_steps: int = 4
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    encoder_counts: int | tuple[int, ...] = 0
    seed: int = 0
    fixed_base: bool = False
    payload_mass: float = 0.0
    payload_link: str = "payload"
    gravity: float = 9.81
    gui: bool = False

    def __post_init__(self) -> None:
        for name in ("control_period_ns", "physics_steps"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise SettingError(f"{name} {value!r} must be a whole number >= 1")
        if not self.joints:
            raise SettingError("joints must name at least one driven joint")
        require_mass(self.payload_mass)
        if not (math.isfinite(self.gravity) and self.gravity >= 0.0):
            raise SettingError(f"gravity {self.gravity!r} must be a finite number >= 0 [m/s^2]")
        counts = self.encoder_counts
        if not isinstance(counts, int) and len(counts) != len(self.joints):
            raise SettingError(
                f"encoder_counts has {len(counts)} entries for {len(self.joints)} joints"
            )

    @property
    def physics_period(self) -> float:
        """Time between two physics steps, in [s]."""
        return self.control_period_ns * 1e-9 / self.physics_steps

    @property
    def counts(self) -> tuple[int, ...]:
        """Encoder counts of each driven joint."""
        counts = self.encoder_counts
        return (counts,) * len(self.joints) if isinstance(counts, int) else tuple(counts)

    @property
    def encoders(self) -> list[Encoder]:
        """The encoder of each driven joint, mounted by chance."""
        chance = random.Random(self.seed)
        return [Encoder(counts, chance.random() - 0.5) for counts in self.counts]

    def start(self, description: RobotDescription) -> dict[str, float]:
        """Return the position at time 0 of every moving joint, in [rad].

        Raises:
            SettingError: A position is not finite, beyond the joint's limits, or of a joint
                that the robot lacks.
        """
        for name, position in self.initial_positions.items():
            joint = description.joints.get(name)
            if joint is None:
                raise SettingError(
                    f"initial_positions: {unknown_name('joint', name, description.joints)}"
                )
            if not (math.isfinite(position) and joint.lower <= position <= joint.upper):
                raise SettingError(
                    f"initial_positions: {name} = {position} is not within its limits"
                    f" [{joint.lower}, {joint.upper}]"
                )
        return {name: float(self.initial_positions.get(name, 0.0)) for name in description.joints}


def require_mass(mass: float) -> float:
    """Return the mass of a payload, in [kg].

    Raises:
        SettingError: It is negative or not finite.
    """
    if not (math.isfinite(mass) and mass >= 0.0):
        raise SettingError(f"payload_mass {mass!r} must be a finite number >= 0 [kg]")
    return float(mass)
