"""Settings of a simulated world."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.sensors import VELOCITIES, Encoder, Homing
from hpid_ros.simulation.world.disturbances import Disturbances, require_mass
from hpid_ros.simulation.world.workpieces import Workplace

ENGINES = ("pybullet", "mujoco")
"""The engines by name, which is also that of the Python package that each is."""


def installed_engines() -> tuple[str, ...]:
    """Return the engines that are installed; PyBullet has no wheel for CPython 3.12 and later."""
    return tuple(engine for engine in ENGINES if find_spec(engine) is not None)


def default_engine() -> str:
    """Return the engine where nobody names one: PyBullet where it is installed, else MuJoCo."""
    return ENGINES[0] if ENGINES[0] in installed_engines() else ENGINES[1]


def require_engine(engine: str) -> None:
    """Refuse an engine that cannot be used here."""
    if engine not in ENGINES:
        raise SettingError(unknown_name("engine", engine, ENGINES))
    if engine not in (installed := installed_engines()):
        others = f", or take engine {' or '.join(installed)}" if installed else ""
        raise SettingError(f"engine {engine} is not installed: pip install {engine}{others}")


@dataclass(frozen=True)
class WorldSettings:
    """Settings of a :class:`~hpid_ros.simulation.world.world.World`."""

    robot_description: str | Path  # path of a URDF, or its XML text
    joints: tuple[str, ...]  # driven joints, in the order of every reading and every command
    control_period_ns: int = 1_000_000  # [ns] time between two commands
    physics_steps: int = 4  # physics steps in one control period
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    encoder_counts: int | tuple[int, ...] = 0
    seed: int = 0
    # the robot's root is held at the world's origin, as on a test stand, and there is no ground
    fixed_base: bool = False
    payload_mass: float = 0.0  # [kg] mass at the payload link
    payload_link: str = "payload"  # link that carries the payload
    gravity: float = 9.81  # [m/s^2] acceleration of gravity
    gui: bool = False  # show the engine's window
    drives: tuple[DriveSettings, ...] = ()  # the drive of each joint, along joints
    position_noise: float | tuple[float, ...] = 0.0  # [rad]
    # the homing run of each joint, along joints, None where the position at the start is known
    homing: tuple[Homing | None, ...] = ()
    velocity: str = "none"  # where the measured velocities come from: none, there are none
    disturbances: Disturbances = field(default_factory=Disturbances)
    workplace: Workplace = field(default_factory=Workplace)
    base: DifferentialDrive | None = None  # the two driven joints that are the wheels of its base
    engine: str = field(default_factory=default_engine)

    def __post_init__(self) -> None:
        for name in ("control_period_ns", "physics_steps"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise SettingError(f"{name} {value!r} must be a whole number >= 1")
        if not self.joints:
            raise SettingError("joints must name at least one driven joint")
        require_mass("payload_mass", self.payload_mass)
        if not (math.isfinite(self.gravity) and self.gravity >= 0.0):
            raise SettingError(f"gravity {self.gravity!r} must be a finite number >= 0 [m/s^2]")
        for name in ("encoder_counts", "position_noise", "drives", "homing"):
            self._require_along(name)
        if not all(math.isfinite(noise) and noise >= 0.0 for noise in self.position_noises):
            raise SettingError(
                f"position_noise {self.position_noise!r} must be finite and >= 0 [rad]"
            )
        for wheel in self.base.joints if self.base else ():
            if wheel not in self.joints:
                raise SettingError(f"base: {unknown_name('driven joint', wheel, self.joints)}")
        if self.engine not in ENGINES:
            raise SettingError(unknown_name("engine", self.engine, ENGINES))
        if self.velocity not in VELOCITIES:
            raise SettingError(
                f"velocity {self.velocity!r} must be one of {', '.join(VELOCITIES)}"
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
    def position_noises(self) -> tuple[float, ...]:
        """Standard deviation of each driven joint's noise, in [rad]."""
        noise = self.position_noise
        return noise if isinstance(noise, tuple) else (float(noise),) * len(self.joints)

    @property
    def homings(self) -> tuple[Homing | None, ...]:
        """The homing run of each driven joint."""
        return self.homing or (None,) * len(self.joints)

    @property
    def links(self) -> tuple[str, ...]:
        """Links that the robot must have."""
        carries = bool(self.payload_mass or self.disturbances.payload)
        pushed = tuple(pulse.link for pulse in self.disturbances.wrenches)
        hand = (self.workplace.gripper.link,) if self.workplace.bricks else ()
        return ((self.payload_link,) if carries else ()) + pushed + hand

    @property
    def has_ideal_drives(self) -> bool:
        """Whether every effort acts as it is, at once."""
        return all(drive.is_ideal for drive in self.drives)

    @property
    def has_bare_encoders(self) -> bool:
        """Whether a reading depends on the present position alone."""
        return (
            not any(self.position_noises)
            and all(homing is None for homing in self.homing)
            and self.velocity == "none"
        )

    @property
    def encoders(self) -> list[Encoder]:
        """The encoder of each driven joint, mounted by chance."""
        chance = random.Random(self.seed)
        return [Encoder(counts, chance.random() - 0.5) for counts in self.counts]

    def start(self, description: RobotDescription) -> dict[str, float]:
        """Return the position at time 0 of every moving joint, in [rad]."""
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

    def _require_along(self, name: str) -> None:
        """Refuse a tuple that has not one entry for each driven joint; empty is none at all."""
        values = getattr(self, name)
        is_absent = name in ("drives", "homing") and not values
        if isinstance(values, tuple) and not is_absent and len(values) != len(self.joints):
            raise SettingError(f"{name} has {len(values)} entries for {len(self.joints)} joints")
