"""Numbers of tables as texts: columns whose points line up, ratios, spreads."""

from __future__ import annotations

import math
from collections.abc import Iterable

SIGNIFICANT_DIGITS = 5
# Beyond these a column is scientific: plain digits would be many, or zeros.
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-3, 1e6
UNDEFINED = "–"


def format_values(values: Iterable[float], digits: int = SIGNIFICANT_DIGITS) -> list[str]:
    """Return numbers of one column with the same decimals, so that their points line up.

    The largest decides: it shows about `digits` digits. A number that would read as zero
    without being zero, and a column of very large or small numbers, are scientific.

    Args:
        values: The column; nan is what is not defined.
        digits: Digits of the largest number, and the decimals' limit plus one.
    """
    column = list(values)
    largest = max((abs(value) for value in column if math.isfinite(value)), default=0.0)
    if largest and not SMALLEST_PLAIN <= largest < LARGEST_PLAIN:
        return [_scientific(value) for value in column]
    whole = max(1, math.floor(math.log10(largest)) + 1) if largest else 1
    decimals = max(0, digits - whole)
    smallest = 0.5 * 10.0**-decimals
    return [
        _scientific(value)
        if value and not smallest <= abs(value) < math.inf
        else f"{value:.{decimals}f}"
        for value in column
    ]


def format_ratio(ratio: float) -> str:
    """Return a ratio in at most five characters or so: 0.612, 12.35, 1.2e5, inf.

    Args:
        ratio: A cost over the baseline's; nan if there is none.
    """
    if math.isnan(ratio):
        return UNDEFINED
    if math.isinf(ratio) or ratio < 10.0:
        return f"{ratio:.3f}"
    return f"{ratio:.4g}" if ratio < 1e4 else _scientific(ratio)


def format_quartiles(quartiles: tuple[float, float] | None) -> str:
    """Return the quartiles of repeated runs as one text.

    Args:
        quartiles: First and third, or None if there are none.
    """
    if quartiles is None:
        return UNDEFINED
    low, high = format_values(quartiles, SIGNIFICANT_DIGITS - 1)
    return f"{low}..{high}"


def _scientific(value: float) -> str:
    if math.isnan(value):
        return UNDEFINED
    if math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    if value == 0.0:
        return "0"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"
