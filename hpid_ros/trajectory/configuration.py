"""A reference as a configuration says it: ``kind`` and the numbers of that kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hpid_ros.base.errors import HpidError, TrajectoryError, unknown_name
from hpid_ros.documents.descriptions import json_schema
from hpid_ros.documents.records import Record, quantity, take_record
from hpid_ros.documents.sections import Section
from hpid_ros.trajectory.base_path import FORWARD, base_path
from hpid_ros.trajectory.combining import combined
from hpid_ros.trajectory.generators import minimum_jerk, sine, step
from hpid_ros.trajectory.joint_trajectory import JointTrajectory


@dataclass(frozen=True)
class Waypoints(Record):
    """Positions of each joint at common times."""

    times: tuple[float, ...] = quantity("When the joints are there", "s")
    positions: Mapping[str, tuple[float, ...]] = quantity(
        "For each joint one position for each time", "rad"
    )


@dataclass(frozen=True)
class Oscillation(Record):
    """A sine of one joint."""

    amplitude: float = quantity("Of the sine", "rad")
    period: float = quantity("Of the sine", "s", above=0.0)
    offset: float = quantity("About which it swings", "rad", default=0.0)
    phase: float = quantity("At time 0", "rad", default=0.0)


@dataclass(frozen=True)
class Oscillations(Record):
    """A sine for each joint."""

    duration: float = quantity("Of the reference", "s", above=0.0)
    joints: Mapping[str, Oscillation] = quantity("The sine of each joint")


@dataclass(frozen=True)
class PathWheels(Record):
    """The wheels of a base, with all their lengths."""

    left_wheel: str = quantity("Joint of the left wheel")
    right_wheel: str = quantity("Joint of the right wheel")
    wheel_radius: float = quantity("Of both wheels", "m", above=0.0)
    wheel_separation: float = quantity("Between their contacts", "m", above=0.0)


@dataclass(frozen=True)
class PathSection(Record):
    """A path of a differential drive, as trajectories of its wheels."""

    base: PathWheels = quantity("The wheels of the base")
    times: tuple[float, ...] = quantity("When the base is at each pose", "s")
    poses: tuple[tuple[float, ...], ...] = quantity("x [m], y [m] and heading [rad] of each")
    directions: str | tuple[str, ...] = quantity(
        "forward or backward, for all legs or one for each", default=FORWARD
    )
    passes: bool = quantity("Whether the base drives through the poses between", default=False)
    velocity_limit: float | None = quantity("Of a wheel", "rad/s", default=None, above=0.0)
    curvature_limit: float | None = quantity("Of the path", "1/m", default=None, above=0.0)

    def trajectory(self) -> JointTrajectory:
        """Return what the wheels follow."""
        legs = self.directions
        limits = {
            name: value
            for name in ("velocity_limit", "curvature_limit")
            if (value := getattr(self, name)) is not None
        }
        return base_path(
            self.times,
            self.poses,
            *asdict(self.base).values(),
            directions=[legs] * (len(self.poses) - 1) if isinstance(legs, str) else legs,
            passes=self.passes,
            **limits,
        )


_KINDS: dict[str, type[Record]] = {
    "minimum_jerk": Waypoints,
    "step": Waypoints,
    "sine": Oscillations,
    "base_path": PathSection,
}
_COMBINED = "combined"
KINDS = (*_KINDS, _COMBINED)


def reference_from(values: object, where: str = "reference") -> JointTrajectory:
    """Return the trajectory that a ``reference`` section describes.

    ``kind: minimum_jerk`` and ``kind: step`` are :class:`Waypoints`, ``kind: sine`` is
    :class:`Oscillations`, ``kind: base_path`` is :class:`PathSection`; ``kind: combined`` has
    ``parts``, a list of such sections for different joints.
    """
    section = Section(values, where, TrajectoryError)
    kind = section.text("kind")
    if kind not in KINDS:
        raise TrajectoryError(f"{section.place('kind')}: {unknown_name('kind', kind, KINDS)}")
    if kind == _COMBINED:
        return _combined(section)
    record = take_record(_KINDS[kind], section)
    section.finish()
    try:
        return _trajectory(kind, record)
    except HpidError as error:
        raise TrajectoryError(f"{where}: {error}") from None


def reference_schema(*others: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a ``reference`` section."""
    kinds = [of_kind(name, json_schema(record)) for name, record in _KINDS.items()]
    parts = {"type": "array", "minItems": 1, "items": {"oneOf": kinds}}
    whole = {
        "type": "object",
        "description": "References of different joints.",
        "properties": {"parts": parts},
        "required": ["parts"],
        "additionalProperties": False,
    }
    return {"oneOf": [*kinds, of_kind(_COMBINED, whole), *others]}


def of_kind(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a section with its ``kind``."""
    properties = {"kind": {"const": name}, **schema["properties"]}
    return {
        **schema,
        "properties": properties,
        "required": ["kind", *schema.get("required", ())],
    }


def _trajectory(kind: str, record: Record) -> JointTrajectory:
    if isinstance(record, PathSection):
        return record.trajectory()
    if isinstance(record, Oscillations):
        signals = {joint: asdict(each) for joint, each in record.joints.items()}
        return sine(record.duration, signals)
    assert isinstance(record, Waypoints)
    return (step if kind == "step" else minimum_jerk)(record.times, record.positions)


def _combined(section: Section) -> JointTrajectory:
    parts = section.take("parts")
    section.finish()
    if not isinstance(parts, list) or not parts:
        raise TrajectoryError(f"{section.place('parts')} must be a list of references")
    place = section.place("parts")
    if any(isinstance(part, Mapping) and part.get("kind") == _COMBINED for part in parts):
        raise TrajectoryError(f"{place} must not hold a combined reference again")
    each = [reference_from(part, f"{place}[{index}]") for index, part in enumerate(parts)]
    try:
        return combined(each)
    except TrajectoryError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None
