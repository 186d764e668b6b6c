"""Batches of a bag's messages, and how much of what is packed may be unpacked.

A few kilobytes can unpack to any number of gigabytes. So everything is unpacked up to a stated
size only: what a chunk declares, and never more than the :class:`Allowance` of its file.
"""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import BagError, SettingError

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
        start = int(self.starts[index])
        return self.buffer[start : start + int(self.sizes[index])].tobytes()

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield log time [ns], place and bytes of each message."""
        times, places = self.log_times_ns.tolist(), self.places.tolist()
        return zip(times, places, self.raws(), strict=True)

    def raws(self) -> Iterator[bytes]:
        return map(self.raw, range(len(self.starts)))

    def picked(self, which: NDArray[np.bool_]) -> TopicBatch:
        """Return some of the messages."""
        return TopicBatch(self.topic, self.buffer, *(part[which] for part in self[2:]))


def batch_of(
    topic: str, raws: Sequence[bytes], log_times_ns: Integers, places: Integers
) -> TopicBatch:
    """Return messages that lie apart as a batch."""
    slack = bytes(SLACK)
    sizes = np.fromiter(map(len, raws), np.int64, len(raws))
    buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
    return TopicBatch(topic, buffer, SLACK + np.cumsum(sizes) - sizes, sizes, log_times_ns, places)


def count_difference(counted: Mapping[str, int], found: Mapping[str, int]) -> str:
    """Return a text of where two counts of messages differ; empty if nowhere."""
    unequal = [(name, counted[name], found.get(name, 0)) for name in sorted(counted)]
    return "; ".join(
        f"{count} messages on {name}, not {seen}" for name, count, seen in unequal if count != seen
    )


Report = Callable[[str], None]
"""Takes one line about something that could not be read."""

Advance = Callable[[int], None]
"""Takes the number of bytes of a file that are done."""


LIMIT_VARIABLE = "HPID_UNPACK_LIMIT"
"""Environment variable with the bytes that may be unpacked whatever they are packed in."""

DEFAULT_LIMIT = 256 << 20
"""Its default, in bytes: a hundred times what a recorder puts into a chunk."""

RATIO = 100
"""How often its own size anything may unpack to; recordings of joints reach some 10."""

_BLOCK = 1 << 20


class Allowance:
    """How much one reading of a file may unpack.

    :data:`LIMIT_VARIABLE` bytes, and :data:`RATIO` times what they are packed in: memory, disk and
    time stay in proportion to the file.
    """

    def __init__(self) -> None:
        text = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT))
        if not (text.isascii() and text.isdecimal()):
            raise SettingError(f"{LIMIT_VARIABLE} must be a number of bytes, not {text!r}")
        self._limit = self._spare = int(text)

    def room(self, packed: int) -> int:
        """Return how much may come out of so many packed bytes."""
        return self._spare + RATIO * packed

    def require(self, packed: int, size: int) -> None:
        """Raise BagError unless so many bytes may come out of the packed ones."""
        if size > self.room(packed):
            raise self.refusal(packed)

    def refusal(self, packed: int) -> BagError:
        """Return the error for packed bytes that hold more than may come out."""
        return BagError(
            f"{packed} bytes would unpack to more than {self.room(packed)}; "
            f"{LIMIT_VARIABLE} (now {self._limit} bytes) allows more"
        )

    def spend(self, packed: int, size: int) -> None:
        """Take into account what came out."""
        self._spare = min(self._limit, self.room(packed) - size)


def decompressed(compression: str, raw: bytes, size: int, crc: int, allowance: Allowance) -> bytes:
    allowance.require(len(raw), size)
    records, is_whole = _unpacked(compression, raw, size)
    allowance.spend(len(raw), len(records))
    if not is_whole or len(records) != size:
        raise BagError(f"{len(records)} bytes{'' if is_whole else ' and more'} instead of {size}")
    check_sum(records, crc)
    return records


def decompressed_part(compression: str, raw: bytes, most: int, allowance: Allowance) -> bytes:
    """Return what can be decompressed of a chunk that is cut off, up to a size."""
    part, _ = _unpacked(compression, raw, min(most, allowance.room(len(raw))))
    allowance.spend(len(raw), len(part))
    return part


def decompressed_message(raw: bytes, allowance: Allowance) -> bytes:
    """Return a message that was compressed by itself, with zstd."""
    message, is_whole = _unpacked("zstd", raw, allowance.room(len(raw)))
    if not is_whole:
        raise allowance.refusal(len(raw))
    allowance.spend(len(raw), len(message))
    return message


def unpack_file(source: Path, target: Path, allowance: Allowance) -> bool:
    """Unpack a zstd file as far as it goes."""
    zstd = zstd_library()
    packed, size = source.stat().st_size, 0
    with zstd.open(source, "rb") as stream, target.open("wb") as unpacked:
        try:
            while block := stream.read(_BLOCK):
                size += len(block)
                allowance.require(packed, size)
                unpacked.write(block)
        except (EOFError, zstd.ZstdError):
            return False
    return True


def check_sum(records: Any, crc: int) -> None:
    """Raise BagError unless the checksum is right or not given."""
    if crc and zlib.crc32(records) != crc:
        raise BagError("wrong checksum")


def _unpacked(compression: str, raw: bytes, most: int) -> tuple[bytes, bool]:
    """Return what comes out of one or several frames up to a size, and whether that is all."""
    if compression not in ("zstd", "lz4"):
        raise BagError(f"unknown compression {compression!r}")
    if compression == "zstd":
        new = zstd_library().ZstdDecompressor
    else:
        import lz4.frame  # type: ignore[import-untyped]

        new = lz4.frame.LZ4FrameDecompressor
    parts: list[bytes] = []
    try:
        while raw:
            frame = new()
            # One byte more than may come out tells whether there is more.
            parts.append(frame.decompress(raw, most + 1))
            most -= len(parts[-1])
            if most < 0:
                return b"".join(parts)[:most], False
            if not frame.eof:
                break
            raw = frame.unused_data or b""
    # Both libraries raise whatever their C code finds: RuntimeError, ZstdError, EOFError.
    except Exception as error:
        raise BagError(f"{compression} data is damaged") from error
    return parts[0] if len(parts) == 1 else b"".join(parts), True


def zstd_library() -> Any:
    """Return zstd: of the standard library from CPython 3.14 on, else its backport."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd
