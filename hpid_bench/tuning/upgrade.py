"""A homogeneous PID for a tuned PID: what is proposed for each joint, and why."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from hpid_bench.tuning.degree_search import largest_degree
from hpid_bench.tuning.loop_statistics import LoopStatistics, loop_statistics
from hpid_ros.base.errors import GainError, HpidError, SettingError
from hpid_ros.base.rounding import significant
from hpid_ros.control.norms import GOOD_SAMPLING_MARGIN
from hpid_ros.control.settings import LARGEST_EFFORT, PARAMETERS, LoopSettings, Value
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import ITAE, IVC, Quantity
from hpid_ros.robot.description import RobotDescription
from hpid_ros.stability.closed_loop import Certificate
from hpid_ros.stability.gain_check import (
    LARGEST_SAMPLING_MARGIN,
    LARGEST_SAMPLING_MARGIN_LATE,
    certified_degrees,
    judged_inertia,
    sampling_margin,
)

GOALS: Mapping[str, tuple[Quantity, ...]] = {
    "smooth": (IVC,),
    "fast": (ITAE,),
    "balanced": (IVC, ITAE),
}
"""What each goal lowers: of every joint, or, with ``balanced``, of the robot as a whole."""

BALANCED_FLOOR = 0.1
"""Of the norm in units of effort: at degree -0.3 it doubles the bandwidth and no more."""

_LEAST_GAIN = 0.02  # of the goal's index; what is less is not worth another law


@dataclass(frozen=True)
class Candidate:
    """A loop to be upgraded."""

    pid: LoopSettings  # the loop as it is; its gains stay
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia
    statistics: LoopStatistics | None = None  # of a recording under the PID, or None
    effort: float = math.inf  # [N m] the motor's limit; infinite if unknown


@dataclass(frozen=True)
class Upgrade:
    """A proposal for one joint."""

    settings: LoopSettings  # the loop, ready to run; the linear law where there is nothing to gain
    interval: tuple[float, float]  # certified degrees
    inertia: tuple[float, float]  # [kg m^2] least and largest inertia that they are certified for
    reasons: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # what to know of the loop as it is


class Proposals(NamedTuple):
    """What came of controllers."""

    found: dict[str, Upgrade]  # what is proposed, by joint
    failures: dict[str, HpidError]  # why there is nothing for the other joints


def effort_scale(candidates: Sequence[Candidate]) -> float:
    """Return one scale of the norm for all joints of a robot, in [N m].

    It is the root mean square of the proportional term p e over the states of all joints: where a
    PID works harder than that, the homogeneous one of a negative degree is gentler. Gravity and
    friction are not in it, the integral carries them.
    """
    known = [(_stiffness(each.pid), each.statistics) for each in candidates if each.statistics]
    states = sum(statistics.states for _, statistics in known)
    total = sum(p * p * each.mean_square_error * each.states for p, each in known)
    if total == 0.0:
        raise SettingError(
            "goal balanced takes the norm's scale in N m from a recording under the PID, with a "
            "proportional gain and joints that move: give --bag, or one with more of a motion"
        )
    return significant(math.sqrt(total / states), 3)


def _stiffness(pid: LoopSettings) -> float:
    """Return the proportional gain in [N m/rad]; with decoupling it is an acceleration's."""
    if not pid.model.is_decoupling:
        return pid.gains.p
    if not pid.inertia:
        raise SettingError(
            f"goal balanced needs the inertia of {pid.joint!r}, whose gains are accelerations by "
            "compensation decoupling: set its parameter inertia"
        )
    return pid.inertia * pid.gains.p


def upgrades(
    candidates: Sequence[Candidate],
    goal: str,
    progress: Callable[[Sequence[str]], None] = lambda joints: None,
) -> Proposals:
    """Propose a degree and a norm for the gains of several PIDs.

    The degree is the largest one of the goal's sign, see :func:`.largest_degree`.
    """
    scale = effort_scale(candidates) if goal == "balanced" else 0.0
    found: dict[str, Upgrade] = {}
    failures: dict[str, HpidError] = {}
    bases: list[_Base] = []
    for each in candidates:
        try:
            bases.append(_base(each, scale))
        except HpidError as error:
            failures[each.pid.joint] = error
            progress([each.pid.joint])
    loops = [(base.loop.settings, base.candidate.inertia) for base in bases]
    for base, interval in zip(bases, certified_degrees(loops, progress), strict=True):
        joint = base.candidate.pid.joint
        if isinstance(interval, GainError):
            failures[joint] = interval
        else:
            found[joint] = _proposal(base, goal, interval)
    return Proposals(found, failures)


def upgrade(
    pid: LoopSettings,
    inertia: tuple[float, float],
    goal: str,
    statistics: LoopStatistics | None = None,
) -> Upgrade:
    """Propose a degree and a norm for the gains of one PID; see :func:`upgrades`."""
    found, failures = upgrades([Candidate(pid, inertia, statistics)], goal)
    for error in failures.values():
        raise error
    return found[pid.joint]


def worthwhile(
    each: Upgrade, goal: str, prediction: Comparison | None, doubt: float = 0.0
) -> Upgrade:
    """Return a proposal, or the PID where there is nothing to gain.

    There is something to gain where another degree than 0 qualifies and, as far as a prediction
    says, each of the goal's indices falls by at least 2 %, and by more than is in doubt: the
    joint's own, or, with the goal ``balanced``, that of all joints together.
    """
    settings = each.settings
    if settings.mu == 0.0:
        why = each.reasons["mu"]
    elif prediction is None:
        return each
    else:
        joint = None if goal == "balanced" else settings.joint
        label = prediction.others[0].label
        enough = min(1.0 - _LEAST_GAIN, math.exp(-doubt))
        ratios = {index: prediction.ratio(label, index, joint) for index in GOALS[goal]}
        short = {index: r for index, r in ratios.items() if r > enough}
        if not short:
            return each
        index, ratio = next(iter(short.items()))
        why = (
            f"with mu {settings.mu:+.2f} the predicted {index.symbol} is {ratio:.3f} of the PID's"
        )
        if doubt:
            factor = math.exp(doubt)
            why += f", between {ratio / factor:.3g} and {ratio * factor:.3g}"
    reasons = {**each.reasons, "law": f"nothing to gain, keep your PID: {why}", "mu": "linear"}
    kept = replace(settings, law="pid", mu=0.0)
    return replace(each, settings=kept, reasons=reasons)


class _Explained(NamedTuple):
    """A loop, with the reasons for what its parameters are."""

    settings: LoopSettings
    reasons: Mapping[str, str]

    def changed(self, values: Mapping[str, Value], reasons: Mapping[str, str]) -> _Explained:
        settings = self.settings.with_parameters(values) if values else self.settings
        return _Explained(settings, {**self.reasons, **reasons})


class _Base(NamedTuple):
    """A loop of which only the degree is still to be chosen."""

    candidate: Candidate  # that it is made of
    loop: _Explained  # homogeneous, of degree 0
    remarks: tuple[str, ...]  # what to know of the PID


def _base(candidate: Candidate, scale: float) -> _Base:
    as_before = dict.fromkeys(("gains.p", "gains.i", "gains.d"), "as before")
    loop = _Explained(replace(candidate.pid, law="hpid", mu=0.0), as_before)
    if scale:
        loop = _in_units_of_effort(loop, scale)
    loop = _with_statistics(loop, candidate.statistics)
    loop = _within_limit(loop, candidate.effort)
    remarks = _sampling_remarks(loop.settings, candidate.inertia[0])
    return _Base(candidate, loop, remarks)


def _in_units_of_effort(loop: _Explained, scale: float) -> _Explained:
    own = ("norm.error_scale", "norm.rate_weight")
    values = {
        "norm.type": "canonical",
        "norm.effort_scale": scale,
        "norm.floor": BALANCED_FLOOR,
        **{name: PARAMETERS[name].default for name in own},
    }
    reasons = {
        "norm.effort_scale": (
            "root mean square of p e in the bag, over all joints: both laws agree there"
        ),
        "norm.type": "the norm of both terms together, whatever the degree",
        "norm.floor": "at degree -0.3 the bandwidth is doubled and no more",
    }
    return loop.changed(values, reasons)


def _with_statistics(loop: _Explained, statistics: LoopStatistics | None) -> _Explained:
    has_own_scale = not loop.settings.norm.effort_scale
    values: dict[str, Value] = {}
    reasons: dict[str, str] = {}
    if statistics is None:
        if has_own_scale:
            reasons["norm.error_scale"] = "not measured: the error at which both laws agree"
            reasons["norm.rate_weight"] = "not measured"
        return loop.changed(values, reasons)
    values["control_period"] = statistics.period
    reasons["control_period"] = "median time between two states in the bag"
    if has_own_scale:
        values["norm.error_scale"] = statistics.largest_error
        reasons["norm.error_scale"] = "largest error in the bag: both laws agree there"
    rate = statistics.largest_rate
    if has_own_scale and rate > 0.0:
        values["norm.rate_weight"] = 1.0 / rate
        reasons["norm.rate_weight"] = f"one over the largest velocity in the bag, {rate:.3g} rad/s"
    if statistics.resolution > 0.0:
        values["encoder_resolution"] = statistics.resolution
        reasons["encoder_resolution"] = "smallest step of the position in the bag"
    return loop.changed(values, reasons)


def _within_limit(loop: _Explained, limit: float) -> _Explained:
    """Return a loop whose efforts are within the motor's limit, too."""
    least, largest = loop.settings.effort.u_clamp_min, loop.settings.effort.u_clamp_max
    before = {"u_clamp_min": least, "u_clamp_max": largest}
    within = {
        "u_clamp_min": max(least, min(-limit, largest)),
        "u_clamp_max": min(largest, limit),
    }
    reasons = {}
    for name, was in before.items():
        if within[name] != was:
            had = "" if abs(was) == LARGEST_EFFORT else f"; it was {was:g}"
            reasons[name] = f"effort limit of the URDF{had}"
    return loop.changed(within, reasons)


def _sampling_remarks(settings: LoopSettings, inertia: float) -> tuple[str, ...]:
    """Say whether sampling is felt by the PID itself."""
    period = settings.timing.control_period
    margin = sampling_margin(settings.gains, period, 1.0, inertia)
    if margin <= GOOD_SAMPLING_MARGIN or settings.discretization != "explicit":
        return ()
    figures = (
        f"T kd / m = {margin:.3g} (T {period:g} s, kd {settings.gains.d:g}, "
        f"least m {inertia:.3g} kg m^2)"
    )
    if margin > LARGEST_SAMPLING_MARGIN_LATE:
        raise GainError(
            f"the PID itself is beyond what sampling bears: {figures}; the sampled loop breaks at "
            f"{LARGEST_SAMPLING_MARGIN_LATE:g} where an effort comes one period late, as over a "
            f"topic, and at {LARGEST_SAMPLING_MARGIN:g} at best: lower gains.d or the period, or, "
            f"if this PID works on the robot, give its true inertia"
        )
    return (
        f"sampling is felt by the PID itself: {figures}, above {GOOD_SAMPLING_MARGIN:g}; it "
        f"breaks at {LARGEST_SAMPLING_MARGIN_LATE:g} where an effort comes one period late",
    )


def _proposal(base: _Base, goal: str, certified: Certificate) -> Upgrade:
    least, largest = base.candidate.inertia
    interval = certified.lower, certified.upper
    is_known = base.candidate.pid.plant_inertia != 0.0
    linear = base.loop.settings
    if not is_known:
        # The floor that sampling asks for depends on the inertia that is written.
        linear = replace(linear, inertia=largest)
    sign = 1.0 if goal == "smooth" else -1.0
    settings, limit = largest_degree(linear, sign, interval, least)
    reasons = {
        **base.loop.reasons,
        "mu": (
            f"goal {goal}: {limit}; certified {interval[0]:+.3f} to {interval[1]:+.3f} for "
            f"{least:.3g} to {largest:.3g} kg m^2"
        ),
        "law": "the homogeneous PID with the same gains",
    }
    if not is_known:
        reasons["inertia"] = (
            f"largest of {least:.6g} to {largest:.6g} kg m^2: unstable gains are refused"
        )
    return Upgrade(settings, interval, base.candidate.inertia, reasons, base.remarks)


Certifying = Callable[[int], AbstractContextManager[Callable[[Sequence[str]], None]]]
"""Shows how many of a number of joints are certified."""


def propose(
    loops: Sequence[LoopSettings],
    inertias: Mapping[str, tuple[float, float]],
    recorded: Sequence[JointSeries],
    limits: Mapping[str, float],
    goal: str,
    certifying: Certifying,
) -> Proposals:
    """Propose a homogeneous PID for each controller."""
    series = {each.joint: each for each in recorded}
    candidates: list[Candidate] = []
    refused: dict[str, HpidError] = {}
    for loop in loops:
        own, statistics = series.get(loop.joint), None
        try:
            inertia = judged_inertia(loop, inertias.get(loop.joint))
            if own is not None:
                statistics = loop_statistics(own, loop.velocity.velocity_filter_time_constant)
        except HpidError as error:
            refused[loop.joint] = error
        else:
            limit = limits.get(loop.joint, math.inf)
            candidates.append(Candidate(loop, inertia, statistics, limit))
    with certifying(len(candidates)) as progress:
        found, failures = upgrades(candidates, goal, progress)
    failures = refused | failures
    if not found:
        reasons = dict.fromkeys(map(str, failures.values()))
        raise SettingError(f"no joint can be upgraded: {'; '.join(reasons)}")
    return Proposals(found, failures)


def effort_limits(description: RobotDescription) -> dict[str, float]:
    """Return the limits of a robot's motors, by joint, in [N m]; inf where it says none."""
    return {name: joint.effort for name, joint in description.joints.items()}
