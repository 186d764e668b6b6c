"""One joint's numbers as they were recorded: layouts told apart, columns that grow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.columns.batches import Integers, Words
from hpid_ros.bags.columns.layouts import Layout
from hpid_ros.base.arrays import Numbers

_FIRST_CAPACITY = 1 << 12
_GROWTH = 1.2
"""Small, because numpy fills what it adds with zeros; large arrays are moved, not copied."""


class GrowingColumn:
    """Numbers of one type, appended many at once."""

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
        self._column = GrowingColumn(np.float64)

    def append(self, numbers: Numbers) -> None:
        """Append numbers, (n,)."""
        self._column.append(numbers)

    def finished(self) -> Numbers:
        """Return all of them; nothing may follow."""
        return self._column.finished().astype(np.float64, copy=False)


class DeltaColumn:
    """Integers whose steps are mostly small, kept as steps of 16 or 32 bits."""

    def __init__(self, kind: type[np.unsignedinteger]) -> None:
        self._steps = GrowingColumn(kind)
        self._limit = int(np.iinfo(kind).max)
        self._large_places = GrowingColumn(np.int64)
        self._large_steps = GrowingColumn(np.int64)
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


_ALL_BITS = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_MOST_LAYOUTS = 64
"""Layouts that are remembered; a text that changes with every message makes one for each."""

Mask = NDArray[np.bool_]


class LayoutFamily:
    """Layouts whose numbers lie at the same places, and whose names or frames differ.

    The words that all of them share are compared once for all messages.
    """

    def __init__(self, first: Layout) -> None:
        self.layouts: list[Layout] = []
        self._mask = first.mask
        self._words: list[int] = np.flatnonzero(first.mask).tolist()
        self._shared: list[int] = []
        self._differing: list[int] = []
        self.add(first)

    def accepts(self, layout: Layout) -> bool:
        """Tell whether a layout is of this family."""
        return np.array_equal(layout.mask, self._mask) and layout.order == self.layouts[0].order

    def add(self, layout: Layout) -> None:
        """Add a layout of this family."""
        if len(self.layouts) == _MOST_LAYOUTS:
            self.layouts.clear()
        self.layouts.append(layout)
        first = self.layouts[0].values
        is_shared = np.ones(len(first), dtype=np.bool_)
        for each in self.layouts:
            is_shared &= each.values == first
        self._shared = [word for word in self._words if is_shared[word]]
        self._differing = [word for word in self._words if not is_shared[word]]

    def split(self, rows: Words) -> Iterator[tuple[Layout, Mask]]:
        """Yield each layout that some rows have, and which these are."""
        is_kin = self._equal(rows, self._shared, self.layouts[0], None)
        for layout in self.layouts:
            claims = self._equal(rows, self._differing, layout, is_kin)
            if claims.any():
                yield layout, claims

    def _equal(self, rows: Words, words: list[int], layout: Layout, before: Mask | None) -> Mask:
        is_equal = np.ones(len(rows), dtype=np.bool_) if before is None else before.copy()
        for word in words:
            column, mask = rows[:, word], self._mask[word]
            is_equal &= (column if mask == _ALL_BITS else column & mask) == layout.values[word]
        return is_equal


class JointSamples(NamedTuple):
    """One joint's numbers in the order of the log."""

    stamps_ns: Integers | None  # [ns] header stamps, (n,); None if the messages carry none
    log_times_ns: Integers | None  # [ns] receive times, (n,); None if they were not kept
    places: Integers | None  # ascending with the order of the files, (n,); None if not kept
    values: Numbers  # the numbers, (n,)

    def picked(self, which: Integers | Mask) -> JointSamples:
        """Return some of the samples."""
        stamps, log_times, places = (
            None if part is None else part[which] for part in (self[0], self[1], self[2])
        )
        return JointSamples(stamps, log_times, places, self.values[which])


def merged(parts: Sequence[JointSamples]) -> JointSamples:
    """Join samples of several groups, in no order."""
    clocks: list[Integers | None] = []
    for clock in zip(*(part[:3] for part in parts), strict=True):
        known = [times for times in clock if times is not None]
        clocks.append(np.concatenate(known) if len(known) == len(parts) else None)
    stamps, log_times, places = clocks
    values = np.concatenate([part.values for part in parts])
    return JointSamples(stamps, log_times, places, values)
