"""Walks one serialised message and notes where its numbers lie.

Plain CDR (XCDR version 1): a four-byte encapsulation header, then values aligned to their own
size, counted from the header's end. Source: OMG DDS-XTypes 1.3 section 7.4.1.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from hpid_ros.errors import MessageError

ENCAPSULATION = 4
_DOUBLE = 8
_STAMP = 8
_BYTE_ORDERS = {0: ">", 1: "<"}


class Doubles(NamedTuple):
    """A sequence of doubles in a message.

    Attributes:
        offset: Byte of the first, from the start of the message.
        length: How many there are.
    """

    offset: int
    length: int


class CdrWalker:
    """Reads values one after the other and refuses to leave the message.

    Args:
        raw: The serialised message.
        what: Its name for errors, for instance ``"a JointState"``.

    Attributes:
        order: Byte order as :mod:`struct` writes it.
        offset: Byte of the next value.
        variable: ``(offset, length)`` of the bytes that are numbers, and may differ between
            messages of one layout.

    Raises:
        MessageError: By every method, when the message is no plain CDR or ends too soon.
    """

    def __init__(self, raw: bytes, what: str) -> None:
        if len(raw) < ENCAPSULATION or raw[0] != 0 or raw[1] not in _BYTE_ORDERS:
            raise MessageError(
                f"{what} must start with a plain CDR header (00 00 or 00 01), "
                f"not {raw[:2].hex(' ') or 'nothing'}"
            )
        self._raw, self._what = raw, what
        self.order = _BYTE_ORDERS[raw[1]]
        self.offset = ENCAPSULATION
        self.variable: list[tuple[int, int]] = []

    def count(self) -> int:
        """Return the next 32-bit length."""
        self._align(4)
        self._require(4)
        (value,) = struct.unpack_from(f"{self.order}I", self._raw, self.offset)
        self.offset += 4
        return int(value)

    def text(self) -> str:
        """Return the next string."""
        length = self.count()
        self._require(length)
        raw = self._raw[self.offset : self.offset + length]
        self.offset += length
        try:
            return raw.rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise MessageError(f"{self._what} has a name that is not UTF-8: {raw!r}") from None

    def texts(self) -> tuple[str, ...]:
        """Return the next sequence of strings."""
        count = self.count()
        if count > len(self._raw):
            raise MessageError(f"{self._what} of {len(self._raw)} bytes cannot hold {count} names")
        return tuple(self.text() for _ in range(count))

    def time(self) -> int:
        """Pass a ``builtin_interfaces`` Time or Duration; return its offset."""
        self._align(4)
        return self._pass(_STAMP)

    def doubles(self) -> Doubles:
        """Pass the next sequence of doubles."""
        return self.array(self.count())

    def array(self, count: int) -> Doubles:
        """Pass that many doubles."""
        if count == 0:
            return Doubles(self.offset, 0)
        self._align(_DOUBLE)
        return Doubles(self._pass(count * _DOUBLE), count)

    def is_at_end(self) -> bool:
        """Tell whether only padding is left."""
        return len(self._raw) - self.offset < 4

    def _pass(self, size: int) -> int:
        self._require(size)
        begin = self.offset
        self.variable.append((begin, size))
        self.offset += size
        return begin

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ENCAPSULATION) % size

    def _require(self, size: int) -> None:
        if self.offset + size > len(self._raw):
            raise MessageError(
                f"{self._what} of {len(self._raw)} bytes ends before byte {self.offset + size}"
            )
