"""Columns that grow as a bag is read, and take no more memory than their numbers need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.batches import Integers, Numbers

_FIRST_CAPACITY = 1 << 12
_GROWTH = 1.2
"""Small, because numpy fills what it adds with zeros; large arrays are moved, not copied."""


class Column:
    """Numbers of one type, appended many at once.

    Args:
        kind: Their numpy type.
    """

    def __init__(self, kind: type[np.generic]) -> None:
        self._numbers: NDArray[np.generic] = np.empty(_FIRST_CAPACITY, kind)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, numbers: NDArray[np.generic]) -> None:
        """Append numbers, (n,)."""
        end = self._length + len(numbers)
        if end > len(self._numbers):
            capacity = max(end, int(len(self._numbers) * _GROWTH))
            self._numbers.resize(capacity, refcheck=False)
        self._numbers[self._length : end] = numbers
        self._length = end

    def finished(self) -> NDArray[np.generic]:
        """Return all numbers as one array of exactly their size; nothing may follow."""
        self._numbers.resize(self._length, refcheck=False)
        return self._numbers


class NumberColumn:
    """Doubles, appended many at once."""

    def __init__(self) -> None:
        self._column = Column(np.float64)

    def append(self, numbers: Numbers) -> None:
        """Append numbers, (n,)."""
        self._column.append(numbers)

    def finished(self) -> Numbers:
        """Return all of them; nothing may follow."""
        return self._column.finished().astype(np.float64, copy=False)


class DeltaColumn:
    """Integers whose steps are mostly small, kept as steps of 16 or 32 bits.

    Args:
        kind: ``numpy.uint16`` or ``numpy.uint32``: what most steps fit into. Others are kept
            aside in full.
    """

    def __init__(self, kind: type[np.unsignedinteger]) -> None:
        self._steps = Column(kind)
        self._limit = int(np.iinfo(kind).max)
        self._large_places = Column(np.int64)
        self._large_steps = Column(np.int64)
        self._last: Integers = np.zeros(1, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._steps)

    def append(self, numbers: Integers) -> None:
        """Append integers, (n,)."""
        if not len(numbers):
            return
        steps = np.empty(len(numbers), dtype=np.int64)
        np.subtract(numbers[:1], self._last, out=steps[:1])  # wraps, as the sum does
        np.subtract(numbers[1:], numbers[:-1], out=steps[1:])
        sizes = steps.view(np.uint64)  # of a negative step: beyond every limit
        if sizes.max() > self._limit:
            places = np.flatnonzero(sizes > self._limit)
            large = steps[places]
            self._large_places.append(places + len(self._steps))
            self._large_steps.append(large)
            steps[places] = 0
        self._steps.append(steps)
        self._last = numbers[-1:].copy()

    def numbers(self) -> Integers:
        """Return all integers, (n,)."""
        steps = self._steps.finished().astype(np.int64)
        steps[self._large_places.finished().astype(np.int64)] = self._large_steps.finished()
        return np.cumsum(steps, out=steps)
