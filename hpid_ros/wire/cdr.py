"""Plain CDR (XCDR version 1), as ROS 2 puts messages on the wire.

A four-byte encapsulation header, then the fields; every value is aligned to its own size,
counted from the end of that header.

Source: OMG DDS-RTPS 2.5 section 10 (encapsulation), OMG DDS-XTypes 1.3 section 7.4.1 (CDR).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS

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
        self._raw = raw
        self._order = _BYTE_ORDERS[raw[1]]
        self.offset = ENCAPSULATION

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ENCAPSULATION) % size

    def scalar(self, code: str) -> int:
        """Return an integer of a struct code."""
        size = struct.calcsize(code)
        self._align(size)
        self._require(size)
        (value,) = struct.unpack_from(self._order + code, self._raw, self.offset)
        self.offset += size
        return int(value)

    def string(self) -> str:
        """Return a text."""
        length = self.scalar("I")
        self._require(length)
        raw = bytes(self._raw[self.offset : self.offset + length])
        self.offset += length
        try:
            return raw.rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise MessageError(f"a {self._kind} name must be UTF-8, not {raw!r}") from None

    def strings(self) -> tuple[str, ...]:
        """Return a sequence of texts."""
        count = self.scalar("I")
        if count > len(self._raw):
            raise MessageError(
                f"a {self._kind} of {len(self._raw)} bytes cannot hold {count} names"
            )
        return tuple(self.string() for _ in range(count))

    def double(self) -> float:
        """Return a double."""
        (value,) = self._values("d", 1)
        return float(value)

    def doubles(self) -> tuple[float, ...]:
        """Return a sequence of doubles."""
        return self._values("d", self.scalar("I"))

    def integers(self, code: str) -> tuple[int, ...]:
        """Return a sequence of integers of a struct code."""
        return self._values(code, self.scalar("I"))

    def _values(self, code: str, count: int) -> tuple[Any, ...]:
        if count == 0:
            return ()
        size = struct.calcsize(code)
        self._align(size)
        self._require(count * size)
        values = struct.unpack_from(f"{self._order}{count}{code}", self._raw, self.offset)
        self.offset += count * size
        return values

    def _require(self, size: int) -> None:
        if self.offset + size > len(self._raw):
            raise MessageError(
                f"a {self._kind} of {len(self._raw)} bytes ends before byte {self.offset + size}"
            )


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

    def string(self, text: str) -> None:
        """Append a text."""
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
