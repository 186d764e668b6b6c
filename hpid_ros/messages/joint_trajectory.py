"""``trajectory_msgs/msg/JointTrajectory`` between bytes and arrays, without a message object.

What a message can cost is in proportion to its bytes, and bounded (:mod:`.bounds`). One pass over
the points finds where their arrays lie; where all have the same arrays, as every planner sends
them, the first four points tell. numpy takes the numbers from there.

Source: as for :mod:`hpid_ros.messages.joint_state`, and the definitions of
``trajectory_msgs/msg/JointTrajectory`` and ``JointTrajectoryPoint``.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError, TrajectoryError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.bounds import LIVE, MessageBounds, require_count, require_size
from hpid_ros.messages.joint_state import ENCAPSULATION, Cursor, Writer
from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    Point,
    PointArrays,
    checked_column,
    require_arrays,
)

_KIND = "JointTrajectory"
_MOST_NAMES = 1_000  # that are looked at before the rest is
_NUMBER = 8  # [bytes]
_ARRAYS = 4  # of a point: positions, velocities, accelerations, effort
_LEAST_POINT = 4 * _ARRAYS + 8  # [bytes]
_FIRST = 4  # points that show where the others lie, if all have the same arrays


class TrajectoryArrays(NamedTuple):
    """A trajectory; a row of NaN is a point that has none, or not one for each joint."""

    stamp_ns: int  # [ns] header.stamp
    names: tuple[str, ...]  # joint names
    times_ns: NDArray[np.int64]  # [ns] time from start of each point, int64, shape (points,)
    arrays: PointArrays  # the numbers of the points, each of shape (points, joints)
    # numbers that each point has in each of these arrays, shape (points, 4)
    lengths: NDArray[np.int64]
    body: Numbers  # the message behind its encapsulation header, as doubles
    starts: NDArray[np.int64]  # where in the body each point's arrays lie, shape (points, 4)

    def point(self, index: int) -> Point:
        """Return one point as it came: its time in [ns], and its four arrays."""
        p, v, a, e = (
            tuple(self.body[start : start + length].tolist())
            for start, length in zip(self.starts[index], self.lengths[index], strict=True)
        )
        return int(self.times_ns[index]), p, v, a, e

    def require(self) -> None:
        """Refuse what ``JointTrajectory`` refuses."""
        require_arrays(
            self.names, self.stamp_ns, self.times_ns, self.arrays, self.lengths, self.point
        )

    def column(self, joint: str) -> Column:
        """Return one joint's column of what :meth:`require` let pass."""
        return self.column_at(self.names.index(joint))

    def column_at(self, at: int) -> Column:
        """Return the column of the joint at a place among the names."""
        return checked_column(self.names[at], at, self.stamp_ns, self.times_ns, self.arrays)


def named_joints(raw: bytes) -> tuple[str, ...] | None:
    """Return whose trajectory a message is, without its points; None if that cannot be read."""
    try:
        cursor = Cursor(raw, _KIND)
        for code in "iI":
            cursor.scalar(code)
        cursor.string()
        count = cursor.scalar("I")
        return tuple(cursor.string() for _ in range(count)) if count <= _MOST_NAMES else None
    except MessageError:
        return None


def decode_trajectory(raw: bytes, bounds: MessageBounds = LIVE) -> TrajectoryArrays:
    """Return a trajectory's arrays, which take no more than a few times its bytes.

    Raises:
        MessageError: It is no trajectory, or beyond the bounds.
        TrajectoryError: It has points without a position of each joint, and more of both than it
            has bytes for.
    """
    require_size(_KIND, len(raw), bounds.size)
    cursor = Cursor(raw, _KIND)
    stamp_ns, _, names = cursor.stamp(), cursor.string(), cursor.strings(most=bounds.names)
    count = cursor.count("points", _LEAST_POINT, bounds.points)
    words, body = _views(raw, cursor.order)
    places = _walked(raw, cursor.offset - ENCAPSULATION, min(count, _FIRST), cursor.order)
    if count > _FIRST:
        first, places = places, _repeated(places, count)
        heads = places[:, :_ARRAYS] // 4
        is_alike = bool((words[first[:, :_ARRAYS] // 4] == words[heads[0]]).all())
        is_alike = is_alike and places[-1, -1] // 4 + 2 <= len(words)
        if not (is_alike and (words[heads] == words[heads[0]]).all()):
            what = "points that differ in their arrays"
            require_count(_KIND, what, count, _LEAST_POINT, len(raw), bounds.mixed_points)
            places = _walked(raw, cursor.offset - ENCAPSULATION, count, cursor.order)
    lengths = words[places[:, :_ARRAYS] // 4].astype(np.int64)
    _require_held(len(raw), names, lengths)
    starts, ends = places[:, _ARRAYS:-1] // 8, places[:, -1] // 4
    times_ns = words[ends].astype(np.uint32).view(np.int32).astype(np.int64) * NANOSECONDS
    times_ns += words[ends + 1]
    arrays = []
    for k in range(_ARRAYS):
        rows = np.flatnonzero(lengths[:, k] == len(names))
        if not (names and len(rows)):  # a view of one number, however many points there are
            arrays.append(np.broadcast_to(np.nan, (count, len(names))))
            continue
        values = np.full((count, len(names)), np.nan)
        values[rows] = body[starts[rows, k, np.newaxis] + np.arange(len(names))]
        arrays.append(values)
    return TrajectoryArrays(stamp_ns, names, times_ns, PointArrays(*arrays), lengths, body, starts)


def _require_held(size: int, names: Sequence[str], lengths: NDArray[np.int64]) -> None:
    """Refuse more points times joints than there are positions: arrays would be as long."""
    if len(lengths) * len(names) * _NUMBER > size:
        point = int(np.argmax(lengths[:, 0] != len(names)))
        raise TrajectoryError(
            f"point {point} must have {len(names)} positions, not {lengths[point, 0]}"
        )


def _views(raw: bytes | bytearray, order: str) -> tuple[NDArray[np.uint32], Numbers]:
    """Return a message behind its encapsulation header as words and as doubles."""
    size = len(raw) - ENCAPSULATION
    words = np.frombuffer(raw, f"{order}u4", size // 4, ENCAPSULATION)
    return words, np.frombuffer(raw, f"{order}f8", size // 8, ENCAPSULATION)


def _walked(raw: bytes, start: int, count: int, order: str) -> NDArray[np.int64]:
    """Return where the parts of each point are, (points, 9), in bytes behind the header.

    First where the lengths of its arrays are, then where their numbers begin, and its time.
    """
    unpack = struct.Struct(f"{order}I").unpack_from
    size = len(raw) - ENCAPSULATION
    places = array("q")
    at = start
    for _ in range(count):
        starts = []
        for _ in range(_ARRAYS):
            if at + 4 > size:
                raise _too_short(raw, at + 4)
            (length,) = unpack(raw, at + ENCAPSULATION)
            places.append(at)
            at += 4
            if length:
                at += -at % 8
            starts.append(at)
            at += 8 * length
        places.extend(starts)
        places.append(at)
        at += 8
        if at > size:
            raise _too_short(raw, at)
    return np.frombuffer(places, np.int64).reshape(count, 2 * _ARRAYS + 1)


def _repeated(first: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return where the parts of points are that have the same arrays as the first four.

    A point is a whole number of four bytes, and its doubles stand at multiples of eight: so its
    layout is that of the point two before it, but for the first.
    """
    turns, which = np.divmod(np.arange(count) - 1, 2)
    places: NDArray[np.int64] = first[1 + which] + turns[:, np.newaxis] * (first[3] - first[1])
    places[0] = first[0]
    return places


def _too_short(raw: bytes, end: int) -> MessageError:
    return MessageError(
        f"a JointTrajectory of {len(raw)} bytes ends before byte {end + ENCAPSULATION}"
    )


def encode_trajectory(
    stamp_ns: int, names: Sequence[str], times_ns: NDArray[np.int64], arrays: Sequence[Numbers]
) -> bytes:
    writer = Writer()
    writer.time(stamp_ns)
    writer.string("")
    writer.scalar("I", len(names))
    for name in names:
        writer.string(name)
    count = len(times_ns)
    writer.scalar("I", count)
    head = writer.raw
    lengths = np.stack([np.where(np.isnan(each[:, 0]), 0, len(names)) for each in arrays], axis=1)
    is_alike = count > _FIRST and bool((lengths == lengths[0]).all())
    for index, row in enumerate(lengths[: _FIRST if is_alike else count].tolist()):
        for k, length in enumerate(row):
            writer.scalar("I", length)
            if length:
                writer.doubles(arrays[k][index].tolist())
        writer.time(int(times_ns[index]))
    if not is_alike:
        return writer.raw
    places = _repeated(_walked(writer.raw, len(head) - ENCAPSULATION, _FIRST, "<"), count)
    raw = bytearray(head.ljust(ENCAPSULATION + int(places[-1, -1]) + 8, b"\0"))
    words, body = _views(raw, "<")
    words[places[:, :_ARRAYS] // 4] = lengths
    for k, length in enumerate(lengths[0].tolist()):
        body[places[:, _ARRAYS + k, np.newaxis] // 8 + np.arange(length)] = arrays[k][:, :length]
    ends = places[:, -1] // 4
    words[ends], words[ends + 1] = np.divmod(times_ns, NANOSECONDS)
    return bytes(raw)


def encode_joint_trajectory(trajectory: JointTrajectory) -> bytes:
    points, names = trajectory.points, trajectory.joint_names
    none = (np.nan,) * len(names)
    arrays = [np.array([point[k] or none for point in points], float) for k in range(1, 5)]
    times_ns = np.array([point.time_from_start_ns for point in points])
    return encode_trajectory(trajectory.stamp_ns, names, times_ns, arrays)


def decode_float64(raw: bytes) -> float:
    if len(raw) != ENCAPSULATION + 8 or raw[0] != 0 or raw[1] not in (0, 1):
        raise MessageError(f"a Float64 has 12 bytes in plain CDR, not {len(raw)}")
    (value,) = struct.unpack_from("<d" if raw[1] else ">d", raw, ENCAPSULATION)
    return float(value)
