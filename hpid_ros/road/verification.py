"""A prediction held against what was measured before and after."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from hpid_ros.analysis.comparability import mismatches
from hpid_ros.analysis.comparison import Comparison
from hpid_ros.analysis.quantities import INDICES, Quantity
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.metrics.measure import Measured, Measuring, measure_all
from hpid_ros.metrics.sources import Source
from hpid_ros.replay.controllers import recorded_controllers
from hpid_ros.road.prediction import Prediction
from hpid_ros.road.proposal import JUDGED

HOLDS_WITHIN = 0.1
"""Share of what was predicted that a measured index may be off."""

_SAME = 1e-4  # relative: parameter files have six digits
_BEFORE, _AFTER = "before", "after"


class Held(NamedTuple):
    """One index, over what it was before."""

    predicted: float  # ratio that was predicted
    measured: float  # ratio that was measured; nan where the recordings do not allow one

    @property
    def off(self) -> float:
        """How far the measured one is from the predicted one, as a share of that."""
        return self.measured / self.predicted - 1.0 if self.predicted else math.nan

    @property
    def is_held(self) -> bool:
        """Whether that is little."""
        return abs(self.off) <= HOLDS_WITHIN


@dataclass(frozen=True)
class Verification:
    """What came of a prediction."""

    joints: dict[str, dict[str, Held]]  # of each joint, by key of the index
    totals: dict[str, Held]  # of all joints together
    warnings: tuple[str, ...] = ()  # what the numbers must be read with, one line each
    # what ran that was not proposed, one line a joint: then nothing was tested
    others: tuple[str, ...] = ()

    @property
    def is_held(self) -> bool:
        """Whether the proposal ran, and each judged index of all joints is near the predicted."""
        return not self.others and all(self.totals[index.key].is_held for index in JUDGED)


def verify(prediction: Prediction, before: Path, after: Path) -> Verification:
    """Hold a prediction against two recordings of one motion."""
    joints = tuple(prediction.joints)
    how = Measuring(BagSelection(joints=joints), keeps_series=False)
    measured = measure_all([Source(before, _BEFORE), Source(after, _AFTER)], how)
    runs = [replace(each.run, slides=frozenset(prediction.slides)) for each in measured]
    comparison = Comparison(tuple(runs))
    if all(math.isnan(comparison.ratio(_AFTER, each)) for each in JUDGED):
        why = "; ".join(mismatches(runs)) or "an effort or a reference is missing"
        raise SettingError(f"{before} and {after} cannot be compared: {why}")
    others, warnings = _ran(prediction, after)
    return Verification(
        {
            name: {each.key: _held(prediction, comparison, each, name) for each in INDICES}
            for name in joints
        },
        {each.key: _held(prediction, comparison, each, None) for each in INDICES},
        (*_warnings(prediction, comparison, measured), *warnings),
        others,
    )


def _held(
    prediction: Prediction, comparison: Comparison, index: Quantity, joint: str | None
) -> Held:
    if joint is None:
        expected = prediction.total(index.key)
    else:
        expected = prediction.joints[joint][index.key]
    return Held(expected.ratio, comparison.ratio(_AFTER, index, joint))


def _warnings(
    prediction: Prediction, comparison: Comparison, measured: list[Measured]
) -> Iterator[str]:
    for each in measured:
        yield from each.defects
    yield from mismatches(comparison.runs)
    for index in JUDGED:
        then, now = prediction.total(index.key).before, comparison.baseline.value(index)
        if abs(now - then) > _SAME * abs(then):
            yield (
                f"the {index.symbol} before is {now:.4g} here, and was {then:.4g} when the "
                f"prediction was made from {prediction.bag}"
            )


def _ran(prediction: Prediction, after: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what ran that was not proposed, and what the recording does not tell of it."""
    try:
        controllers = recorded_controllers(after)
    except HpidError:
        line = "the recording after does not hold its controllers' parameters: taken as proposed"
        return (), (line,)
    others = []
    for joint, proposed in prediction.parameters.items():
        if joint not in controllers:
            continue
        ran = controllers[joint].settings.to_parameters()
        unlike = [
            f"{name} {ran.get(name)!r} for {value!r}"
            for name, value in proposed.items()
            if name in _TOLD and not _is_same(ran.get(name), value)
        ]
        if unlike:
            others.append(f"{joint} did not run what was proposed: {', '.join(unlike)}")
    return tuple(others), ()


_TOLD = ("law", "gains.p", "gains.i", "gains.d", "mu", "norm.type", "norm.effort_scale")


def _is_same(ran: object, proposed: object) -> bool:
    if isinstance(ran, float | int) and isinstance(proposed, float | int):
        return math.isclose(float(ran), float(proposed), rel_tol=_SAME, abs_tol=1e-9)
    return ran == proposed
