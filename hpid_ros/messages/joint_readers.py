"""Readers of states and commands: one joint's numbers, or several joints', out of the bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import NamedTuple

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_state import (
    NAMES_OFFSET,
    STAMP_OFFSET,
    JointStateFields,
    JointStateLayout,
    decode_joint_state,
    require_nanoseconds,
)


class JointSample(NamedTuple):
    """One joint's part of a JointState."""

    stamp_ns: int  # [ns] stamp of the message
    position: float  # [rad] or [m]
    velocity: float | None  # [rad/s] or [m/s]; None when the message has no velocities


class JointReader:
    """Finds one joint's numbers in serialised JointStates.

    The offsets are learned from the first message and used as long as the layout stays; any
    other layout takes the general decoder once.
    """

    def __init__(self, joint: str) -> None:
        self.joint = joint
        self._layout: JointStateLayout | None = None
        self._numbers = struct.Struct("")
        self._has_velocity = False

    def read(self, raw: bytes) -> JointSample | None:
        """Return this joint's sample, or None when the message is about other joints."""
        layout = self._layout
        if layout is None or not layout.matches(raw):
            return self._learn(raw)
        if self._has_velocity:
            seconds, nanoseconds, position, velocity = self._numbers.unpack_from(raw, STAMP_OFFSET)
            if nanoseconds >= NANOSECONDS:
                require_nanoseconds(nanoseconds)
            return JointSample(seconds * NANOSECONDS + nanoseconds, position, velocity)
        seconds, nanoseconds, position = self._numbers.unpack_from(raw, STAMP_OFFSET)
        if nanoseconds >= NANOSECONDS:
            require_nanoseconds(nanoseconds)
        return JointSample(seconds * NANOSECONDS + nanoseconds, position, None)

    def _learn(self, raw: bytes) -> JointSample | None:
        fields = decode_joint_state(raw)
        if self.joint not in fields.names:
            return None
        index = fields.names.index(self.joint)
        if self.joint in fields.names[index + 1 :]:
            raise MessageError(f"a JointState must name each joint once, not {self.joint!r} twice")
        count = len(fields.names)
        if len(fields.position) != count or len(fields.velocity) not in (0, count):
            raise MessageError(
                f"a JointState of {count} names must have {count} positions and 0 or {count} "
                f"velocities, not {len(fields.position)} and {len(fields.velocity)}"
            )
        velocity = fields.velocity[index] if fields.velocity else None
        self._remember(raw, fields, index)
        return JointSample(fields.stamp_ns, fields.position[index], velocity)

    def _remember(self, raw: bytes, fields: JointStateFields, index: int) -> None:
        lengths = len(fields.position), len(fields.velocity), len(fields.effort)
        layout = JointStateLayout.for_fields(fields.names, fields.frame_id, lengths)
        if not layout.matches(raw):  # big-endian or oddly padded: not at fixed offsets
            self._layout = None
            return
        position = layout.position + 8 * index
        numbers = f"<iI{position - NAMES_OFFSET}xd"
        self._has_velocity = layout.velocity > 0
        if self._has_velocity:
            numbers += f"{layout.velocity + 8 * index - position - 8}xd"
        self._numbers = struct.Struct(numbers)
        self._layout = layout


class EffortReader:
    """Reads serialised effort commands from any number of publishers.

    A command with one name and one effort is recognised by everything between its stamp and
    its last eight bytes; that key is remembered with the name it stands for, and with the sender.
    So many are remembered, and none that is long, that strangers' cost less than a megabyte.
    """

    _KEYS_AT_MOST, _KEY_BYTES_AT_MOST = 1024, 512

    def __init__(self) -> None:
        self.sender = ""
        self._known: dict[bytes, tuple[tuple[str, ...], str]] = {}
        self._stamp = struct.Struct("<iI")
        self._effort = struct.Struct("<d")

    def read(self, raw: bytes) -> tuple[int, tuple[str, ...], tuple[float, ...]]:
        """Return stamp in [ns], joint names and their efforts in [N m]."""
        known = self._known.get(raw[NAMES_OFFSET:-8])
        if known is None:
            return self._learn(raw)
        names, self.sender = known
        seconds, nanoseconds = self._stamp.unpack_from(raw, STAMP_OFFSET)
        return (
            seconds * NANOSECONDS + nanoseconds,
            names,
            self._effort.unpack_from(raw, len(raw) - 8),
        )

    def _learn(self, raw: bytes) -> tuple[int, tuple[str, ...], tuple[float, ...]]:
        fields = decode_joint_state(raw)
        if len(fields.effort) != len(fields.names):
            raise MessageError(
                f"a command must have one effort for each name, not {len(fields.effort)} "
                f"efforts for {len(fields.names)} names"
            )
        if len(fields.names) == 1 and not fields.position and not fields.velocity:
            expected = JointStateLayout.for_fields(fields.names, fields.frame_id, (0, 0, 1))
            key = raw[NAMES_OFFSET:-8]
            has_room = len(self._known) < self._KEYS_AT_MOST
            if has_room and len(key) <= self._KEY_BYTES_AT_MOST and expected.matches(raw):
                self._known[key] = fields.names, fields.frame_id
        self.sender = fields.frame_id
        return fields.stamp_ns, fields.names, fields.effort


_DOUBLE = 8
_Pick = Callable[[Sequence[float]], Sequence[float]]


class RobotSample(NamedTuple):
    """Several joints' part of a JointState, in the order that was asked for."""

    position: Sequence[float]  # [rad] or [m]
    velocity: Sequence[float] | None  # [rad/s] or [m/s]; None when the message has no velocities
    effort: Sequence[float] | None  # [N m] or [N]; None when the message has no efforts


class RobotReader:
    """Finds several joints' numbers in serialised JointStates.

    As in :class:`JointReader`, the offsets are learned and used as long as the layout stays.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self._layout: JointStateLayout | None = None
        self._numbers = struct.Struct("")
        self._picks: tuple[_Pick | None, ...] = ()

    def read(self, raw: bytes) -> RobotSample:
        """Return the joints' sample."""
        layout = self._layout
        if layout is None or not layout.matches(raw):
            return self._learn(raw)
        numbers = self._numbers.unpack_from(raw, layout.position)
        positions, velocities, efforts = self._picks
        return RobotSample(
            positions(numbers),  # type: ignore[misc]
            None if velocities is None else velocities(numbers),
            None if efforts is None else efforts(numbers),
        )

    def _learn(self, raw: bytes) -> RobotSample:
        fields = decode_joint_state(raw)
        count = len(fields.names)
        for joint in self.joints:
            if fields.names.count(joint) != 1:
                raise MessageError(
                    f"a JointState must name each joint of the model once, "
                    f"not {joint!r} {fields.names.count(joint)} times"
                )
        arrays = (fields.position, fields.velocity, fields.effort)
        lengths = tuple(len(array) for array in arrays)
        if lengths[0] != count or not {lengths[1], lengths[2]} <= {0, count}:
            raise MessageError(
                f"a JointState of {count} names must have {count} positions and 0 or {count} "
                f"velocities and efforts, not {lengths[0]}, {lengths[1]} and {lengths[2]}"
            )
        indices = [fields.names.index(joint) for joint in self.joints]
        self._remember(raw, fields, indices)
        found = [tuple(array[k] for k in indices) if array else None for array in arrays]
        return RobotSample(found[0] or (), found[1], found[2])

    def _remember(self, raw: bytes, fields: JointStateFields, indices: Sequence[int]) -> None:
        lengths = len(fields.position), len(fields.velocity), len(fields.effort)
        layout = JointStateLayout.for_fields(fields.names, fields.frame_id, lengths)
        if not layout.matches(raw):  # big-endian or oddly padded: not at fixed offsets
            self._layout = None
            return
        numbers, at, first = "<", layout.position, 0
        picks: list[_Pick | None] = []
        for start, length in zip(
            (layout.position, layout.velocity, layout.effort), lengths, strict=True
        ):
            if not length:
                picks.append(None)
                continue
            numbers += f"{start - at}x{length}d"
            at = start + _DOUBLE * length
            picks.append(_picking([first + index for index in indices]))
            first += length
        self._numbers = struct.Struct(numbers)
        self._picks = tuple(picks)
        self._layout = layout


class JointPart(NamedTuple):
    """One of several joints in a JointState."""

    joint: int  # its place among the joints that were asked for
    position: float  # [rad] or [m]
    velocity: float | None  # [rad/s] or [m/s]; None when the message has no velocities


class _Known(NamedTuple):
    """A layout, and where its joints are."""

    layout: JointStateLayout
    numbers: struct.Struct
    places: tuple[tuple[int, int], ...]  # (place among the joints asked for, place in the message)


class GroupReader:
    """Finds whichever of several joints serialised JointStates have.

    As in :class:`JointReader` offsets are learned, here of several layouts:
    the joints of a robot may be told by several publishers.
    """

    _LAYOUTS_AT_MOST = 16

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self._known: list[_Known] = []
        self._stamp = struct.Struct("<iI")

    def read(self, raw: bytes) -> tuple[int, Sequence[JointPart]]:
        """Return the stamp in [ns], and those of the joints that the message has."""
        known = next((each for each in self._known if each.layout.matches(raw)), None)
        if known is None:
            return self._learn(raw)
        layout, numbers, places = known
        seconds, nanoseconds = self._stamp.unpack_from(raw, STAMP_OFFSET)
        if nanoseconds >= NANOSECONDS:
            require_nanoseconds(nanoseconds)
        stamp_ns = seconds * NANOSECONDS + nanoseconds
        if not places:
            return stamp_ns, ()
        positions = numbers.unpack_from(raw, layout.position)
        if not layout.velocity:
            return stamp_ns, [JointPart(j, positions[k], None) for j, k in places]
        velocities = numbers.unpack_from(raw, layout.velocity)
        return stamp_ns, [JointPart(j, positions[k], velocities[k]) for j, k in places]

    def _learn(self, raw: bytes) -> tuple[int, Sequence[JointPart]]:
        fields = decode_joint_state(raw)
        count = len(fields.names)
        found = [(j, joint) for j, joint in enumerate(self.joints) if joint in fields.names]
        for _, joint in found:
            if fields.names.count(joint) != 1:
                raise MessageError(
                    f"a JointState must name each joint once, not {joint!r} "
                    f"{fields.names.count(joint)} times"
                )
        if found and (len(fields.position) != count or len(fields.velocity) not in (0, count)):
            raise MessageError(
                f"a JointState of {count} names must have {count} positions and 0 or {count} "
                f"velocities, not {len(fields.position)} and {len(fields.velocity)}"
            )
        places = tuple((j, fields.names.index(joint)) for j, joint in found)
        lengths = len(fields.position), len(fields.velocity), len(fields.effort)
        layout = JointStateLayout.for_fields(fields.names, fields.frame_id, lengths)
        if layout.matches(raw) and len(self._known) < self._LAYOUTS_AT_MOST:
            self._known.append(_Known(layout, struct.Struct(f"<{count}d"), places))
        return fields.stamp_ns, [
            JointPart(j, fields.position[k], fields.velocity[k] if fields.velocity else None)
            for j, k in places
        ]


def _picking(places: Sequence[int]) -> _Pick:
    """Return what takes the numbers at some places."""
    if list(places) == list(range(places[0], places[0] + len(places))):
        return itemgetter(slice(places[0], places[0] + len(places)))
    return itemgetter(*places)
