"""The one number that a search makes small, from the numbers of runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from hpid_ros.analysis import RunIndices
from hpid_ros.analysis.comparison import ratio
from hpid_ros.analysis.quantities import Quantity
from hpid_ros.errors import SettingError, unknown_name
from hpid_ros.experiment.judged_run import PAPER_QUANTITIES


class SearchCost(Protocol):
    """What a search makes small."""

    def of(self, ratios: Mapping[str, float]) -> float:
        """Return the cost of ratios to the baseline, of each index by key."""

    def as_mapping(self) -> Mapping[str, object]:
        """Return what it is, for a file."""


@dataclass(frozen=True)
class Cost:
    r"""A weighted geometric mean of ratios to the baseline.

    .. math:: J = \exp\Big(\sum_q w_q \ln r_q \Big/ \sum_q w_q\Big)

    with :math:`r_q` the geometric mean over the seeds of an index over the baseline's with the
    same seed. The baseline costs 1, and no index counts more for having a larger unit.

    Attributes:
        weights: Of each index by key; those that are left out do not count.

    Raises:
        SettingError: An index is unknown, a weight is negative or not finite, or all are zero.
    """

    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        _require_known(self.weights)
        for key, weight in self.weights.items():
            if not (math.isfinite(weight) and weight >= 0.0):
                raise SettingError(
                    f"the weight of {key} must be finite and not negative, not {weight}"
                )
        if not math.fsum(self.weights.values()) > 0.0:
            raise SettingError("at least one index must have a positive weight")

    @classmethod
    def even(cls) -> Cost:
        """Return the cost in which all indices of the paper count the same."""
        return cls({quantity.key: 1.0 for quantity in PAPER_QUANTITIES})

    def as_mapping(self) -> dict[str, object]:
        """Return what it is, for a file."""
        return {"weights": dict(self.weights)}

    def of(self, ratios: Mapping[str, float]) -> float:
        """Return the cost.

        Args:
            ratios: Of each index by key.
        """
        counted = {key: weight for key, weight in self.weights.items() if weight > 0.0}
        if any(not math.isfinite(ratios[key]) for key in counted):
            return math.inf
        if any(ratios[key] == 0.0 for key in counted):
            return 0.0
        logarithm = math.fsum(weight * math.log(ratios[key]) for key, weight in counted.items())
        return math.exp(logarithm / math.fsum(counted.values()))


@dataclass(frozen=True)
class WorstExcess:
    r"""How far the worst index is from what is wanted of it.

    .. math:: J = \max_q r_q / l_q

    with the ratios :math:`r_q` of :class:`Cost`. At 1 or less all limits are kept together.

    Attributes:
        limits: The largest ratio wanted of each index by key; those left out do not count.

    Raises:
        SettingError: An index is unknown, a limit is not positive and finite, or there is none.
    """

    limits: Mapping[str, float]

    def __post_init__(self) -> None:
        _require_known(self.limits)
        for key, limit in self.limits.items():
            if not (math.isfinite(limit) and limit > 0.0):
                raise SettingError(f"the limit of {key} must be finite and positive, not {limit}")
        if not self.limits:
            raise SettingError("at least one index must have a limit")

    def of(self, ratios: Mapping[str, float]) -> float:
        """Return the cost; infinite where an index is not finite.

        Args:
            ratios: Of each index by key.
        """
        excesses = [ratios[key] / limit for key, limit in self.limits.items()]
        return max(excesses) if all(map(math.isfinite, excesses)) else math.inf

    def as_mapping(self) -> dict[str, object]:
        """Return what it is, for a file."""
        return {"limits": dict(self.limits)}


def _require_known(names: Mapping[str, float]) -> None:
    known = [quantity.key for quantity in PAPER_QUANTITIES]
    for key in names:
        if key not in known:
            raise SettingError(unknown_name("index", key, known))


def mean_ratios(
    runs: Sequence[RunIndices],
    baseline: Sequence[RunIndices],
    quantities: Sequence[Quantity] = PAPER_QUANTITIES,
) -> dict[str, float]:
    """Return for each index the geometric mean over the seeds of its ratio to the baseline.

    Args:
        runs: One for each seed.
        baseline: One for each seed, in the same order.
        quantities: Which indices.
    """
    found = {}
    for quantity in quantities:
        each = [
            ratio(own.value(quantity), other.value(quantity))
            for own, other in zip(runs, baseline, strict=True)
        ]
        is_plain = all(math.isfinite(value) and value > 0.0 for value in each)
        mean = math.fsum(map(math.log, each)) / len(each) if is_plain else math.nan
        found[quantity.key] = math.exp(mean) if is_plain else max(each)
    return found
