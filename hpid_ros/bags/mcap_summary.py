"""The summary at the end of a finished MCAP file: channels, counts, and what each chunk holds."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import BinaryIO, NamedTuple

from hpid_ros.bags.mcap_records import (
    CHUNK_INDEX,
    FOOTER,
    FRAME,
    FRAME_SIZE,
    MAGIC,
    STATISTICS,
    Catalogue,
    Fields,
)
from hpid_ros.errors import BagError

_FOOTER_FIELDS = 20
_CRC_SIZE = 4


class Summary(NamedTuple):
    """What the end of a file says about it.

    Attributes:
        catalogue: Its channels.
        counts: Number of messages by channel; None if there are no statistics.
        chunk_channels: Channels of each chunk, by its position in the file. None named is no
            empty chunk, but one that was written without an index: any may be in it.
        is_complete: Whether all channels are in the catalogue, with their schemas.
    """

    catalogue: Catalogue
    counts: Mapping[int, int] | None
    chunk_channels: Mapping[int, frozenset[int]]
    is_complete: bool


def read_summary(stream: BinaryIO, size: int) -> Summary:
    """Read the summary of a file.

    Args:
        stream: The file.
        size: Its length in bytes.

    Raises:
        BagError: There is none, or it is damaged.
    """
    tail_size = FRAME_SIZE + _FOOTER_FIELDS + len(MAGIC)
    if size < tail_size + len(MAGIC):
        raise BagError("no footer")
    stream.seek(size - tail_size)
    tail = stream.read(tail_size)
    if tail[-len(MAGIC) :] != MAGIC or FRAME.unpack_from(tail) != (FOOTER, _FOOTER_FIELDS):
        raise BagError("no footer")
    footer = Fields(tail[FRAME_SIZE:])
    begin, _, crc = footer.number(8), footer.number(8), footer.number(_CRC_SIZE)
    if not len(MAGIC) <= begin < size - tail_size:
        raise BagError("no summary")
    stream.seek(begin)
    records = stream.read(size - tail_size - begin)
    checked = records + tail[: FRAME_SIZE + _FOOTER_FIELDS - _CRC_SIZE]
    if crc and zlib.crc32(checked) != crc:
        raise BagError("the summary has a wrong checksum")
    return _parsed(records)


def _parsed(records: bytes) -> Summary:
    catalogue = Catalogue()
    counts: dict[int, int] | None = None
    chunk_channels: dict[int, frozenset[int]] = {}
    at = 0
    while at + FRAME_SIZE <= len(records):
        opcode, length = FRAME.unpack_from(records, at)
        at += FRAME_SIZE
        if at + length > len(records):
            raise BagError("the summary is damaged")
        content = records[at : at + length]
        at += length
        if opcode == STATISTICS:
            counts = _counts(content)
        elif opcode == CHUNK_INDEX:
            position, channels = _chunk_channels(content)
            chunk_channels[position] = channels
        else:
            catalogue.add(opcode, content)
    named = {channel for channels in chunk_channels.values() for channel in channels}
    is_complete = (
        counts is not None
        and named | set(counts) <= set(catalogue.channels)
        and not catalogue.lacks_schemas
    )
    return Summary(catalogue, counts, chunk_channels, is_complete)


def _counts(content: bytes) -> dict[int, int]:
    fields = Fields(content)
    fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)  # totals and times
    return {fields.number(2): fields.number(8) for _ in range(fields.number(4) // 10)}


def _chunk_channels(content: bytes) -> tuple[int, frozenset[int]]:
    fields = Fields(content)
    fields.take(16)
    position = fields.number(8)
    fields.take(8)
    pairs = {fields.number(2): fields.number(8) for _ in range(fields.number(4) // 10)}
    return position, frozenset(pairs)
