"""Tells many messages of one length apart by their layouts, exactly, a word at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.layouts import Layout
from hpid_ros.bags.rows import Words

_ALL_BITS = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_MOST_LAYOUTS = 64
"""Layouts that are remembered; a text that changes with every message makes one for each."""

Claims = NDArray[np.bool_]


class LayoutFamily:
    """Layouts whose numbers lie at the same places, and whose names or frames differ.

    The words that all of them share are compared once for all messages.

    Args:
        first: One of them.
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

    def split(self, rows: Words) -> Iterator[tuple[Layout, Claims]]:
        """Yield each layout that some rows have, and which these are.

        Args:
            rows: Messages of one length, (n, words).
        """
        is_kin = self._equal(rows, self._shared, self.layouts[0], None)
        for layout in self.layouts:
            claims = self._equal(rows, self._differing, layout, is_kin)
            if claims.any():
                yield layout, claims

    def _equal(
        self, rows: Words, words: list[int], layout: Layout, before: Claims | None
    ) -> Claims:
        is_equal = np.ones(len(rows), dtype=np.bool_) if before is None else before.copy()
        for word in words:
            column, mask = rows[:, word], self._mask[word]
            is_equal &= (column if mask == _ALL_BITS else column & mask) == layout.values[word]
        return is_equal
