"""Messages of one topic, many at once, as places in a buffer and rows of bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]

SLACK = 64
"""Bytes of a buffer before its first and after its last message, so that rows may reach out."""


class TopicInfo(NamedTuple):
    """A topic of a bag."""

    type: str  # message type, for instance "sensor_msgs/msg/JointState"
    encoding: str  # of the messages; "cdr" in all of ROS 2
    message_count: int | None  # number of messages by the index; None if the bag has none
    definition: str  # the type's definition as recorded; empty if it was not


class TopicBatch(NamedTuple):
    """Messages of one topic, in the order in which the file holds them."""

    topic: str  # full name
    buffer: Bytes  # bytes; valid until the next batch is asked for
    starts: Integers  # first byte of each serialised message, (n,)
    sizes: Integers  # their lengths in bytes, (n,)
    log_times_ns: Integers  # [ns] when they were recorded, (n,)
    places: Integers  # ascending numbers that order all messages of the bag as its files do, (n,)

    def raw(self, index: int) -> bytes:
        """Return one serialised message."""
        start = int(self.starts[index])
        return self.buffer[start : start + int(self.sizes[index])].tobytes()


def batch_of(
    topic: str, raws: Sequence[bytes], log_times_ns: Integers, places: Integers
) -> TopicBatch:
    """Return messages that lie apart as a batch."""
    slack = bytes(SLACK)
    sizes = np.fromiter(map(len, raws), np.int64, len(raws))
    buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
    return TopicBatch(topic, buffer, SLACK + np.cumsum(sizes) - sizes, sizes, log_times_ns, places)


def count_difference(told: Mapping[str, int], found: Mapping[str, int]) -> str:
    """Return in words where two counts of messages differ; empty if nowhere."""
    unequal = [(name, told[name], found.get(name, 0)) for name in sorted(told)]
    return "; ".join(
        f"{count} messages on {name}, not {seen}" for name, count, seen in unequal if count != seen
    )


Report = Callable[[str], None]
"""Takes one line about something that could not be read."""

Advance = Callable[[int], None]
"""Takes the number of bytes of a file that are done."""


class StorageFile(Protocol):
    """One file of a bag."""

    def topics(self) -> Mapping[str, TopicInfo]:
        """Return its topics by full name."""

    def batches(
        self, topics: frozenset[str], report: Report, done: Advance
    ) -> Iterator[TopicBatch]:
        """Yield the messages of some topics; what cannot be read is reported, never raised."""

    def close(self) -> None:
        """Close the file."""


Words = NDArray[np.uint64]
WORD = 8


def gather_words(buffer: Bytes, starts: Integers, words: int) -> Words:
    """Return ``words`` little-endian words from each start, (n, words)."""
    width = words * WORD
    # One opaque item a place, overlapping: indexing it is one copy of a row's bytes.
    every: NDArray[np.void] = np.ndarray(
        (max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,)
    )
    rows = np.ascontiguousarray(every[starts])
    return rows.view("<u8").reshape(len(starts), words)
