"""A logarithmic axis of ratios: plain numbers, as many as there is room for."""

from __future__ import annotations

from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

_WIDE, _NARROW = 12.0, 3.0
_SETS = {
    "few": (1.0, 2.0, 5.0),
    "some": (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    "many": (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
}


def ratio_ticks(axis: Axis) -> None:
    """Put ticks at round ratios within the axis's present limits.

    Args:
        axis: Its scale is logarithmic, and what it shows is drawn already.
    """
    low, high = sorted(axis.get_view_interval())
    span = high / low
    parts = _SETS["few" if span > _WIDE else "some" if span > _NARROW else "many"]
    decades = [10.0**power for power in range(-6, 7)]
    axis.set_major_locator(FixedLocator([decade * part for decade in decades for part in parts]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
