"""What two physics engines make of the same runs, and how far apart their numbers lie."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from hpid_ros.analysis.comparison import ratio
from hpid_ros.analysis.folding import median_and_quartiles
from hpid_ros.analysis.quantities import Quantity

BySeed = Mapping[int, float]
"""A number of each run, by its seed."""


@dataclass(frozen=True)
class EngineTotal:
    """One number of one controller in two engines."""

    experiment: str  # name of the experiment
    controller: str  # label of the controller
    quantity: Quantity  # which number
    values: Mapping[str, BySeed]  # by engine, the one that the other is held against first
    ratios: Mapping[str, BySeed] = field(default_factory=dict)
    unit: str = ""  # of the number; that of joints which turn if empty

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", self.unit or self.quantity.unit)

    @property
    def distances(self) -> list[float]:
        """The second engine's number over the first's with the same seed, less 1."""
        against, own = self.values.values()
        found = (ratio(own[seed], against[seed]) - 1.0 for seed in own if seed in against)
        return [each for each in found if not math.isnan(each)]

    @property
    def distance(self) -> float | None:
        """Median of the distances; None if no seed has run in both engines."""
        return median(self.distances)

    @property
    def largest_distance(self) -> float | None:
        """Of the distances, the one that is farthest from 0."""
        return max(self.distances, key=abs, default=None)


def median(values: Sequence[float]) -> float | None:
    """Return the median of some numbers; None of none."""
    return median_and_quartiles(values)[0] if values else None


def engine_mapping(totals: Iterable[EngineTotal]) -> dict[str, object]:
    """Return medians, ratios and distances by experiment, controller and quantity, for JSON."""
    found: dict[str, dict[str, dict[str, object]]] = {}
    for total in totals:
        of_experiment = found.setdefault(total.experiment, {})
        of_experiment.setdefault(total.controller, {})[total.quantity.key] = {
            "values": _medians(total.values),
            "ratios": _medians(total.ratios),
            "distance": _plain(total.distance),
            "largest_distance": _plain(total.largest_distance),
        }
    return {**found}


def _medians(numbers: Mapping[str, BySeed]) -> dict[str, float | None]:
    return {engine: _plain(median(list(each.values()))) for engine, each in numbers.items()}


def _plain(value: float | None) -> float | None:
    """Return a number for JSON, which knows no infinity."""
    return value if value is not None and math.isfinite(value) else None
