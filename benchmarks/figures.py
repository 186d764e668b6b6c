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
    """Where one side of a figure comes from."""

    contender: str  # name of what is measured
    quantity: str  # which of its quantities


class Bound(NamedTuple):
    """What is asked of a figure."""

    of: str  # ``ratio`` or ``ours``
    least: float = -math.inf  # it must not be below this
    most: float = math.inf  # it must not be above this

    def __str__(self) -> str:
        """Return it as the table shows it, for instance ``ratio >= 0.75``."""
        return f"{self.of} >= {self.least:g}" if self.least > -math.inf else (
            f"{self.of} <= {self.most:g}"
        )  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """A figure to measure."""

    name: str  # its name in the results
    unit: str  # unit of both sides
    ours: Source  # what the package does
    reference: Source  # its limit or peer
    against: str  # the reference in a few words
    bounds: tuple[Bound, ...] = ()  # what is asked
    beside: tuple[str, ...] = ()  # further quantities of the package's side that are shown with it


@dataclass(frozen=True)
class Group:
    """Figures whose contenders are measured in turn, in one run."""

    contenders: Mapping[str, Measure]  # what is measured, by name
    figures: tuple[Figure, ...]  # what is computed from them
    # for what takes long and needs no repetition; None for no limit
    rounds_at_most: int | None = None


class Middle(NamedTuple):
    """The middle of some values and how far they spread."""

    median: float  # their median
    low: float  # their least
    high: float  # their largest

    @property
    def spread(self) -> float:
        """Half the range over the median; 0 when the median is."""
        return 0.5 * (self.high - self.low) / abs(self.median) if self.median else 0.0


def middle(values: Sequence[float]) -> Middle:
    """Return median and range."""
    if not values:
        raise ValueError("there is no median of no values")
    return Middle(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Outcome:
    """A measured figure.

    The ratio is the median of the rounds' ratios, not the ratio of the medians: what slows the
    machine down for a while slows both sides of a round.
    """

    figure: Figure  # what was measured
    ours: Middle  # the package's side
    reference: Middle  # the other side
    ratio: Middle  # ours over reference
    rounds: int  # how often each side was measured
    beside: Mapping[str, float]  # what else was measured on the package's side, medians by name

    @classmethod
    def of(
        cls,
        figure: Figure,
        ours: Sequence[Mapping[str, float]],
        reference: Sequence[Mapping[str, float]],
    ) -> Outcome:
        """Compute a figure of its rounds."""
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
