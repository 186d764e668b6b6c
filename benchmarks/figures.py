"""Figures of speed: two measured quantities, their ratio, and what is asked of it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

Measure = Callable[[], Mapping[str, float]]
"""Measures one contender once and returns its quantities by name."""


class Source(NamedTuple):
    """Where one side of a figure comes from.

    Attributes:
        contender: Name of what is measured.
        quantity: Which of its quantities.
    """

    contender: str
    quantity: str


class Bound(NamedTuple):
    """What is asked of a figure.

    Attributes:
        of: ``ratio`` or ``ours``.
        least: It must not be below this.
        most: It must not be above this.
    """

    of: str
    least: float = -math.inf
    most: float = math.inf

    def __str__(self) -> str:
        """Return it as the table shows it, for instance ``ratio >= 0.75``."""
        return f"{self.of} >= {self.least:g}" if self.least > -math.inf else (
            f"{self.of} <= {self.most:g}"
        )  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """A figure to measure.

    Attributes:
        name: Its name in the results.
        unit: Unit of both sides.
        ours: What the package does.
        reference: Its limit or peer.
        against: The reference in a few words.
        bounds: What is asked.
        beside: Further quantities of the package's side that are shown with it.
    """

    name: str
    unit: str
    ours: Source
    reference: Source
    against: str
    bounds: tuple[Bound, ...] = ()
    beside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Group:
    """Figures whose contenders are measured in turn, in one run.

    Attributes:
        contenders: What is measured, by name.
        figures: What is computed from them.
        rounds_at_most: For what takes long and needs no repetition; None for no limit.
    """

    contenders: Mapping[str, Measure]
    figures: tuple[Figure, ...]
    rounds_at_most: int | None = None


class Middle(NamedTuple):
    """The middle of some values and how far they spread.

    Attributes:
        median: Their median.
        low: Their least.
        high: Their largest.
    """

    median: float
    low: float
    high: float

    @property
    def spread(self) -> float:
        """Half the range over the median; 0 when the median is."""
        return 0.5 * (self.high - self.low) / abs(self.median) if self.median else 0.0


def middle(values: Sequence[float]) -> Middle:
    """Return median and range.

    Raises:
        ValueError: There are no values.
    """
    if not values:
        raise ValueError("there is no median of no values")
    return Middle(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Outcome:
    """A measured figure.

    The ratio is the median of the rounds' ratios, not the ratio of the medians: what slows the
    machine down for a while slows both sides of a round.

    Attributes:
        figure: What was measured.
        ours: The package's side.
        reference: The other side.
        ratio: Ours over reference.
        rounds: How often each side was measured.
        beside: What else was measured on the package's side, medians by name.
    """

    figure: Figure
    ours: Middle
    reference: Middle
    ratio: Middle
    rounds: int
    beside: Mapping[str, float]

    @classmethod
    def of(
        cls,
        figure: Figure,
        ours: Sequence[Mapping[str, float]],
        reference: Sequence[Mapping[str, float]],
    ) -> Outcome:
        """Compute a figure of its rounds.

        Args:
            figure: The figure.
            ours: What the package's contender measured in each round.
            reference: Likewise the reference's.

        Raises:
            ValueError: No round, not the same number of both, or a reference that is zero.
        """
        a = [each[figure.ours.quantity] for each in ours]
        b = [each[figure.reference.quantity] for each in reference]
        if len(a) != len(b):
            raise ValueError(f"{len(a)} values against {len(b)} of the reference")
        if 0.0 in b:
            raise ValueError("the reference is zero")
        beside = {name: middle([each[name] for each in ours]).median for name in figure.beside}
        ratios = [x / y for x, y in zip(a, b, strict=True)]
        return cls(figure, middle(a), middle(b), middle(ratios), len(a), beside)

    @property
    def is_met(self) -> bool | None:
        """Whether every bound is kept by the medians; None where nothing is asked."""
        if not self.figure.bounds:
            return None
        medians = {"ours": self.ours.median, "ratio": self.ratio.median}
        return all(bound.least <= medians[bound.of] <= bound.most for bound in self.figure.bounds)
