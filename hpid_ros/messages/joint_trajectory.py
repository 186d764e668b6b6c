"""``trajectory_msgs/msg/JointTrajectory`` between bytes and arrays, without a message object.

What a message can cost is bounded: it may have only so many points. Points of one layout (all
have the same arrays, as every planner sends them) are taken as records; where they differ, one
pass finds where each point's arrays lie, and numpy takes them from there.

Source: as for :mod:`hpid_ros.messages.joint_state`, and the definitions of
``trajectory_msgs/msg/JointTrajectory`` and ``JointTrajectoryPoint``.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.joint_state import ENCAPSULATION, Cursor, Writer, require_nanoseconds
from hpid_ros.motion.joint_trajectory import JointTrajectory, Point

MOST_POINTS = 50_000
"""Points of one layout that a message may have."""

MOST_MIXED_POINTS = 5_000
"""Points that a message may have whose points differ in layout."""

_ARRAYS = 4  # of a point: positions, velocities, accelerations, effort
_LEAST_POINT = 4 * _ARRAYS + 8  # [bytes]


class TrajectoryArrays(NamedTuple):
    """A trajectory whose points have one layout."""

    stamp_ns: int  # [ns] header.stamp
    names: tuple[str, ...]  # joint names
    times_ns: NDArray[np.int64]  # [ns] time from start of each point, int64, shape (points,)
    positions: Numbers  # [rad] shape (points, numbers in each point)
    velocities: Numbers  # [rad/s] likewise; no columns where the message has none
    accelerations: Numbers  # [rad/s^2] likewise
    efforts: Numbers  # [N m] likewise

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Numbers that points have in each array, shape (1, 4): all have the same."""
        return np.array([[each.shape[1] for each in self[3:]]])

    def point(self, index: int) -> Point:
        """Return one point as it came: its time in [ns], and its four arrays."""
        p, v, a, e = (tuple(each[index].tolist()) for each in self[3:])
        return int(self.times_ns[index]), p, v, a, e


class MixedTrajectory(NamedTuple):
    """A trajectory whose points differ in what they give."""

    stamp_ns: int  # [ns] header.stamp
    names: tuple[str, ...]  # joint names
    times_ns: NDArray[np.int64]  # [ns] time from start of each point, int64, shape (points,)
    positions: Numbers  # [rad] shape (points, joints)
    velocities: Numbers  # [rad/s] likewise
    accelerations: Numbers  # [rad/s^2] likewise
    efforts: Numbers  # [N m] likewise
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


def decode_trajectory(
    raw: bytes, most_points: int = MOST_POINTS, most_mixed_points: int = MOST_MIXED_POINTS
) -> TrajectoryArrays | MixedTrajectory:
    cursor = Cursor(raw, "JointTrajectory")
    seconds, nanoseconds = cursor.scalar("i"), cursor.scalar("I")
    require_nanoseconds(nanoseconds)
    cursor.string()
    names = cursor.strings()
    count = cursor.scalar("I")
    if count > most_points:
        raise MessageError(f"a JointTrajectory may have {most_points} points, not {count}")
    if count * _LEAST_POINT > len(raw):
        raise MessageError(f"a JointTrajectory of {len(raw)} bytes cannot hold {count} points")
    stamp_ns = seconds * NANOSECONDS + nanoseconds
    if count == 0:
        none = np.empty((0, len(names)))
        return TrajectoryArrays(stamp_ns, names, np.empty(0, np.int64), none, none, none, none)
    start = cursor.offset
    lengths = tuple(len(cursor.doubles()) for _ in range(_ARRAYS))
    points = _records(raw, start, lengths, count) if raw[1] == 1 else None
    if points is None:
        return _mixed(raw, stamp_ns, names, start, count, most_mixed_points)
    times_ns = _merged(points, "seconds").astype(np.int64) * NANOSECONDS
    times_ns += _merged(points, "nanoseconds").astype(np.int64)
    return TrajectoryArrays(
        stamp_ns, names, times_ns, *(_merged(points, f"array{k}") for k in range(_ARRAYS))
    )


def _mixed(
    raw: bytes, stamp_ns: int, names: tuple[str, ...], start: int, count: int, most: int
) -> MixedTrajectory:
    """Take points that differ; there may be fewer of them, since each takes its time."""
    if count > most:
        raise MessageError(
            f"a JointTrajectory whose points differ in their arrays may have "
            f"{most} points, not {count}"
        )
    order = "<" if raw[1] else ">"
    lengths, starts, ends = _places(raw, start - ENCAPSULATION, count, order)
    body = np.frombuffer(raw, f"{order}f8", (len(raw) - ENCAPSULATION) // 8, ENCAPSULATION)
    words = np.frombuffer(raw, f"{order}u4", (len(raw) - ENCAPSULATION) // 4, ENCAPSULATION)
    seconds = words[ends // 4].astype(np.uint32).view(np.int32)
    times_ns = seconds.astype(np.int64) * NANOSECONDS + words[ends // 4 + 1]
    starts = starts // 8
    arrays = []
    for k in range(_ARRAYS):
        values = np.full((count, len(names)), np.nan)
        rows = np.flatnonzero(lengths[:, k] == len(names))
        if names:
            values[rows] = body[starts[rows, k, np.newaxis] + np.arange(len(names))]
        arrays.append(values)
    p, v, a, e = arrays
    return MixedTrajectory(stamp_ns, names, times_ns, p, v, a, e, lengths, body, starts)


def _places(
    raw: bytes, start: int, count: int, order: str
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return lengths and starts of each point's arrays, and where its time lies, in bytes.

    All from the end of the encapsulation header.
    """
    unpack = struct.Struct(f"{order}I").unpack_from
    size = len(raw) - ENCAPSULATION
    lengths, starts, ends = (array("q") for _ in range(3))
    at = start
    for _ in range(count):
        for _ in range(_ARRAYS):
            if at + 4 > size:
                raise _too_short(raw, at + 4)
            (length,) = unpack(raw, at + ENCAPSULATION)
            at += 4
            if length:
                at += -at % 8
            lengths.append(length)
            starts.append(at)
            at += 8 * length
        ends.append(at)
        at += 8
        if at > size:
            raise _too_short(raw, at)
    places = [np.frombuffer(each, np.int64).reshape(count, _ARRAYS) for each in (lengths, starts)]
    return places[0], places[1], np.frombuffer(ends, np.int64)


def _too_short(raw: bytes, end: int) -> MessageError:
    return MessageError(
        f"a JointTrajectory of {len(raw)} bytes ends before byte {end + ENCAPSULATION}"
    )


class _Records(NamedTuple):
    """Points of one layout: which of all they are, and their records."""

    which: slice
    values: NDArray[Any]


def _records(
    raw: bytes, start: int, lengths: tuple[int, ...], count: int
) -> tuple[_Records, _Records] | None:
    """Return the points as records; None if they do not all have arrays of these lengths."""
    records = _views(raw, start, lengths, count)
    if records is None:
        return None
    for each in records:
        for k, length in enumerate(lengths):
            if np.any(each.values[f"count{k}"] != length):
                return None
    return records


def _views(
    raw: bytes | bytearray, start: int, lengths: tuple[int, ...], count: int
) -> tuple[_Records, _Records] | None:
    """Return where points of one layout lie, as records; None if there is no room for them.

    A point is a whole number of four bytes, and its doubles stand at multiples of eight: so there
    are two layouts at most. They take turns, or all points but the first have the second.
    """
    phase = (start - ENCAPSULATION) % 8
    first, size = _layout(phase, lengths)
    second, other = _layout((phase + size) % 8, lengths)
    take_turns = (phase + size + other) % 8 == phase
    stride = size + other if take_turns else other
    firsts = (count + 1) // 2 if take_turns else 1
    end = start + firsts * size + (count - firsts) * other
    if end > len(raw):
        return None
    which = (slice(0, None, 2), slice(1, None, 2)) if take_turns else (slice(1), slice(1, None))
    return (
        _Records(which[0], np.ndarray((firsts,), first, raw, start, (stride,))),
        _Records(which[1], np.ndarray((count - firsts,), second, raw, start + size, (stride,))),
    )


def _layout(phase: int, lengths: tuple[int, ...]) -> tuple[np.dtype[Any], int]:
    """Return a point's record and its size, if it starts so far behind a multiple of eight."""
    fields: dict[str, tuple[Any, int]] = {}
    at = 0
    for k, length in enumerate(lengths):
        fields[f"count{k}"] = ("<u4", at)
        at += 4
        if length:
            at += -(phase + at) % 8
        fields[f"array{k}"] = (("<f8", (length,)), at)
        at += 8 * length
    fields["seconds"], fields["nanoseconds"] = ("<i4", at), ("<u4", at + 4)
    size = at + 8
    dtype = np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": size,
        }
    )
    return dtype, size


def _merged(points: tuple[_Records, _Records], field: str) -> NDArray[Any]:
    """Return one field of all points in their order."""
    one, two = (each.values[field] for each in points)
    merged = np.empty((len(one) + len(two), *one.shape[1:]), one.dtype)
    merged[points[0].which], merged[points[1].which] = one, two
    return merged


def encode_trajectory(
    stamp_ns: int, names: Sequence[str], times_ns: NDArray[np.int64], arrays: Sequence[Numbers]
) -> bytes:
    writer = Writer()
    writer.time(stamp_ns)
    writer.string("")
    writer.scalar("I", len(names))
    for name in names:
        writer.string(name)
    writer.scalar("I", len(times_ns))
    lengths = np.stack([np.where(np.isnan(each[:, 0]), 0, len(names)) for each in arrays], axis=1)
    if np.all(lengths == lengths[0]):
        return _as_records(writer.raw, times_ns, arrays, tuple(lengths[0].tolist()))
    for index, row in enumerate(lengths.tolist()):
        for k, length in enumerate(row):
            writer.scalar("I", length)
            if length:
                writer.doubles(arrays[k][index].tolist())
        writer.time(int(times_ns[index]))
    return writer.raw


def encode_joint_trajectory(trajectory: JointTrajectory) -> bytes:
    """Serialise a trajectory, without its efforts."""
    points, names = trajectory.points, trajectory.joint_names
    none = (np.nan,) * len(names)
    arrays = [np.array([point[k] or none for point in points], dtype=float) for k in (1, 2, 3)]
    arrays.append(np.full_like(arrays[0], np.nan))
    times_ns = np.array([point.time_from_start_ns for point in points])
    return encode_trajectory(trajectory.stamp_ns, names, times_ns, arrays)


def _as_records(
    head: bytes, times_ns: NDArray[np.int64], arrays: Sequence[Numbers], lengths: tuple[int, ...]
) -> bytes:
    """Return a message whose points have one layout, behind what stands before them."""
    count, start = len(times_ns), len(head) + -len(head) % 4
    most = sum(4 + 4 + 8 * length for length in lengths) + 8  # of a point, with its padding
    raw = bytearray(start + count * most)
    raw[: len(head)] = head
    records = _views(raw, start, lengths, count)
    assert records is not None  # there is room for the largest points
    seconds, nanoseconds = np.divmod(times_ns, NANOSECONDS)
    end = start
    for which, values in records:
        for k, length in enumerate(lengths):
            values[f"count{k}"] = length
            if length:
                values[f"array{k}"] = arrays[k][which]
        values["seconds"], values["nanoseconds"] = seconds[which], nanoseconds[which]
        end += len(values) * values.dtype.itemsize
    return bytes(memoryview(raw)[:end])


def decode_float64(raw: bytes) -> float:
    if len(raw) != ENCAPSULATION + 8 or raw[0] != 0 or raw[1] not in (0, 1):
        raise MessageError(f"a Float64 has 12 bytes in plain CDR, not {len(raw)}")
    (value,) = struct.unpack_from("<d" if raw[1] else ">d", raw, ENCAPSULATION)
    return float(value)
