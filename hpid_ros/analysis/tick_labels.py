"""Numbers on an axis that stand for themselves, without an offset or a power beside the axis."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from matplotlib.ticker import Formatter

# Beyond these, zeros would crowd out the digits.
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-4, 1e7
MOST_DECIMALS = 9


class TickLabels(Formatter):
    """As many decimals as tell the ticks of one axis apart, the same for all of them.

    matplotlib's own formatter would write an offset or a power of ten above the axis, where
    the joint's name is.
    """

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of one place, as for a cursor.

        Args:
            x: The place.
            pos: Its number among the ticks; not used.
        """
        return _readable(f"{x:.9g}")

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of all ticks of an axis.

        Args:
            values: Where the ticks are, increasing.
        """
        largest = max((abs(value) for value in values), default=0.0)
        step = min((abs(b - a) for a, b in itertools.pairwise(values)), default=largest)
        if step <= 0.0:
            return [self(value) for value in values]
        if SMALLEST_PLAIN <= largest < LARGEST_PLAIN:
            decimals = next(
                (d for d in range(MOST_DECIMALS) if abs(round(step, d) - step) < 1e-3 * step),
                MOST_DECIMALS,
            )
            return [_readable(f"{round(value, decimals) + 0.0:.{decimals}f}") for value in values]
        digits = math.ceil(math.log10(largest / step)) + 2
        # A tick at zero is rounding noise of the ones beside it.
        exact = [0.0 if abs(value) < 1e-6 * step else value for value in values]
        return [_readable(f"{value:.{digits}g}") for value in exact]


def _readable(text: str) -> str:
    return text.replace("e-0", "e-").replace("e+0", "e").replace("-", "−")
