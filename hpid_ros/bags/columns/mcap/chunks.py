"""From the bytes of MCAP chunks to the places of their messages, many chunks at once.

The message index of a chunk says where its messages are; each entry is compared with the record
it points at, and the records must fill the chunk without a hole. Where they do not, the records
are walked one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import Bytes, Integers, Report, gather_words
from hpid_ros.bags.columns.mcap.records import (
    CHANNEL,
    FRAME,
    FRAME_SIZE,
    MESSAGE,
    MESSAGE_HEAD,
    SCHEMA,
    Catalogue,
    candidates,
    is_plausible,
    is_sound,
)
from hpid_ros.base.errors import BagError

if TYPE_CHECKING:
    from collections.abc import Sequence

_BEFORE = 7  # bytes gathered before a record, so that its length becomes one aligned word
_WORDS = 4


class Messages(NamedTuple):
    """Message records in a buffer, by channel and then by place."""

    starts: Integers  # where the records begin, (n,)
    lengths: Integers  # lengths of their contents, (n,)
    channels: Integers  # their channels, (n,)
    log_times_ns: Integers  # [ns] their log times, (n,)


@dataclass
class Chunk:
    """One chunk's records in a buffer."""

    begin: int  # where they begin in the buffer
    end: int  # where they end
    position: int  # where the chunk begins in the file, for messages to people
    index: list[tuple[int, bytes]] = field(default_factory=list)
    starts: list[int] | None = None  # where its messages are, if that is known already


def locate(
    buffer: Bytes, chunks: Sequence[Chunk], catalogue: Catalogue, report: Report
) -> Iterator[Messages]:
    """Yield the messages of chunks; of intact ones all at once, of others one by one."""
    indexed = [chunk for chunk in chunks if chunk.index]
    is_intact, messages = _by_index(buffer, indexed)
    intact = {id(chunk) for chunk, fine in zip(indexed, is_intact, strict=True) if fine}
    if len(intact) == len(chunks):
        if len(messages.starts):
            yield messages
        return
    for chunk in chunks:
        if id(chunk) in intact:
            yield _by_index(buffer, [chunk])[1]
        else:
            yield _walked(buffer, chunk, catalogue, report)


def _by_index(buffer: Bytes, chunks: Sequence[Chunk]) -> tuple[list[bool], Messages]:
    """Return which chunks are filled by what their index points at, and all valid entries."""
    index = [(entry, number) for number, chunk in enumerate(chunks) for entry in chunk.index]
    index.sort(key=lambda entry: entry[0][0])
    counts = [len(raw) // 16 for (_, raw), _ in index]
    entries = (raw[: 16 * count] for ((_, raw), _), count in zip(index, counts, strict=True))
    offsets = np.frombuffer(b"".join(entries), dtype="<i8")[1::2]  # times lie between
    channels = np.repeat(np.array([channel for (channel, _), _ in index], np.int64), counts)
    owner = np.repeat(np.array([number for _, number in index], dtype=np.int64), counts)
    begins = np.array([chunk.begin for chunk in chunks], dtype=np.int64)
    ends = np.array([chunk.end for chunk in chunks], dtype=np.int64)
    starts = begins[owner] + offsets
    rooms = ends - begins - FRAME_SIZE - MESSAGE_HEAD
    is_inside = (offsets >= 0) & (offsets <= rooms[owner])
    if not is_inside.all():
        starts = np.where(is_inside, starts, begins[owner])
    found = _heads(buffer, starts, is_inside, ends[owner])
    is_valid, messages = found
    is_valid &= messages.channels == channels
    # A record that is named twice could stand for one that is not named.
    back = np.flatnonzero(starts[1:] <= starts[:-1])
    is_same = (owner[back] == owner[back + 1]) & (channels[back] == channels[back + 1])
    is_valid[back[is_same] + 1] = False
    sizes = np.where(is_valid, messages.lengths + FRAME_SIZE, 0)
    filled = np.bincount(owner, sizes, len(chunks))  # exact: far below 2^53
    is_intact = (filled == ends - begins).tolist()
    if is_valid.all() and all(is_intact):
        return is_intact, messages
    return is_intact, Messages(*(part[is_valid] for part in messages))


def _heads(
    buffer: Bytes, starts: Integers, is_inside: Any, ends: Integers
) -> tuple[Any, Messages]:
    """Read the heads of records and tell which are messages that end in time."""
    words = gather_words(buffer, starts - _BEFORE, _WORDS)
    lengths = words[:, 1].view(np.int64)
    channels = (words[:, 2] & np.uint64(0xFFFF)).view(np.int64)
    log_times = (words[:, 2] >> np.uint64(48)) | (words[:, 3] << np.uint64(16))
    is_valid = is_inside & ((words[:, 0] >> np.uint64(56)) == MESSAGE)
    is_valid &= (lengths >= MESSAGE_HEAD) & (lengths <= ends - starts - FRAME_SIZE)
    return is_valid, Messages(starts, lengths, channels, log_times.view(np.int64))


def _walked(buffer: Bytes, chunk: Chunk, catalogue: Catalogue, report: Report) -> Messages:
    """Walk the records of one chunk; after a damage go on where records are sound again."""
    if chunk.starts is not None:
        return _messages_at(buffer, chunk.starts, chunk.end)
    starts: list[int] = []
    at, lost = chunk.begin, 0
    while at < chunk.end:
        stop = walk(buffer, at, chunk.end, catalogue, starts)
        if stop == chunk.end:
            break
        at = _resume(buffer, stop, chunk.end)
        lost += at - stop
    if lost:
        report(f"{lost} bytes of the chunk at byte {chunk.position} are damaged, left out")
    return _messages_at(buffer, starts, chunk.end)


def _messages_at(buffer: Bytes, starts: list[int], end: int) -> Messages:
    places = np.array(starts, dtype=np.int64)
    is_inside = np.ones(len(places), dtype=np.bool_)
    is_valid, messages = _heads(buffer, places, is_inside, np.full(len(places), end))
    by_channel = np.flatnonzero(is_valid)
    by_channel = by_channel[np.argsort(messages.channels[by_channel], kind="stable")]
    return Messages(*(part[by_channel] for part in messages))


def walk(buffer: Bytes, begin: int, end: int, catalogue: Catalogue, starts: list[int]) -> int:
    """Walk records until the end, or until something is no record; return where that was."""
    view = buffer.data
    unpack = FRAME.unpack_from
    at, last = begin, end - FRAME_SIZE
    while at <= last:
        opcode, length = unpack(view, at)
        following = at + FRAME_SIZE + length
        if following > end or not is_plausible(opcode, length):
            return at
        if opcode == MESSAGE:
            starts.append(at)
        elif opcode in (SCHEMA, CHANNEL):
            try:
                catalogue.add(opcode, bytes(view[at + FRAME_SIZE : following]))
            except BagError:
                return at
        else:  # only these three may be in a chunk
            return at
        at = following
    return at


def _resume(buffer: Bytes, stop: int, end: int) -> int:
    """Return where records are sound again after a damage; the end if nowhere."""

    def peek(position: int) -> tuple[int, int] | None:
        if position + FRAME_SIZE > end:
            return None
        opcode, length = FRAME.unpack_from(buffer.data, position)
        return int(opcode), int(length)

    for offset in candidates(buffer[stop + 1 : end], MESSAGE, end - stop):
        if is_sound(peek, stop + 1 + offset, end):
            return stop + 1 + offset
    return end
