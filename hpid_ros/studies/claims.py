"""The paper's claims on the homogeneous PID with the PID's gains, and what a study says of them.

Source: the paper, Table I and the text around it: over six arm joints IVC 4980 -> 2866, IAVC
541 -> 428, L2 norm of the effort 423.9 -> 329.5, ITAE 24.68 -> 23.37, ITAE lower in most joints.
(Table I has the error's L2 norm twice with opposite winners: held is that it rises by at most
5 %.) The words "smoother", "less effort", "same accuracy" and "less overshoot" are its
conclusions; what each is taken to mean is said beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from hpid_ros.analysis.quantities import EFFORT_L2, ERROR_L2, IAVC, ITAE, IVC, OVERSHOOT, Quantity
from hpid_ros.report.tables.numbers import format_ratio

JOINTS_SHARE = 4.0 / 6.0
"""The paper's four of six joints."""


@dataclass(frozen=True)
class Evidence:
    """What one experiment says of a controller, against the baseline with the same gains."""

    ratios: Mapping[str, float]  # median over the seeds of each index over the baseline's, by key
    joint_itae: Mapping[str, float]  # the same of each joint's ITAE

    @property
    def joints_better(self) -> int:
        """Joints whose ITAE is lower than the baseline's."""
        return sum(value < 1.0 for value in self.joint_itae.values())

    @property
    def joints_wanted(self) -> int:
        """As many of the joints as four are of six, rounded up."""
        return math.ceil(JOINTS_SHARE * len(self.joint_itae) - 1e-9)


class ClaimVerdict(Enum):
    """What several experiments say of a claim."""

    HOLDS = "holds"
    HOLDS_WHEN = "holds only when"
    DOES_NOT_HOLD = "does not hold"
    UNKNOWN = "not measured"


@dataclass(frozen=True)
class PaperClaim:
    """One claim."""

    key: str  # name in files
    text: str  # the claim in words
    holds: Callable[[Evidence], bool | None]  # whether evidence supports it
    figure: Callable[[Evidence], str]  # the figures of the evidence that decide


def _figures(quantities: Sequence[Quantity]) -> Callable[[Evidence], str]:
    def figure(evidence: Evidence) -> str:
        ratios = {q.symbol: evidence.ratios[q.key] for q in quantities if q.key in evidence.ratios}
        if len(quantities) == 1:
            return "".join(map(format_ratio, ratios.values()))
        return ", ".join(f"{symbol} {format_ratio(each)}" for symbol, each in ratios.items())

    return figure


def _at_most(limits: Mapping[Quantity, float]) -> Callable[[Evidence], bool | None]:
    def holds(evidence: Evidence) -> bool | None:
        if any(quantity.key not in evidence.ratios for quantity in limits):
            return None
        return all(evidence.ratios[q.key] <= limit for q, limit in limits.items())

    return holds


def _below_one(quantities: Sequence[Quantity]) -> Callable[[Evidence], bool | None]:
    def holds(evidence: Evidence) -> bool | None:
        if any(quantity.key not in evidence.ratios for quantity in quantities):
            return None
        return all(evidence.ratios[quantity.key] < 1.0 for quantity in quantities)

    return holds


def _ratio_claim(key: str, quantity: Quantity, limit: float) -> PaperClaim:
    text = f"{quantity.symbol}, {quantity.meaning}: at most {limit:g} of the PID's"
    return PaperClaim(key, text, _at_most({quantity: limit}), _figures([quantity]))


def _enough_joints(evidence: Evidence) -> bool | None:
    return evidence.joints_better >= evidence.joints_wanted if evidence.joint_itae else None


def _joints_figure(evidence: Evidence) -> str:
    return f"{evidence.joints_better} of {len(evidence.joint_itae)}"


NUMERIC_CLAIMS = (
    _ratio_claim("ivc", IVC, 0.575),
    _ratio_claim("iavc", IAVC, 0.79),
    _ratio_claim("effort_l2", EFFORT_L2, 0.777),
    _ratio_claim("itae", ITAE, 0.947),
    _ratio_claim("error_l2", ERROR_L2, 1.05),
    PaperClaim("joints", "ITAE lower in at least 4 of 6 joints", _enough_joints, _joints_figure),
)


def _all_hold(evidence: Evidence) -> bool | None:
    answers = [claim.holds(evidence) for claim in NUMERIC_CLAIMS]
    return None if None in answers else all(answers)


def _count(evidence: Evidence) -> str:
    held = sum(claim.holds(evidence) is True for claim in NUMERIC_CLAIMS)
    return f"{held} of {len(NUMERIC_CLAIMS)}"


_ACCURACY = {ITAE: 1.05, ERROR_L2: 1.05}

CLAIMS = (
    *NUMERIC_CLAIMS,
    PaperClaim("together", "all of these together", _all_hold, _count),
    PaperClaim("smoother", "smoother: a lower IVC", _below_one([IVC]), _figures([IVC])),
    PaperClaim(
        "less_effort",
        "less effort: a lower IAVC and ||u||",
        _below_one([IAVC, EFFORT_L2]),
        _figures([IAVC, EFFORT_L2]),
    ),
    PaperClaim(
        "accuracy",
        "the same accuracy: ITAE and ||e|| up to 1.05",
        _at_most(_ACCURACY),
        _figures(list(_ACCURACY)),
    ),
    PaperClaim(
        "overshoot",
        "less overshoot: the largest of a step",
        _below_one([OVERSHOOT]),
        _figures([OVERSHOOT]),
    ),
)


def verdict(
    claim: PaperClaim, evidence: Mapping[str, Evidence]
) -> tuple[ClaimVerdict, tuple[str, ...]]:
    """Return what experiments say of a claim, and in which of them it holds."""
    answers = {name: claim.holds(each) for name, each in evidence.items()}
    known = {name: answer for name, answer in answers.items() if answer is not None}
    held = tuple(name for name, answer in known.items() if answer)
    if not known:
        return ClaimVerdict.UNKNOWN, held
    if len(held) == len(known):
        return ClaimVerdict.HOLDS, held
    return (ClaimVerdict.HOLDS_WHEN if held else ClaimVerdict.DOES_NOT_HOLD), held
