"""The prediction of an upgrade: kept in a file, and held against what was measured."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from hpid_bench.tuning.recorded_loops import recorded_controllers
from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.files import load_json
from hpid_ros.control.laws import LAWS
from hpid_ros.control.settings import NormSettings
from hpid_ros.messages.messages import read_retunes
from hpid_ros.messages.selection import BagSelection
from hpid_ros.metrics.comparison import Comparison, mismatches
from hpid_ros.metrics.measure import Measured, Measuring, Source, measure_all
from hpid_ros.metrics.quantities import INDICES, ITAE, IVC, Quantity
from hpid_ros.metrics.results import for_json

KIND = "hpid_ros/prediction"
"""What a file of this kind says it is."""

_FAR = 1.5  # times, or as a part, of a recorded index: no model of that robot

JUDGED = (IVC, ITAE)
"""The indices that a prediction has to hold for, of all joints together."""


class Expected(NamedTuple):
    """One index of one joint."""

    before: float  # measured under the PID
    # what it becomes, over that: of the simulations, in which what the model lacks is in both
    ratio: float
    fidelity: float  # of the simulated PID over the measured one: 1 where the model is right
    doubt: float = 0.0

    @property
    def after(self) -> float:
        return self.before * self.ratio

    @property
    def low(self) -> float:
        return self.ratio * math.exp(-self.doubt)

    @property
    def high(self) -> float:
        return self.ratio * math.exp(self.doubt)

    @property
    def is_certain(self) -> bool:
        """Whether the interval lies on one side of no change."""
        return self.high < 1.0 or self.low > 1.0


@dataclass(frozen=True)
class Prediction:
    """What is expected."""

    bag: str  # name of the recording under the PID
    goal: str  # what the proposal is for
    joints: Mapping[str, Mapping[str, Expected]]  # of each joint, by key of the index
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    slides: tuple[str, ...] = ()  # joints that slide

    def total(self, key: str) -> Expected:
        """Return an index of all joints, the sum of theirs.

        A joint of which nothing was recorded, as one that rested without an effort, has no ratio
        and no share.
        """
        each = [known[key] for known in self.joints.values() if known[key].before != 0.0]
        before = math.fsum(one.before for one in each)
        after = math.fsum(one.after for one in each)
        simulated = math.fsum(one.before * one.fidelity for one in each)
        doubt = math.fsum(one.after * one.doubt for one in each)
        return Expected(before, over(after, before), over(simulated, before), over(doubt, after))

    @property
    def is_credible(self) -> bool:
        """Whether the simulated PID is anything like the recorded one."""
        totals = [self.total(index.key).fidelity for index in JUDGED]
        return all(1.0 / _FAR <= each <= _FAR for each in totals)

    def as_text(self) -> str:
        joints = {
            name: {
                "indices": {
                    key: dict(zip(each._fields, map(for_json, each), strict=True))
                    for key, each in known.items()
                },
                "parameters": dict(self.parameters.get(name, {})),
            }
            for name, known in self.joints.items()
        }
        document = {
            "kind": KIND,
            "hpid_ros": __version__,
            "bag": self.bag,
            "goal": self.goal,
            "slides": list(self.slides),
            "joints": joints,
        }
        return json.dumps(document, indent=2) + "\n"


def over(value: float, other: float) -> float:
    return value / other if other else math.nan


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def read_prediction(path: Path) -> Prediction:
    """Return the prediction that ``hpid upgrade BAG`` has written with the parameter file."""
    try:
        document = load_json(path)
    except SettingError as error:
        raise SettingError(f"{error}; --prediction names what hpid upgrade BAG wrote") from None
    try:
        if document["kind"] != KIND or not document["joints"]:
            raise ValueError
        return Prediction(
            str(document["bag"]),
            str(document["goal"]),
            {
                str(name): {
                    index.key: Expected(
                        *(_number(each["indices"][index.key][of]) for of in Expected._fields)
                    )
                    for index in INDICES
                }
                for name, each in document["joints"].items()
            },
            {str(name): dict(each["parameters"]) for name, each in document["joints"].items()},
            tuple(map(str, document["slides"])),
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        raise SettingError(f"{path} is no prediction that hpid upgrade has written") from None


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
        return abs(self.off) <= HOLDS_WITHIN


@dataclass(frozen=True)
class PredictionVerification:
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


def verify_prediction(prediction: Prediction, before: Path, after: Path) -> PredictionVerification:
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

    def held(index: Quantity, joint: str | None = None) -> Held:
        known = prediction.joints[joint][index.key] if joint else prediction.total(index.key)
        return Held(known.ratio, comparison.ratio(_AFTER, index, joint))

    return PredictionVerification(
        {name: {each.key: held(each, name) for each in INDICES} for name in joints},
        {each.key: held(each) for each in INDICES},
        (*_warnings(prediction, comparison, measured), *warnings),
        others,
    )


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
    linear = [name for name, law in LAWS.items() if not law.needs_norm]
    for joint, proposed in prediction.parameters.items():
        if joint not in controllers:
            continue
        ran = controllers[joint].settings.to_parameters()
        has_norm = proposed.get("law") not in linear  # a PID's makes no difference
        unlike = [
            f"{name} {ran.get(name)!r} for {value!r}"
            for name, value in proposed.items()
            if name in _CHECKED
            and (has_norm or not name.startswith("norm."))
            and not _is_same(ran.get(name), value)
        ]
        if unlike:
            others.append(f"{joint} did not run what was proposed: {', '.join(unlike)}")
    nodes = {controllers[joint].node for joint in prediction.parameters if joint in controllers}
    for retune in read_retunes(after):
        names = {each.partition(" = ")[0] for each in retune.change.split(", ")}
        if retune.node.rpartition("/")[2] in nodes and names.intersection(_CHECKED):
            others.append(f"while it ran, {retune.node} was set: {retune.change}")
    return tuple(others), ()


_CHECKED = (
    "law",
    "gains.p",
    "gains.i",
    "gains.d",
    "mu",
    "discretization",
    *(f"norm.{each.name}" for each in fields(NormSettings)),
    "velocity_source",
    "velocity_filter_time_constant",
)


def _is_same(ran: object, proposed: object) -> bool:
    if isinstance(ran, float | int) and isinstance(proposed, float | int):
        return math.isclose(float(ran), float(proposed), rel_tol=_SAME, abs_tol=1e-9)
    return ran == proposed
