"""The space and the cost of a search.

Both laws have a few numbers for all joints: the PID scales of its gains and how its bandwidth is
distributed over the joints, the homogeneous PID its degree and its norm, with the gains untouched.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import geometric_mean
from typing import Protocol, get_args

from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.settings import LawName, LoopSettings
from hpid_ros.experiment.batch import PAPER_QUANTITIES
from hpid_ros.experiment.description import Experiment
from hpid_ros.metrics.comparison import ratio
from hpid_ros.metrics.quantities import Quantity
from hpid_ros.metrics.results import RunIndices


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
    """

    weights: Mapping[str, float]  # of each index by key; those that are left out do not count

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
        """Return the cost."""
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
    """

    limits: Mapping[str, float]  # the largest ratio wanted of each index by key

    def __post_init__(self) -> None:
        _require_known(self.limits)
        for key, limit in self.limits.items():
            if not (math.isfinite(limit) and limit > 0.0):
                raise SettingError(f"the limit of {key} must be finite and positive, not {limit}")
        if not self.limits:
            raise SettingError("at least one index must have a limit")

    def of(self, ratios: Mapping[str, float]) -> float:
        """Return the cost; infinite where an index is not finite."""
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
    """Return for each index the geometric mean over the seeds of its ratio to the baseline."""
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


_DIGITS = 6


@dataclass(frozen=True)
class FreeParameter:
    """One direction of a search."""

    name: str  # what a person calls it
    low: float  # least value
    high: float  # largest value
    start: float  # where the search begins: at the baseline
    meaning: str  # in a few words
    is_logarithmic: bool = True  # whether the search sees its logarithm

    def __post_init__(self) -> None:
        least = 0.0 if self.is_logarithmic else -math.inf
        if not least < self.low < self.high < math.inf:
            raise SettingError(
                f"the bounds of {self.name} must be finite, the first below the second"
                f"{' and positive' if self.is_logarithmic else ''}, not {self.low}:{self.high}"
            )

    def value(self, share: float) -> float:
        """Return the value at a share of the way from the least to the largest.

        Rounded to six digits, so that what is printed is what was run.
        """
        low, high = (self._seen(end) for end in (self.low, self.high))
        seen = low + min(max(share, 0.0), 1.0) * (high - low)
        return float(f"{math.exp(seen) if self.is_logarithmic else seen:.{_DIGITS}g}")

    def share(self, value: float) -> float:
        """Return the inverse of :meth:`value`, within [0, 1]."""
        low, high, seen = (self._seen(each) for each in (self.low, self.high, value))
        return min(max((seen - low) / (high - low), 0.0), 1.0)

    def _seen(self, value: float) -> float:
        return math.log(value) if self.is_logarithmic else value


@dataclass(frozen=True)
class Directions:
    """Free parameters, and what their values make of the settings of one joint."""

    parameters: tuple[FreeParameter, ...]  # the free parameters
    # takes settings and the values by name, and returns other settings
    apply: Callable[..., LoopSettings]
    changed: tuple[str, ...]  # the names of the settings that it changes


PID_PARAMETERS = (
    FreeParameter("bandwidth", 0.2, 5.0, 1.0, "p, i and d times its square, cube and itself"),
    FreeParameter("damping", 0.3, 3.0, 1.0, "factor of d"),
    FreeParameter("integral", 0.05, 5.0, 1.0, "factor of i"),
    FreeParameter(
        "distribution",
        -0.4,
        0.4,
        0.0,
        "exponent of a joint's p over the geometric mean of all p; the power is a factor of its "
        "bandwidth",
        is_logarithmic=False,
    ),
)
"""Of a linear controller; the last one only where there is more than one joint."""

_DEGREE = FreeParameter("mu", -0.45, 0.45, 0.0, "degree", is_logarithmic=False)
HPID_PARAMETERS = (
    _DEGREE,
    FreeParameter("error_scale", 0.05, 20.0, 1.0, "factor of norm.error_scale"),
    FreeParameter("rate_weight", 1e-3, 10.0, 0.1, "norm.rate_weight [s/rad]"),
)
"""Of a homogeneous controller whose joints have scales of their own."""

EFFORT_PARAMETERS = (
    _DEGREE,
    FreeParameter("effort_scale", 0.05, 20.0, 1.0, "factor of norm.effort_scale"),
    FreeParameter("floor", 0.01, 1.0, 0.1, "norm.floor"),
)
"""Of a homogeneous controller whose norm is in units of effort."""


def source_label(experiment: Experiment, law: LawName) -> str:
    """Return the label of the controller whose other settings a search keeps."""
    baseline, *others = experiment.controllers
    for label in others if law == "hpid" else ():
        if any(loop.law == "hpid" for loop in experiment.controllers[label]):
            return label
    return baseline


@dataclass(frozen=True)
class SearchSpace:
    """All that a search may choose from."""

    law: LawName  # pid or hpid
    directions: Directions  # the free parameters and what they do
    # the controller that is changed, joint by joint, at the start of the search
    start: tuple[LoopSettings, ...]
    joints: tuple[str, ...]  # the joints that are changed

    @property
    def parameters(self) -> tuple[FreeParameter, ...]:
        """The free parameters."""
        return self.directions.parameters

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        law: LawName,
        bounds: Mapping[str, tuple[float, float]] | None = None,
    ) -> SearchSpace:
        """Return the space around an experiment's baseline, over all its joints.

        A homogeneous search has the baseline's gains; everything else is that of
        :func:`source_label`.
        """
        if law not in get_args(LawName):
            raise SettingError(unknown_name("law", law, get_args(LawName)))
        baseline = next(iter(experiment.controllers.values()))
        source = experiment.controllers[source_label(experiment, law)]
        start = tuple(
            replace(each, law=law, mu=0.0, gains=known.gains)
            for each, known in zip(source, baseline, strict=True)
        )
        usual = _directions(law, start)
        directions = replace(usual, parameters=_bounded(usual.parameters, bounds or {}))
        return cls(law, directions, start, experiment.world.joints)

    def controller(self, values: Sequence[float]) -> tuple[LoopSettings, ...]:
        """Return the controller at a point."""
        found = {each.name: value for each, value in zip(self.parameters, values, strict=True)}
        loops = []
        for each in self.start:
            try:
                is_free = each.joint in self.joints
                loops.append(self.directions.apply(each, **found) if is_free else each)
            except HpidError as error:
                raise type(error)(f"{each.joint}: {error}") from None
        return tuple(loops)

    def narrowed(self, joint: str, start: Sequence[LoopSettings]) -> SearchSpace:
        """Return the space of the same directions of one joint, from another start."""
        (own,) = [each for each in start if each.joint == joint]
        at = {
            "mu": own.mu,
            "rate_weight": own.norm.rate_weight,
            "floor": own.norm.floor,
        }
        parameters = tuple(
            replace(each, start=at.get(each.name, 1.0))
            for each in self.parameters
            if each.name != "distribution"  # one joint's bandwidth is said already
        )
        directions = replace(self.directions, parameters=parameters)
        return replace(self, directions=directions, start=tuple(start), joints=(joint,))


def _directions(law: LawName, start: Sequence[LoopSettings]) -> Directions:
    if law == "pid":
        mean = geometric_mean(each.gains.p for each in start)
        count = len(PID_PARAMETERS) - (len(start) == 1)
        gains = ("gains.p", "gains.i", "gains.d")
        return Directions(PID_PARAMETERS[:count], partial(_scaled_gains, mean), gains)
    norm = start[0].norm
    if all(each.norm.effort_scale for each in start):
        *others, floor = EFFORT_PARAMETERS
        first = norm.floor if floor.low <= norm.floor <= floor.high else floor.start
        parameters = (*others, replace(floor, start=first))
        return Directions(parameters, _in_effort, ("mu", "norm.effort_scale", "norm.floor"))
    *others, weight = HPID_PARAMETERS
    parameters = (*others, replace(weight, start=norm.rate_weight))
    return Directions(parameters, _homogeneous, ("mu", "norm.error_scale", "norm.rate_weight"))


def _bounded(
    parameters: tuple[FreeParameter, ...], bounds: Mapping[str, tuple[float, float]]
) -> tuple[FreeParameter, ...]:
    names = [each.name for each in parameters]
    for name in bounds:
        if name not in names:
            raise SettingError(unknown_name("free parameter", name, names))
    return tuple(
        replace(each, low=bounds[each.name][0], high=bounds[each.name][1])
        if each.name in bounds
        else each
        for each in parameters
    )


def _scaled_gains(
    mean: float,
    settings: LoopSettings,
    bandwidth: float,
    damping: float,
    integral: float,
    distribution: float = 0.0,
) -> LoopSettings:
    gains = settings.gains
    own = bandwidth * (gains.p / mean) ** distribution
    scaled = Gains(
        p=_rounded(gains.p * own**2),
        i=_rounded(gains.i * own**3 * integral),
        d=_rounded(gains.d * own * damping),
    )
    return replace(settings, gains=scaled)


def _homogeneous(
    settings: LoopSettings, mu: float, error_scale: float, rate_weight: float
) -> LoopSettings:
    return settings.with_parameters(
        {
            "mu": mu,
            "norm.error_scale": _rounded(settings.norm.error_scale * error_scale),
            "norm.rate_weight": rate_weight,
        }
    )


def _in_effort(
    settings: LoopSettings, mu: float, effort_scale: float, floor: float
) -> LoopSettings:
    scale = _rounded(settings.norm.effort_scale * effort_scale)
    return settings.with_parameters({"mu": mu, "norm.effort_scale": scale, "norm.floor": floor})


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
