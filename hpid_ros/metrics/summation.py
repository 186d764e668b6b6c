"""Sums that are rounded once, whatever the order of the numbers and numpy's version.

Each block is split against a power of two into leading parts that add up without rounding, the
rest is split again until nothing is left, and :func:`math.fsum` adds the few exact parts.

Source: Rump, Ogita and Oishi, "Accurate floating-point summation" (2008), the extraction of
leading parts, here down to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import SeriesError

# One block stays in the first cache, and so many leading parts of 53 - 15 bits add up exactly.
_SUM_BLOCK = 1 << 13
_SMALL = 256  # fewer numbers are summed sooner than split
_HEADROOM_BITS = 15
_LARGEST_EXPONENT = 1000  # beyond, the power of two that splits would overflow
_LEAST_EXPONENT = -900  # below, the parts would be subnormal
_TOO_LARGE = "an integral of the recorded numbers is beyond 1.8e308: they are no joint's"


def exact_sum(values: Numbers) -> float:
    """Return the sum of finite numbers, rounded once; it depends on no order of them."""
    return exact_sum_of_blocks([values])


def exact_sum_of_blocks(blocks: Iterable[Numbers]) -> float:
    """Return the sum of all numbers of some arrays, rounded once; one at a time is in memory."""
    parts: list[float] = []
    for values in blocks:
        if not np.isfinite(values).all():
            raise SeriesError(_TOO_LARGE)
        if values.size < _SMALL:
            parts.extend(values.tolist())
            continue
        for first in range(0, values.size, _SUM_BLOCK):
            _append_exact_parts(values[first : first + _SUM_BLOCK], parts)
    try:
        return math.fsum(parts)
    except OverflowError:
        raise SeriesError(_TOO_LARGE) from None


def _append_exact_parts(block: Numbers, parts: list[float]) -> None:
    """Append numbers whose exact sum is the block's."""
    rest = block
    while True:
        largest = max(float(rest.max()), -float(rest.min()))
        if largest == 0.0:
            return
        exponent = math.frexp(largest)[1]
        if not _LEAST_EXPONENT < exponent < _LARGEST_EXPONENT:
            parts.extend(rest.tolist())
            return
        splitter = math.ldexp(1.0, exponent + _HEADROOM_BITS)
        leading = (rest + splitter) - splitter
        parts.append(float(leading.sum()))
        rest = rest - leading
