"""One MCAP file: finished or cut off, with or without chunks, summary and index."""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from hpid_ros.bags.columns.batches import (
    Advance,
    Bytes,
    Report,
    TopicBatch,
    TopicInfo,
    count_difference,
)
from hpid_ros.bags.columns.mcap.chunks import Messages, locate
from hpid_ros.bags.columns.mcap.records import (
    CHUNK_INDEX,
    FOOTER,
    FRAME,
    FRAME_SIZE,
    MAGIC,
    MESSAGE_HEAD,
    STATISTICS,
    Catalogue,
    Fields,
)
from hpid_ros.bags.columns.mcap.stream import Arena, RecordStream
from hpid_ros.base.errors import BagError

_FOOTER_FIELDS = 20
_CRC_SIZE = 4


class McapSummary(NamedTuple):
    """What the end of a file says about it."""

    catalogue: Catalogue  # its channels
    counts: Mapping[int, int] | None  # number of messages by channel
    # channels of each chunk, by its position in the file
    chunk_channels: Mapping[int, frozenset[int]]
    is_complete: bool  # whether all channels are in the catalogue, with their schemas


def read_summary(stream: BinaryIO, size: int) -> McapSummary:
    """Read the summary of a file."""
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


def _parsed(records: bytes) -> McapSummary:
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
    return McapSummary(catalogue, counts, chunk_channels, is_complete)


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


class McapFile:
    """An open MCAP file."""

    def __init__(self, path: Path, report: Report) -> None:
        try:
            self._stream = path.open("rb")
        except OSError as error:
            raise BagError(str(error.strerror or error)) from error
        self._size = os.fstat(self._stream.fileno()).st_size
        if self._stream.read(len(MAGIC)) != MAGIC:
            self._stream.close()
            raise BagError("it does not begin as an MCAP file")
        self._catalogue = Catalogue()
        self._counts: Mapping[int, int] | None = None
        self._chunk_channels: Mapping[int, frozenset[int]] = {}
        try:
            summary = read_summary(self._stream, self._size)
        except BagError:
            self._find_channels(report)
            return
        self._counts = summary.counts
        if summary.is_complete:
            self._catalogue, self._chunk_channels = summary.catalogue, summary.chunk_channels
        else:
            self._find_channels(report)

    def _find_channels(self, report: Report) -> None:
        """Walk every record once for the channels alone."""
        records, arena = RecordStream(self._stream, self._size, self._catalogue), Arena()
        for _ in records.fill(arena, lambda position: True, report):
            for _ in locate(arena.buffer, arena.chunks, self._catalogue, lambda line: None):
                pass
            arena.clear()
        if records.is_finished:
            report("the index is missing or damaged; it was read without")

    def topics(self) -> dict[str, TopicInfo]:
        """Return the topics by full name."""
        topics: dict[str, TopicInfo] = {}
        for number, channel in self._catalogue.channels.items():
            before = topics.get(channel.topic)
            count = None
            if self._counts is not None:
                count = self._counts.get(number, 0) + (
                    (before.message_count or 0) if before else 0
                )
            topics[channel.topic] = TopicInfo(
                channel.type, channel.encoding, count, channel.definition
            )
        return topics

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""
        numbers = frozenset(n for n, c in self._catalogue.channels.items() if c.topic in topics)
        chunks = self._chunk_channels
        found: Counter[int] = Counter()

        def is_wanted(position: int) -> bool:
            channels = chunks.get(position)  # without an index there are none: unknown
            return not channels or not numbers.isdisjoint(channels)

        records = RecordStream(self._stream, self._size, self._catalogue, bool(chunks))
        arena, place = Arena(), 0
        for position in records.fill(arena, is_wanted, report):
            for messages in locate(arena.buffer, arena.chunks, self._catalogue, report):
                yield from self._by_topic(arena.buffer, messages, topics, place, found)
            place += arena.fill
            arena.clear()
            done(position)
        self._compare_counts(numbers, found, report)

    def _compare_counts(
        self, numbers: Iterable[int], found: Mapping[int, int], report: Report
    ) -> None:
        """Report where the file holds another number of messages than its statistics count."""
        if self._counts is None:
            return
        told: Counter[str] = Counter()
        seen: Counter[str] = Counter()
        for number in numbers:
            topic = self._catalogue.channels[number].topic
            told[topic] += self._counts.get(number, 0)
            seen[topic] += found.get(number, 0)
        line = count_difference(told, seen)
        if line:
            report(f"its statistics count {line}")

    def _by_topic(
        self,
        buffer: Bytes,
        messages: Messages,
        topics: frozenset[str],
        place: int,
        found: Counter[int],
    ) -> Iterator[TopicBatch]:
        """Yield the messages of each wanted topic in the order of the file, and count them."""
        channels = self._catalogue.channels
        head = FRAME_SIZE + MESSAGE_HEAD
        for topic in sorted({channel.topic for channel in channels.values()} & topics):
            numbers = [n for n, channel in channels.items() if channel.topic == topic]
            spans = [
                slice(*np.searchsorted(messages.channels, [number, number + 1]).tolist())
                for number in numbers
            ]
            for number, span in zip(numbers, spans, strict=True):
                found[number] += span.stop - span.start
            starts, lengths, _, times = (
                part[spans[0]] if len(spans) == 1 else np.concatenate([part[s] for s in spans])
                for part in messages
            )
            if not len(starts):
                continue
            if (starts[1:] < starts[:-1]).any():
                order = np.argsort(starts, kind="stable")
                starts, lengths, times = starts[order], lengths[order], times[order]
            yield TopicBatch(
                topic, buffer, starts + head, lengths - MESSAGE_HEAD, times, starts + place
            )
