"""Arrays that wait in a temporary file where they are more than memory shall hold."""

from __future__ import annotations

import os
import tempfile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import BagError

BYTES_IN_MEMORY = 32 << 20
"""Bytes that stay in memory."""


class Stored(NamedTuple):
    """Where an array lies in the file."""

    offset: int  # its first byte
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


Kept = NDArray[Any] | Stored
"""An array in memory or in the file."""


class Spill:
    """Keeps arrays: those that come first in memory, the others in a file without a name."""

    def __init__(self) -> None:
        self._room, self._end = BYTES_IN_MEMORY, 0
        self._file: Any = None
        self._given: list[tuple[NDArray[Any], Stored]] = []  # what was read last, and from where

    def keep(self, array: NDArray[Any]) -> Kept:
        """Keep an array, which nobody changes any more.

        Raises:
            BagError: There is no room in the folder of temporary files.
        """
        for given, where in self._given:
            if given is array and not array.flags.writeable:
                return where
        if array.nbytes <= self._room:
            self._room -= array.nbytes
            return array
        self._room = 0
        stored = Stored(self._end, array.shape, array.dtype)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="hpid_", buffering=0)  # noqa: SIM115
            left = memoryview(np.ascontiguousarray(array).data).cast("B")
            while len(left):
                left = left[self._file.write(left) :]
        except OSError as error:
            raise BagError(
                f"a large recording needs room in {tempfile.gettempdir()} (TMPDIR): "
                f"{error.strerror or error}"
            ) from None
        self._end += array.nbytes
        return stored

    def array(self, kept: Kept) -> NDArray[Any]:
        """Return an array as it was kept, read-only where it comes from the file."""
        if not isinstance(kept, Stored):
            return kept
        array: NDArray[Any] = np.empty(kept.shape, kept.dtype)
        self._read(array, kept.offset)
        array.setflags(write=False)
        self._given = [(array, kept), *self._given[:1]]
        return array

    def copy_row(self, kept: Kept, row: int, target: NDArray[Any]) -> None:
        """Copy one row of a matrix into an array of its length."""
        if isinstance(kept, Stored):
            self._read(target, kept.offset + row * target.nbytes)
        else:
            target[:] = kept[row]

    def _read(self, target: NDArray[Any], offset: int) -> None:
        left = memoryview(target.data).cast("B")
        while len(left):
            count = os.preadv(self._file.fileno(), [left], offset)
            if not count:
                raise BagError("a temporary file of a large recording was cut off")
            left, offset = left[count:], offset + count
