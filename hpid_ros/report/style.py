"""The look of the figures: colours, lines, sizes, axes.

Runs differ by hue, by lightness and by line, so that they can be told apart with any colour
vision and on grey paper. The gaps of a dashed line are filled with a tint of its own colour: a
peak that falls into a gap is still drawn.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import matplotlib
import matplotlib.style
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.messages.series import RunSeries


class JointUnits(NamedTuple):
    """Which joints of a figure slide."""

    are_slides: tuple[bool, ...]  # of each joint, in the order of the panels

    @classmethod
    def of(cls, runs: Sequence[RunSeries]) -> JointUnits:
        """Return those of the first run's joints; what one run knows holds for all."""
        slides = frozenset[str]().union(*(run.slides for run in runs))
        return cls(tuple(joint in slides for joint in runs[0].joint_names))

    def over_all(self, unit: str) -> str:
        """Return the unit of an axis that the panels share: both where both kinds are there."""
        return unit_over(unit, self.are_slides)

    def suffixes(self, unit: str) -> tuple[str, ...]:
        """Return what follows each joint's name above its panel: its unit where they differ."""
        if len(set(self.are_slides)) < 2:
            return ("",) * len(self.are_slides)
        return tuple(f" [{of_slide(unit) if each else unit}]" for each in self.are_slides)


INK = "#20242b"
GRID = "#dfe2e7"
PAPER = "#ffffff"
REFERENCE = "#b4bac4"
DOTS_PER_INCH = 150
WIDTH_IN = 10.0
PANEL_HEIGHT_IN = 1.75
NORM_HEIGHT_IN = 4.0


@dataclass(frozen=True)
class RunStyle:
    """The line of one run."""

    color: str  # its colour
    tint: str  # the colour of the gaps between its dashes
    dashes: tuple[float, ...] | None  # [pt] lengths of dashes and gaps, or None for a solid line
    width: float  # [pt] line width


# Dark blue, orange, green, purple: their lightness differs as well as their hue. Four more hues
# with dashes of their own follow; after eight runs they begin again.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
RUN_STYLES = (
    RunStyle("#0b4a8f", "#0b4a8f", None, 1.3),
    RunStyle("#e8590c", "#f7bf9c", (7.0, 1.8), 1.3),
    RunStyle("#2b8a5b", "#a9d8c1", (2.0, 1.2), 1.3),
    RunStyle("#8f4bb8", "#d6bce6", (7.0, 1.5, 1.5, 1.5), 1.3),
    RunStyle("#8a0f2e", "#d9a3b0", (11.0, 1.5), 1.3),
    RunStyle("#0b8fa3", "#a6d9e0", (4.0, 1.2), 1.3),
    RunStyle("#6b5200", "#cfc39c", (1.2, 1.0), 1.3),
    RunStyle("#5a6572", "#c3c9d0", (9.0, 1.2, 1.2, 1.2, 1.2, 1.2), 1.3),
)

_RC = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.xmargin": 0.0,
    "figure.constrained_layout.use": False,
    "figure.labelsize": 10,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "legend.handlelength": 3.2,
    "lines.scale_dashes": False,
    "pdf.fonttype": 42,
    "savefig.facecolor": PAPER,
    "svg.fonttype": "none",
    "svg.hashsalt": "hpid_ros",
    "text.color": INK,
    "xtick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.color": INK,
    "ytick.labelsize": 8.5,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply this look within a ``with`` block, whatever the user's matplotlibrc says."""
    with matplotlib.style.context(["default", _RC]):
        yield


def run_styles() -> Iterator[RunStyle]:
    """Return the styles of the runs in order, from the beginning again after the last."""
    return itertools.cycle(RUN_STYLES)


_WIDE, _NARROW = 12.0, 3.0
_SETS = {
    "few": (1.0, 2.0, 5.0),
    "some": (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    "many": (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
}


def ratio_ticks(axis: Axis) -> None:
    """Put ticks at round ratios within the axis's present limits."""
    low, high = sorted(axis.get_view_interval())
    span = high / low
    parts = _SETS["few" if span > _WIDE else "some" if span > _NARROW else "many"]
    decades = [10.0**power for power in range(-6, 7)]
    axis.set_major_locator(FixedLocator([decade * part for decade in decades for part in parts]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
