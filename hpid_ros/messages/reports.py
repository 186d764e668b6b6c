"""CDR of other messages than the states: clock, odometry, poses, parameters, group commands.

``std_msgs/msg/Float64MultiArray`` as the group controllers of ros2_control take it, numbers in
their order and nothing else; ``control_msgs/msg/DynamicJointState`` with an interface by name. All
but the stamp and the numbers is written once.

Source: the definitions of the messages; for the wire format see
:mod:`hpid_ros.messages.joint_state`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS, Vector
from hpid_ros.messages.bounds import (
    LENGTH,
    LIVE,
    MOST_DIMENSIONS,
    MOST_NUMBERS,
    require_size,
)
from hpid_ros.messages.joint_state import ENCAPSULATION, Cursor, Writer

CLOCK = "rosgraph_msgs/msg/Clock"
ODOMETRY = "nav_msgs/msg/Odometry"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSES = "geometry_msgs/msg/PoseArray"
STATUSES = "diagnostic_msgs/msg/DiagnosticArray"

PoseValues = tuple[Vector, tuple[float, float, float, float]]
"""Position in [m] and quaternion x, y, z, w."""


class Stamp(NamedTuple):
    """Header of a message."""

    stamp_ns: int  # [ns]
    frame: str  # its frame_id


class Status(NamedTuple):
    """One ``diagnostic_msgs/DiagnosticStatus`` with the stamp of its array."""

    stamp_ns: int  # [ns]
    level: int  # 0 good, 1 a warning, 2 an error
    name: str
    message: str
    values: Mapping[str, str]  # figures as texts, by name


def encode_clock(stamp_ns: int) -> bytes:
    writer = Writer()
    writer.time(stamp_ns)
    return writer.raw


def encode_odometry(
    header: Stamp,
    child: str,
    pose: PoseValues,
    pose_covariance: Sequence[float],
    twist: tuple[Vector, Vector],
    twist_covariance: Sequence[float],
) -> bytes:
    writer = _begun(header)
    writer.string(child)
    for values in (*pose, pose_covariance, *twist, twist_covariance):
        writer.doubles(values)
    return writer.raw


def encode_vector(header: Stamp, vector: Vector) -> bytes:
    writer = _begun(header)
    writer.doubles(vector)
    return writer.raw


def encode_pose(header: Stamp, pose: PoseValues) -> bytes:
    writer = _begun(header)
    for values in pose:
        writer.doubles(values)
    return writer.raw


def encode_poses(header: Stamp, poses: Sequence[PoseValues]) -> bytes:
    writer = _begun(header)
    writer.scalar("I", len(poses))
    for pose in poses:
        for values in pose:
            writer.doubles(values)
    return writer.raw


def encode_status(status: Status) -> bytes:
    """Return a serialised ``diagnostic_msgs/msg/DiagnosticArray`` of one status."""
    writer = _begun(Stamp(status.stamp_ns, ""))
    writer.scalar("I", 1)
    writer.scalar("B", status.level)
    writer.string(status.name)
    writer.string(status.message)
    writer.string("")  # hardware_id
    writer.scalar("I", len(status.values))
    for key, value in status.values.items():
        writer.string(key)
        writer.string(value)
    return writer.raw


def _begun(header: Stamp) -> Writer:
    writer = Writer()
    writer.time(header.stamp_ns)
    writer.string(header.frame)
    return writer


ParameterContent = bool | int | float | str | list[int] | list[bool] | list[float] | list[str]

_EVENT = "ParameterEvent"
_LEAST_PARAMETER = 4 + 1
"""Bytes of a name's length and a type."""


class ParameterEvent(NamedTuple):
    """Parameters of one node that it declared or that were set, in one message."""

    node: str  # its full name
    declared: Mapping[str, ParameterContent | None]  # values of parameters that are new, by name
    changed: Mapping[str, ParameterContent | None]  # values that were set later


def decode_text(raw: bytes) -> str:
    """Return the text of a serialised ``std_msgs/msg/String``."""
    return Cursor(raw, "String").string()


def decode_parameter_event(raw: bytes) -> ParameterEvent:
    cursor = Cursor(raw, _EVENT)
    cursor.scalar("i")
    cursor.scalar("I")  # the stamp is that of the sender's clock
    node = cursor.string()
    return ParameterEvent(node, _parameters(cursor), _parameters(cursor))


def _parameters(cursor: Cursor) -> dict[str, ParameterContent | None]:
    return dict(_parameter(cursor) for _ in range(cursor.count("parameters", _LEAST_PARAMETER)))


def _parameter(cursor: Cursor) -> tuple[str, ParameterContent | None]:
    """Read a parameter: all fields are there, and its type says which one counts."""
    name, kind = cursor.string(), cursor.scalar("B")
    values = [read(cursor) for read in _FIELDS]
    return name, values[kind - 1] if 1 <= kind <= len(values) else None


_FIELDS: tuple[Callable[[Cursor], ParameterContent], ...] = (
    lambda cursor: bool(cursor.scalar("B")),
    lambda cursor: cursor.scalar("q"),
    lambda cursor: cursor.double(),
    lambda cursor: cursor.string(),
    lambda cursor: list(cursor.integers("B")),
    lambda cursor: [bool(each) for each in cursor.integers("B")],
    lambda cursor: list(cursor.integers("q")),
    lambda cursor: list(cursor.doubles()),
    lambda cursor: list(cursor.strings()),
)
"""Fields of a ParameterValue, in the order of its types from 1 on."""


EFFORT = "effort"
"""Name of the interface of efforts, in ros2_control."""

_DOUBLE = 8


class Float64Template:
    """A Float64, which has no place for a name or a stamp."""

    def __init__(self) -> None:
        self._head, self._number = bytes(Writer().raw), struct.Struct("<d")

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        return self._head + self._number.pack(*effort)


class MultiArrayTemplate:
    """A Float64MultiArray without a layout; the message has no place for names or stamps."""

    def __init__(self, count: int) -> None:
        writer = Writer()
        for value in (0, 0, count):  # no dimensions, no offset, so many numbers
            writer.scalar("I", value)
        writer.doubles([0.0] * count)
        self._head = writer.raw[: -_DOUBLE * count]
        self._numbers = struct.Struct(f"<{count}d")

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        return self._head + self._numbers.pack(*effort)


_LEAST_DIMENSION = 3 * LENGTH
"""Bytes of a label's length, a size and a stride."""


def decode_numbers(raw: bytes) -> tuple[float, ...]:
    """Return the numbers of a serialised Float64MultiArray; its layout is passed over."""
    cursor = Cursor(raw, "Float64MultiArray")
    for _ in range(cursor.count("dimensions", _LEAST_DIMENSION, MOST_DIMENSIONS)):
        cursor.string()
        cursor.scalar("I")
        cursor.scalar("I")
    cursor.scalar("I")
    return cursor.doubles(MOST_NUMBERS)


_LEAST_STATE = 2 * LENGTH + 1
"""Bytes of a name's and a label's length, and a number between them."""


def decode_activity(raw: bytes) -> dict[str, str]:
    """Return the states of controllers by name: their lifecycles' labels, as "active".

    Source: ``controller_manager_msgs/msg/ControllerManagerActivity``; the hardware's are not read.
    """
    kind = "ControllerManagerActivity"
    require_size(kind, len(raw))
    cursor = Cursor(raw, kind)
    cursor.scalar("i")
    cursor.scalar("I")  # the stamp is that of the manager's clock
    cursor.string()
    states = {}
    for _ in range(cursor.count("controllers", _LEAST_STATE, LIVE.names)):
        name, _, states[name] = cursor.string(), cursor.scalar("B"), cursor.string()
    return states


class DynamicJointStateTemplate:
    """A DynamicJointState with the interface ``effort`` for each joint."""

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        writer = Writer()
        writer.time(0)
        writer.string(frame_id)
        writer.scalar("I", len(names))
        for name in names:
            writer.string(name)
        writer.scalar("I", len(names))
        self._offsets: list[int] = []
        for _ in names:
            writer.scalar("I", 1)
            writer.string(EFFORT)
            writer.scalar("I", 1)
            writer.doubles([0.0])
            self._offsets.append(len(writer.raw) - _DOUBLE)
        self._buffer = bytearray(writer.raw)
        self._stamp, self._number = struct.Struct("<iI"), struct.Struct("<d")

    def encode(self, stamp_ns: int, *, effort: Sequence[float]) -> bytes:
        self._stamp.pack_into(self._buffer, ENCAPSULATION, *divmod(stamp_ns, NANOSECONDS))
        for offset, number in zip(self._offsets, effort, strict=True):
            self._number.pack_into(self._buffer, offset, number)
        return bytes(self._buffer)
