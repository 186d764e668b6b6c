"""Settings of a simulated world: sensors, disturbances, workplace.

An incremental encoder knows how far a joint has turned since power came on, not where it stands.
A joint is led past a magnet at constant speed; when the switch is seen to change, the counter
is set to the position at which the switch is said to change.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS, Vector
from hpid_ros.motion.references import OPENING
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.simulation.drives import DriveSettings


@dataclass(frozen=True)
class Encoder:
    """A position sensor with a finite number of counts per revolution.

    A position is rounded to the middle of its count: the error is at most half a count,
    pi / counts, either way. Where the counts begin is a matter of how the disc was mounted.
    """

    # counts per revolution of the joint's output shaft (all four edges of each line)
    counts: int = 0
    phase: float = 0.0  # [counts] where zero lies in its count, from the middle

    def __post_init__(self) -> None:
        if isinstance(self.counts, bool) or not isinstance(self.counts, int) or self.counts < 0:
            raise SettingError(
                f"encoder_counts {self.counts!r} must be a whole number >= 0 (0: ideal sensor)"
            )

    @property
    def resolution(self) -> float:
        """Size of one count, in [rad]; 0 for an ideal sensor."""
        return math.tau / self.counts if self.counts else 0.0

    def read(self, position: float) -> float:
        """Return the measured position."""
        counts, phase = self.counts, self.phase
        if not counts:
            return position
        return (round(position * counts / math.tau + phase) - phase) * math.tau / counts


LEAST_SPEED = 1e-6  # [rad/s]
FARTHEST = 1e3  # [rad]


@dataclass(frozen=True)
class Homing(Record):
    """A homing run, done before time 0.

    The joint is led from its initial position towards a Hall switch, which is on beyond its
    place, and past it, by a drive that keeps its speed; the board looks at the switch once a
    control period, at a moment of the travel that chance decides. The error that remains is the
    way from the switch's place to where it was seen, at most half the hysteresis and one
    period's way, and the encoder's rounding, at most half a count.
    """

    speed: float = quantity("Of the run", "rad/s", least=LEAST_SPEED)
    position: float = quantity(
        "Where the Hall switch is", "rad", default=0.0, least=-FARTHEST, most=FARTHEST
    )
    hysteresis: float = quantity(
        "Of the Hall switch", "rad", default=0.0, least=0.0, most=FARTHEST
    )

    def is_on(self, position: float, was_on: bool) -> bool:
        """Return whether the switch is on; each way it changes half the hysteresis late."""
        half = self.hysteresis / 2.0
        return position > self.position + (-half if was_on else half)

    def error(self, start: float, period: float, encoder: Encoder, chance: random.Random) -> float:
        """Do the homing run and return the constant offset of all later readings, in [rad]."""
        was_on = start > self.position
        step = math.copysign(self.speed * period, -1.0 if was_on else 1.0)
        edge = self.position + math.copysign(self.hysteresis / 2.0, step)
        # No look before the edge can see anything: the run begins with the last of them.
        offset = chance.random()
        before = max(0, math.floor((edge - start) / step - offset))
        seen = start + (offset + before) * step
        while self.is_on(seen, was_on) == was_on:
            seen += step
        return self.position - encoder.read(seen)


VELOCITIES = ("none", "differences")


class VelocityFilter(NamedTuple):
    """How a driver makes the velocity that it reports, one sample a control period.

    v_k is the sum of ``forward[j] d[k-j]`` less that of ``back[j] v[k-1-j]``, with the differences
    d of the positions over the period.
    """

    forward: tuple[float, ...] = (1.0,)
    back: tuple[float, ...] = ()
    # [rad/s] of a sensor of its own, whose differences are those of the true positions; None where
    # they are those of the measured ones
    noise: float | None = None

    @property
    def lag(self) -> float:
        """Mean lag behind the differences, in samples."""
        total = math.fsum(self.forward)
        if total == 0.0:
            return 0.0
        ahead = math.fsum(k * each for k, each in enumerate(self.forward)) / total
        rest = math.fsum(k * each for k, each in enumerate(self.back, 1))
        return ahead - rest / (1.0 + math.fsum(self.back))


@dataclass(frozen=True)
class Sensor(Record):
    """What measures one joint's position."""

    encoder_counts: int = quantity(
        "Counts per revolution of the joint, of a slide per 2 pi m; 0 measures exactly",
        default=0,
        least=0,
    )
    noise: float = quantity(
        "Standard deviation of a position before it is measured", "rad", default=0.0, least=0.0
    )
    homing: Homing | None = quantity(
        "The homing run; off where the position at the start is known", default=None
    )


LONGEST_SCHEDULE = 1e5
"""Of a schedule, in [s]: a day and more."""


@dataclass(frozen=True)
class PayloadChange(Record):
    """The payload has another mass from a moment on."""

    time: float = quantity("When", "s", least=0.0, most=LONGEST_SCHEDULE)
    mass: float = quantity("Its mass from then on", "kg", least=0.0)

    @property
    def start_ns(self) -> int:
        """When, in [ns]."""
        return round(self.time * NANOSECONDS)


@dataclass(frozen=True)
class WrenchPulse(Record):
    """A link is pushed for a while."""

    link: str = quantity("Link that is pushed, at the origin of its frame")
    start: float = quantity("When it begins", "s", key="from", least=0.0, most=LONGEST_SCHEDULE)
    duration: float = quantity(
        "How long; whole physics steps, at least one", "s", above=0.0, most=LONGEST_SCHEDULE
    )
    force: Vector = quantity("In the world frame", "N", default=(0.0, 0.0, 0.0))
    torque: Vector = quantity("In the world frame", "N m", default=(0.0, 0.0, 0.0))

    @property
    def start_ns(self) -> int:
        """When it begins, in [ns]."""
        return round(self.start * NANOSECONDS)

    @property
    def duration_ns(self) -> int:
        """How long it acts, in [ns]."""
        return max(1, round(self.duration * NANOSECONDS))


Event = PayloadChange | WrenchPulse


@dataclass(frozen=True)
class Disturbances(Record):
    """A schedule. What falls between two control periods happens with the later one."""

    payload: tuple[PayloadChange, ...] = quantity("Changes of the payload", default=())
    wrenches: tuple[WrenchPulse, ...] = quantity("Pushes; they may overlap", default=())

    def in_order(self) -> list[Event]:
        """Return all of them by time; of the same time, as they stand, the payload first."""
        return sorted((*self.payload, *self.wrenches), key=lambda event: event.start_ns)


def require_mass(name: str, mass: float) -> float:
    """Return the mass of a payload, in [kg]."""
    if not (math.isfinite(mass) and mass >= 0.0):
        raise SettingError(f"{name} {mass!r} must be a finite number >= 0 [kg]")
    return float(mass)


def checked_vector(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    """Return three finite numbers."""
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise SettingError(f"{name} {list(values)} must be three finite numbers")
    return float(values[0]), float(values[1]), float(values[2])


LARGEST_EXTENT = 100.0
"""Edge of a box and distance from the origin, in [m]."""


@dataclass(frozen=True)
class Support(Record):
    """A box that stays where it is: a table, a shelf."""

    name: str = quantity("Its name, for messages")
    size: Vector = quantity("Edges along its own x, y, z", "m", above=0.0, most=LARGEST_EXTENT)
    position: Vector = quantity(
        "Its centre in the world", "m", least=-LARGEST_EXTENT, most=LARGEST_EXTENT
    )
    yaw: float = quantity("Its turn about the world's z", "rad", default=0.0)
    friction: float = quantity(
        "Coefficient of its surface; of two that touch the product counts", default=1.0, least=0.0
    )

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """Its turn as a quaternion x, y, z, w."""
        return 0.0, 0.0, math.sin(self.yaw / 2.0), math.cos(self.yaw / 2.0)


@dataclass(frozen=True)
class Brick(Support):
    """A solid, homogeneous box that can be carried."""

    mass: float = quantity("Of the brick", "kg", default=1.0, above=0.0)


@dataclass(frozen=True)
class GripperSettings(Record):
    """A gripper of two parallel fingers, without a motor of its own in the simulation.

    The grasp frame is its link's: its origin lies between the fingertips, its z points out of the
    hand, the fingers close along its y. A brick is held if its centre and its faces are near
    enough to it when the fingers close.
    """

    link: str = quantity("Link whose frame is the grasp frame", default="payload")
    opening: float = quantity(
        "Widest brick between the open fingers", "m", default=OPENING, above=0.0
    )
    tolerance: float = quantity(
        "Largest distance of a brick from the grasp frame when it is taken",
        "m",
        default=0.015,
        above=0.0,
    )
    angle_tolerance: float = quantity(
        "Largest angle between its faces and the fingers; with more than pi/4 other faces would "
        "be meant",
        "rad",
        default=0.15,
        above=0.0,
        most=math.pi / 4.0,
    )
    grip_force: float = quantity("With which each finger presses", "N", default=50.0, above=0.0)
    friction: float = quantity("Coefficient between finger and brick", default=0.6, above=0.0)

    @property
    def holding_force(self) -> float:
        """Force at which a brick slips out: friction times grip force at both fingers, in [N]."""
        return 2.0 * self.friction * self.grip_force


@dataclass(frozen=True)
class GripCommand(Record):
    """The gripper closes or opens; between two control periods, with the later one."""

    time: float = quantity("When", "s", least=0.0, most=LONGEST_SCHEDULE)
    is_closed: bool = quantity("Whether it closes", key="closed")

    @property
    def time_ns(self) -> int:
        """When, in [ns]."""
        return round(self.time * NANOSECONDS)


@dataclass(frozen=True)
class Workplace(Record):
    """Everything of a brick task that is not the robot."""

    bricks: tuple[Brick, ...] = quantity("What can be carried", default=(), names=True)
    supports: tuple[Support, ...] = quantity("What stays", default=(), names=True)
    gripper: GripperSettings = quantity(
        "The robot's gripper; without a brick there is none", factory=GripperSettings
    )
    grips: tuple[GripCommand, ...] = quantity(
        "When it closes and opens, where the reference is no brick task", default=()
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [each.name for each in (*self.bricks, *self.supports)]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise SettingError(f"bricks and supports must differ in name, {name!r} is twice")

    def __bool__(self) -> bool:
        return bool(self.bricks or self.supports)


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


_MAY_BE_ABSENT = ("drives", "homing", "velocity_filters", "initial_efforts")


@dataclass(frozen=True)
class WorldSettings:
    """Settings of a :class:`~hpid_ros.simulation.world.World`."""

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
    velocity_filters: tuple[VelocityFilter, ...] = ()  # of each joint; none are bare differences
    initial_efforts: tuple[float, ...] = ()  # [N m] under way at time 0; none are 0
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
        for name in ("encoder_counts", "position_noise", *_MAY_BE_ABSENT):
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
    def is_touched(self) -> bool:
        """Whether there is anything that the robot can touch."""
        return not self.fixed_base or bool(self.workplace)

    @property
    def rolling_base(self) -> DifferentialDrive | None:
        """The base, unless it is held, as on a test stand."""
        return None if self.fixed_base else self.base

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
        """Return the position at time 0 of every moving joint, in [rad].

        That of a joint that is not named is 0, or the limit nearest to it.
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
        start = description.start(self.initial_positions)
        return {name: float(start.get(name, 0.0)) for name in description.joints}

    def _require_along(self, name: str) -> None:
        """Refuse a tuple that has not one entry for each driven joint; empty is none at all."""
        values = getattr(self, name)
        is_absent = name in _MAY_BE_ABSENT and not values
        if isinstance(values, tuple) and not is_absent and len(values) != len(self.joints):
            raise SettingError(f"{name} has {len(values)} entries for {len(self.joints)} joints")
