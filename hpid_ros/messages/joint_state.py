"""``sensor_msgs/msg/JointState`` between bytes and numbers, without a message object.

The wire format is plain CDR (XCDR version 1): a four-byte encapsulation header, then
``header.stamp`` (int32 s, uint32 ns), ``header.frame_id``, ``name``, ``position``, ``velocity``
and ``effort``; every value is aligned to its own size, counted from the end of the
encapsulation header. Stamps are integer nanoseconds and numbers stay IEEE doubles, so nothing
is rounded on the way.

Source: OMG DDS-RTPS 2.5 section 10 (encapsulation), OMG DDS-XTypes 1.3 section 7.4.1 (CDR), and
the definition of ``sensor_msgs/msg/JointState``.

The readers learn where one joint's numbers lie, or several joints', and use that as long as the
layout stays. ``Cursor``, ``Writer`` and ``Layout`` are for any message.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import MessageError
from hpid_ros.base.text import LONGEST_NAME, name_text
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.bounds import LENGTH, LIVE, MessageBounds, require_count, require_size

ENCAPSULATION = 4
_BYTE_ORDERS = {0: ">", 1: "<"}
_DOUBLE = 8


class Cursor:
    """Reads CDR values one after the other and refuses to leave the buffer."""

    def __init__(self, raw: bytes, kind: str) -> None:
        self._kind = kind
        if len(raw) < ENCAPSULATION or raw[0] != 0 or raw[1] not in _BYTE_ORDERS:
            raise MessageError(
                f"a {kind} must start with a plain CDR header (00 00 or 00 01), "
                f"not {bytes(raw[:2]).hex(' ') or 'nothing'}"
            )
        self.raw = raw
        self.order = _BYTE_ORDERS[raw[1]]
        self.offset = ENCAPSULATION

    def align(self, size: int) -> None:
        """Pass the padding before a value of some size."""
        self.offset += -(self.offset - ENCAPSULATION) % size

    def scalar(self, code: str) -> int:
        """Return an integer of a struct code."""
        size = struct.calcsize(code)
        self.align(size)
        self.require(size)
        (value,) = struct.unpack_from(self.order + code, self.raw, self.offset)
        self.offset += size
        return int(value)

    def stamp(self) -> int:
        """Return the stamp of a header in [ns]."""
        seconds, nanoseconds = self.scalar("i"), self.scalar("I")
        require_nanoseconds(nanoseconds)
        return seconds * NANOSECONDS + nanoseconds

    def string(self) -> str:
        length = self.scalar("I")
        self.require(length)
        raw = bytes(self.raw[self.offset : self.offset + length])
        self.offset += length
        try:
            return raw.rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise MessageError(
                f"a {self._kind} name must be UTF-8, not {raw[:LONGEST_NAME]!r}"
            ) from None

    def count(self, what: str, least: int, most: int = sys.maxsize) -> int:
        """Return how many things follow, of so many bytes each; they fit into what is left."""
        count = self.scalar("I")
        require_count(self._kind, what, count, least, len(self.raw) - self.offset, most)
        return count

    def strings(self, what: str = "names", most: int = sys.maxsize) -> tuple[str, ...]:
        return tuple([self.string() for _ in range(self.count(what, LENGTH, most))])

    def double(self) -> float:
        (value,) = self._values("d", 1)
        return float(value)

    def doubles(self, most: int = sys.maxsize) -> tuple[float, ...]:
        return self._values("d", self.count("numbers", _DOUBLE, most))

    def integers(self, code: str) -> tuple[int, ...]:
        """Return a sequence of integers of a struct code."""
        return self._values(code, self.scalar("I"))

    def _values(self, code: str, count: int) -> tuple[Any, ...]:
        if count == 0:
            return ()
        size = struct.calcsize(code)
        self.align(size)
        self.require(count * size)
        values = struct.unpack_from(f"{self.order}{count}{code}", self.raw, self.offset)
        self.offset += count * size
        return values

    def require(self, size: int) -> None:
        """Raise MessageError unless so many bytes are left."""
        if self.offset + size > len(self.raw):
            raise MessageError(
                f"a {self._kind} of {len(self.raw)} bytes ends before byte {self.offset + size}"
            )


class Doubles(NamedTuple):
    """A sequence of doubles in a message."""

    offset: int  # byte of the first, from the start of the message
    length: int  # how many there are
    apart: tuple[int, ...] = ()  # the byte of each, where they do not follow each other

    def place(self, index: int) -> int:
        """Return the first byte of one of them."""
        return self.apart[index] if self.apart else self.offset + _DOUBLE * index


class Walker(Cursor):
    """Passes over stamps and doubles, whose bytes differ between messages of one layout."""

    def __init__(self, raw: bytes, kind: str) -> None:
        super().__init__(raw, kind)
        self._fixed: list[tuple[int, bytes]] = []
        self._passed = 0

    def time(self) -> int:
        """Pass a ``builtin_interfaces`` Time or Duration; return its offset."""
        return self._pass(4, 8)

    def array(self) -> Doubles:
        return self.fixed_array(self.scalar("I"))

    def fixed_array(self, count: int) -> Doubles:
        return Doubles(self._pass(_DOUBLE, _DOUBLE * count) if count else self.offset, count)

    def is_at_end(self) -> bool:
        """Return whether only padding is left."""
        return len(self.raw) - self.offset < 4

    def layout(
        self,
        stamp: int | None,
        names: tuple[str, ...],
        fields: Mapping[str, Doubles],
    ) -> Layout:
        """Return the layout of the message; what has not been passed is padding."""
        self._keep(self.offset)
        return Layout(len(self.raw), names, self.order, stamp, fields, tuple(self._fixed))

    def _pass(self, alignment: int, size: int) -> int:
        self.align(alignment)
        self.require(size)
        begin = self.offset
        self._keep(begin)
        self._passed = self.offset = begin + size
        return begin

    def _keep(self, end: int) -> None:
        """Note what stands between what was passed last and here."""
        if self._passed < end:
            self._fixed.append((self._passed, bytes(self.raw[self._passed : end])))


Words = NDArray[np.uint64]
WORD = 8


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the numbers of a message lie: others of its layout differ in them and in stamps alone.

    Rows begin :data:`ENCAPSULATION` bytes before a message.
    """

    size: int  # bytes of a message
    names: tuple[str, ...]  # joint names; empty if the type carries none
    order: str  # byte order, "<" or ">"
    stamp: int | None  # offset of the header's stamp; None if the type has none
    fields: Mapping[str, Doubles]  # doubles by field
    # (offset, bytes) of what is neither a stamp nor a double, nor padding at the end
    fixed: tuple[tuple[int, bytes], ...]

    @property
    def text(self) -> str:
        """Names and fields in words."""
        fields = [name for name, each in self.fields.items() if each.length]
        return f"{','.join(self.names)}; {', '.join(fields)}"

    def matches(self, raw: bytes) -> bool:
        """Return whether a message has this layout, byte for byte."""
        return len(raw) == self.size and all(
            raw.startswith(segment, offset) for offset, segment in self.fixed
        )

    @cached_property
    def mask(self) -> Words:
        """Bits of a row that all messages of the layout share, (words,)."""
        mask = np.zeros(-(-(self.size + ENCAPSULATION) // WORD) * WORD, dtype=np.uint8)
        for offset, segment in self.fixed:
            begin = ENCAPSULATION + offset
            mask[begin : begin + len(segment)] = 0xFF
        return mask.view("<u8")

    def stamps_ns(self, rows: Words) -> NDArray[np.int64]:
        """Return the header stamps of rows of this layout, (n,), in [ns]; zero without."""
        if self.stamp is None:
            return np.zeros(len(rows), dtype=np.int64)
        # A header is the first field, so that its stamp is one whole word of the row.
        words = np.ascontiguousarray(rows[:, (self.stamp + ENCAPSULATION) // WORD])
        stamps = words.view(f"{self.order}i4")[::2].astype(np.int64)
        stamps *= NANOSECONDS
        stamps += words.view(f"{self.order}u4")[1::2]
        return stamps

    def columns(self, rows: Words, field: str, indices: Sequence[int]) -> Numbers:
        """Return some numbers of each row of this layout, (numbers, n); a copy."""
        # Doubles lie at multiples of 8 bytes from the end of the encapsulation header.
        doubles, first = self.fields[field], ENCAPSULATION
        at = [(doubles.place(index) + first) // WORD for index in indices]
        every = rows.view(f"{self.order}f8")
        are_neighbours = at == list(range(at[0], at[0] + len(at)))
        some = every[:, at[0] : at[0] + len(at)] if are_neighbours else every[:, at]
        return np.array(some.T, dtype=np.float64, order="C")


def joint_state_layout(raw: bytes) -> Layout:
    """Learn the layout of a ``sensor_msgs/JointState``: position, velocity and effort."""
    walker = Walker(raw, "JointState")
    stamp, _, names = walker.time(), walker.string(), walker.strings()
    fields = {field: walker.array() for field in ("position", "velocity", "effort")}
    return walker.layout(stamp, names, fields)


class Writer:
    """Writes CDR values one after the other, little endian."""

    def __init__(self) -> None:
        self._raw = bytearray(b"\x00\x01\x00\x00")

    @property
    def raw(self) -> bytes:
        """The message so far, with its encapsulation header."""
        return bytes(self._raw)

    def _align(self, size: int) -> None:
        self._raw += bytes(-(len(self._raw) - ENCAPSULATION) % size)

    def scalar(self, code: str, value: int) -> None:
        """Append an integer of a struct code."""
        self._align(struct.calcsize(code))
        self._raw += struct.pack(f"<{code}", value)

    def time(self, time_ns: int) -> None:
        """Append a Time or a Duration of so many nanoseconds."""
        seconds, nanoseconds = divmod(time_ns, NANOSECONDS)
        self.scalar("i", seconds)
        self.scalar("I", nanoseconds)

    def string(self, text: str) -> None:
        raw = text.encode() + b"\x00"
        self.scalar("I", len(raw))
        self._raw += raw

    def doubles(self, values: Sequence[float]) -> None:
        """Append doubles without their number, as of an array of fixed length."""
        self._align(_DOUBLE)
        self._raw += struct.pack(f"<{len(values)}d", *values)


def require_nanoseconds(nanoseconds: int) -> None:
    """Refuse a stamp whose nanoseconds are a second or more: it could not be sent back."""
    if nanoseconds >= NANOSECONDS:
        raise MessageError(f"a stamp's nanoseconds must be below 1e9, not {nanoseconds}")


STAMP_OFFSET = ENCAPSULATION
NAMES_OFFSET = STAMP_OFFSET + 8


class JointStateFields(NamedTuple):
    """All fields of a JointState."""

    stamp_ns: int  # [ns] header.stamp
    frame_id: str  # header.frame_id
    names: tuple[str, ...]  # joint names
    position: tuple[float, ...]  # [rad] or [m]; empty when the message has none
    velocity: tuple[float, ...]  # [rad/s] or [m/s]; empty when the message has none
    effort: tuple[float, ...]  # [N m] or [N]; empty when the message has none

    def place_of(self, joint: str) -> int:
        """Return where a joint is; MessageError unless the message names it once."""
        return self.places_of((joint,))[0]

    def places_of(self, joints: Iterable[str], *, may_lack: bool = False) -> list[int]:
        """Return where joints are, -1 for one that may be lacking; none is named twice."""
        wanted = tuple(joints)
        places = dict.fromkeys(wanted, -1)
        for place, name in enumerate(self.names):
            if name in places:
                if places[name] >= 0:
                    raise self._misnamed(name)
                places[name] = place
        for joint in wanted:
            if places[joint] < 0 and not may_lack:
                raise self._misnamed(joint)
        return [places[joint] for joint in wanted]

    def _misnamed(self, joint: str) -> MessageError:
        times = self.names.count(joint)
        return MessageError(
            f"a JointState must name each joint once, not {name_text(joint)} {times} times"
        )

    def require_lengths(self, *others: str) -> None:
        """Raise MessageError unless each name has a position, and all or none have the others."""
        count = len(self.names)
        lengths = [len(getattr(self, field)) for field in ("position", *others)]
        if lengths[0] != count or not {0, count}.issuperset(lengths[1:]):
            raise MessageError(
                f"a JointState of {count} names must have {count} positions and 0 or {count} of "
                f"{' and '.join(others)}, not {', '.join(map(str, lengths))}"
            )


def decode_joint_state(raw: bytes, bounds: MessageBounds = LIVE) -> JointStateFields:
    """Decode any serialised JointState, whatever its layout or byte order."""
    require_size("JointState", len(raw), bounds.size)
    cursor = Cursor(raw, "JointState")
    head = cursor.stamp(), cursor.string(), cursor.strings(most=bounds.names)
    position, velocity, effort = [cursor.doubles(bounds.names) for _ in range(3)]
    return JointStateFields(*head, position, velocity, effort)


class JointStateTemplate:
    """A JointState that is serialised but for its stamp and numbers.

    The bytes equal those that ``rclpy.serialization.serialize_message`` gives for the same
    fields.
    """

    def __init__(
        self,
        names: Sequence[str],
        frame_id: str = "",
        *,
        position: bool = False,
        velocity: bool = False,
        effort: bool = False,
    ) -> None:
        count = len(names)
        writer = Writer()
        writer.time(0)
        writer.string(frame_id)
        writer.scalar("I", count)
        for name in names:
            writer.string(name)
        for is_given in (position, velocity, effort):
            writer.scalar("I", count * is_given)
            if count * is_given:
                writer.doubles([0.0] * count)
        self._buffer = bytearray(writer.raw)
        fields = joint_state_layout(writer.raw).fields.values()
        self._offsets = [each.offset if each.length else 0 for each in fields]
        self._stamp = struct.Struct("<iI")
        self._doubles = struct.Struct(f"<{count}d")

    def encode(
        self,
        stamp_ns: int,
        *,
        position: Sequence[float] = (),
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> bytes:
        buffer = self._buffer
        self._stamp.pack_into(buffer, STAMP_OFFSET, *divmod(stamp_ns, NANOSECONDS))
        at_position, at_velocity, at_effort = self._offsets
        if at_position:
            self._doubles.pack_into(buffer, at_position, *position)
        if at_velocity:
            self._doubles.pack_into(buffer, at_velocity, *velocity)
        if at_effort:
            self._doubles.pack_into(buffer, at_effort, *effort)
        return bytes(buffer)


SIMULATED = "simulated"
"""``frame_id`` of states whose robot is simulated: their clock goes back when it is reset."""


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
        self.is_simulated = False
        """Whether the newest states are of a robot that says that it is simulated."""
        self._layout: Layout | None = None
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
        index = fields.place_of(self.joint)
        fields.require_lengths("velocity")
        self.is_simulated = fields.frame_id == SIMULATED
        self._layout = layout = joint_state_layout(raw)
        position, velocity = (
            layout.fields[field].offset + _DOUBLE * index for field in ("position", "velocity")
        )
        numbers = f"{layout.order}iI{position - NAMES_OFFSET}xd"
        self._has_velocity = bool(fields.velocity)
        if self._has_velocity:
            numbers += f"{velocity - position - _DOUBLE}xd"
        self._numbers = struct.Struct(numbers)
        return self.read(raw)


class EffortReader:
    """Reads serialised effort commands from any number of publishers.

    A command with one name and one effort is recognised by everything between its stamp and
    its last eight bytes; that key is remembered with the name it stands for, and with the sender.
    As many are remembered, and none that is long, as cost less than a megabyte.
    """

    _KEYS_AT_MOST, _KEY_BYTES_AT_MOST = 1024, 512

    def __init__(self) -> None:
        self.sender = ""
        # what was asked for in the last message, positions and velocities, where it says so
        self.asked: tuple[Sequence[float], Sequence[float]] | None = None
        self._known: dict[bytes, tuple[tuple[str, ...], str]] = {}
        self._stamp = struct.Struct("<iI")
        self._effort = struct.Struct("<d")

    def read(self, raw: bytes) -> tuple[int, tuple[str, ...], tuple[float, ...]]:
        """Return stamp in [ns], joint names and their efforts in [N m]."""
        known = self._known.get(raw[NAMES_OFFSET:-8])
        if known is None:
            return self._learn(raw)
        (names, self.sender), self.asked = known, None
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
            key = raw[NAMES_OFFSET:-8]
            has_room = len(self._known) < self._KEYS_AT_MOST
            if has_room and len(key) <= self._KEY_BYTES_AT_MOST:
                layout = joint_state_layout(raw)
                at_end = layout.fields["effort"].offset == len(raw) - _DOUBLE
                if at_end and layout.order == "<":
                    self._known[key] = fields.names, fields.frame_id
        self.sender = fields.frame_id
        is_asked = len(fields.position) == len(fields.velocity) == len(fields.names)
        self.asked = (fields.position, fields.velocity) if is_asked else None
        return fields.stamp_ns, fields.names, fields.effort


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
        self._layout: Layout | None = None
        self._arrays: tuple[tuple[int, struct.Struct] | None, ...] = ()
        self._pick: Callable[[Sequence[float]], Sequence[float]] = tuple

    def read(self, raw: bytes) -> RobotSample:
        layout = self._layout
        if layout is None or not layout.matches(raw):
            return self._learn(raw)
        pick = self._pick
        position, velocity, effort = [
            None if array is None else pick(array[1].unpack_from(raw, array[0]))
            for array in self._arrays
        ]
        return RobotSample(position or (), velocity, effort)

    def _learn(self, raw: bytes) -> RobotSample:
        fields = decode_joint_state(raw)
        indices = fields.places_of(self.joints)
        fields.require_lengths("velocity", "effort")
        self._layout = layout = joint_state_layout(raw)
        numbers = struct.Struct(f"{layout.order}{len(layout.names)}d")
        arrays = layout.fields.values()
        self._arrays = tuple((each.offset, numbers) if each.length else None for each in arrays)
        self._pick = _picking(indices)
        return self.read(raw)


class JointPart(NamedTuple):
    """One of several joints in a JointState."""

    joint: int  # its place among the joints that were asked for
    position: float  # [rad] or [m]
    velocity: float | None  # [rad/s] or [m/s]; None when the message has no velocities


_KnownLayout = tuple[Layout, struct.Struct, struct.Struct, tuple[tuple[int, int], ...]]
"""With its stamp, its doubles, and joints: place among those asked for, place in the message."""


class GroupReader:
    """Finds whichever of several joints serialised JointStates have.

    As in :class:`JointReader` offsets are learned, here of several layouts: the joints of a robot
    may have several publishers.
    """

    _LAYOUTS_AT_MOST = 16

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self._known: list[_KnownLayout] = []

    def read(self, raw: bytes) -> tuple[int, Sequence[JointPart]]:
        """Return the stamp in [ns], and those of the joints that the message has."""
        known = next((each for each in self._known if each[0].matches(raw)), None)
        layout, stamp, numbers, places = known or self._learned(raw)
        seconds, nanoseconds = stamp.unpack_from(raw, STAMP_OFFSET)
        if nanoseconds >= NANOSECONDS:
            require_nanoseconds(nanoseconds)
        stamp_ns = seconds * NANOSECONDS + nanoseconds
        if not places:
            return stamp_ns, ()
        positions = numbers.unpack_from(raw, layout.fields["position"].offset)
        if not layout.fields["velocity"].length:
            return stamp_ns, [JointPart(j, positions[k], None) for j, k in places]
        velocities = numbers.unpack_from(raw, layout.fields["velocity"].offset)
        return stamp_ns, [JointPart(j, positions[k], velocities[k]) for j, k in places]

    def _learned(self, raw: bytes) -> _KnownLayout:
        fields = decode_joint_state(raw)
        found = fields.places_of(self.joints, may_lack=True)
        places = tuple((joint, place) for joint, place in enumerate(found) if place >= 0)
        if places:
            fields.require_lengths("velocity")
        layout = joint_state_layout(raw)
        codes = "iI", f"{len(layout.names)}d"
        stamp, numbers = (struct.Struct(layout.order + code) for code in codes)
        known = layout, stamp, numbers, places
        if len(self._known) < self._LAYOUTS_AT_MOST:
            self._known.append(known)
        return known


def _picking(places: Sequence[int]) -> Callable[[Sequence[float]], Sequence[float]]:
    """Return what takes the numbers at some places."""
    if list(places) == list(range(places[0], places[0] + len(places))):
        return itemgetter(slice(places[0], places[0] + len(places)))
    return itemgetter(*places)
