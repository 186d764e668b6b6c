"""Rows of bytes at any places of a buffer, gathered as tables of 64-bit words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hpid_ros.bags.batches import Bytes, Integers

Words = NDArray[np.uint64]
WORD = 8


def gather_words(buffer: Bytes, starts: Integers, words: int) -> Words:
    """Return ``words`` little-endian words from each start, (n, words).

    Args:
        buffer: The bytes, contiguous; each row must lie within.
        starts: Where the rows begin, (n,); any alignment.
        words: Words of a row.
    """
    width = words * WORD
    # One opaque item a place, overlapping: indexing it is one copy of a row's bytes.
    every: NDArray[np.void] = np.ndarray(
        (max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,)
    )
    rows = np.ascontiguousarray(every[starts])
    return rows.view("<u8").reshape(len(starts), words)
