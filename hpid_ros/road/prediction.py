"""What a proposal is predicted to bring, as numbers that are kept until somebody has tried it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from hpid_ros import __version__
from hpid_ros.analysis import RunIndices
from hpid_ros.analysis.quantities import INDICES
from hpid_ros.base.errors import SettingError
from hpid_ros.road.proposal import JUDGED, PREDICTED, RECORDED, SIMULATED, Answer

KIND = "hpid_ros/prediction"
"""What a file of this kind says it is."""

_FAR = 1.5  # times, or as a part, of a recorded index: no model of that robot

_KEYS = tuple(each.key for each in INDICES)


class Expected(NamedTuple):
    """One index of one joint."""

    before: float  # measured under the PID
    # what it becomes, over that: of the simulations, in which what the model lacks is in both
    ratio: float
    fidelity: float  # of the simulated PID over the measured one: 1 where the model is right
    doubt: float = 0.0

    @property
    def after(self) -> float:
        """What is expected to be measured."""
        return self.before * self.ratio

    @property
    def low(self) -> float:
        """Lower end of the ratio's interval."""
        return self.ratio * math.exp(-self.doubt)

    @property
    def high(self) -> float:
        """Upper end of it."""
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
        return Expected(
            before, _over(after, before), _over(simulated, before), _over(doubt, after)
        )

    @property
    def is_credible(self) -> bool:
        """Whether the simulated PID is anything like the recorded one."""
        totals = [self.total(index.key).fidelity for index in JUDGED]
        return all(1.0 / _FAR <= each <= _FAR for each in totals)

    def as_text(self) -> str:
        """Return the prediction as JSON."""
        joints = {
            name: {
                "indices": {key: each._asdict() for key, each in known.items()},
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


def prediction_of(found: Answer) -> Prediction:
    """Return what an answer predicts of the joints that it is about."""
    recorded, simulated, proposed = (
        found.comparison.run(label) for label in (RECORDED, SIMULATED, PREDICTED)
    )
    names = [each.joint for each in found.loops]
    return Prediction(
        found.question.bag.name,
        found.goal,
        {
            name: _expected(name, recorded, simulated, proposed, found.doubts[name])
            for name in names
        },
        {each.joint: dict(each.to_parameters()) for each in found.settings},
        tuple(name for name in names if name in found.question.robot.description.slides),
    )


def _expected(
    joint: str,
    recorded: RunIndices,
    simulated: RunIndices,
    proposed: RunIndices,
    doubt: float,
) -> dict[str, Expected]:
    values = {}
    for index in INDICES:
        before, model, after = (run.value(index, joint) for run in (recorded, simulated, proposed))
        values[index.key] = Expected(before, _over(after, model), _over(model, before), doubt)
    return values


def _over(value: float, other: float) -> float:
    return value / other if other else math.nan


def read_prediction(path: Path) -> Prediction:
    """Read a prediction."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(
            f"cannot read the prediction {path}: {reason}; hpid upgrade BAG writes it beside the "
            "parameter file, --prediction names it"
        ) from None
    except (ValueError, RecursionError):
        raise SettingError(f"{path} is no prediction: it is no JSON") from None
    try:
        return _from(document)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise SettingError(f"{path} is no prediction that hpid upgrade has written") from None


def _from(document: Mapping[str, Any]) -> Prediction:
    if document["kind"] != KIND or not document["joints"]:
        raise ValueError
    return Prediction(
        str(document["bag"]),
        str(document["goal"]),
        {
            str(name): {
                key: Expected(*(float(each["indices"][key][of]) for of in Expected._fields))
                for key in _KEYS
            }
            for name, each in document["joints"].items()
        },
        {str(name): dict(each["parameters"]) for name, each in document["joints"].items()},
        tuple(map(str, document["slides"])),
    )
