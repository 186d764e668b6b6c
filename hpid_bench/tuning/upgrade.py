"""A tuned PID's homogeneous PID: search, proposals, parameter file, gains of a relay test."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.gain_design import number_text
from hpid_ros.base.errors import GainError, HpidError, NormError, SettingError
from hpid_ros.base.names import ANYWHERE, controller_name
from hpid_ros.base.rounding import significant
from hpid_ros.base.text import shown
from hpid_ros.base.units import SECONDS_PER_NANOSECOND, of_slide, unit_over
from hpid_ros.base.yaml_text import inline_yaml
from hpid_ros.control.controller_files import INERTIA_RANGES
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
    inertia_of,
    sampling_margin,
)

_LEAST_STATES = 10
_SAME_STEP = 1e-9  # [rad]; closer positions are the same count, told apart by rounding


@dataclass(frozen=True)
class LoopStatistics:
    """Figures of one joint's recording."""

    largest_error: float  # [rad]
    mean_square_error: float  # [rad^2]
    largest_rate: float  # [rad/s] largest velocity of the joint, filtered as the loop would
    resolution: float  # [rad] smallest step of the measured position; 0 when it has none
    period: float  # [s] median time between two states
    states: int  # how many states there were


def loop_statistics(series: JointSeries, filter_time_constant: float) -> LoopStatistics:
    """Return the statistics of one joint's recording."""
    error = series.error
    if len(error) < _LEAST_STATES:
        raise SettingError(
            f"{series.joint!r} has {len(error)} states in the bag; at least {_LEAST_STATES} are "
            f"needed"
        )
    largest = float(np.max(np.abs(error)))
    if largest == 0.0:
        raise SettingError(f"the error of {series.joint!r} is zero throughout the bag")
    return LoopStatistics(
        largest_error=largest,
        mean_square_error=float(np.mean(np.square(error))),
        largest_rate=_largest_rate(series, filter_time_constant),
        resolution=position_resolution(series),
        period=median_period(series),
        states=len(error),
    )


def _largest_rate(series: JointSeries, filter_time_constant: float) -> float:
    """Return the largest velocity of the joint, filtered as the loop would.

    Not of the error: where the reference jumps the error's rate has no bound.
    """
    rate, largest = 0.0, 0.0
    time = series.time
    for dt, step in zip(np.diff(time), np.diff(series.position), strict=True):
        rate += dt / (filter_time_constant + dt) * (step / dt - rate)
        largest = max(largest, abs(rate))
    return float(largest)


def median_period(series: JointSeries) -> float:
    return float(np.median(np.diff(series.state_stamps_ns))) * SECONDS_PER_NANOSECOND


def position_resolution(series: JointSeries) -> float:
    """Return the smallest step between two positions, in [rad]; 0 where steps are no grid."""
    steps = np.diff(np.unique(series.position))
    steps = steps[steps > _SAME_STEP]
    if len(steps) == 0:
        return 0.0
    smallest = float(np.min(steps))
    counts = steps / smallest
    is_grid = np.all(np.abs(counts - np.round(counts)) < 0.05)
    return smallest if is_grid else 0.0


GOALS: Mapping[str, tuple[Quantity, ...]] = {
    "smooth": (IVC,),
    "fast": (ITAE,),
    "balanced": (IVC, ITAE),
}
"""What each goal lowers: of every joint, or, with ``balanced``, of the robot as a whole."""

BALANCED_FLOOR = 0.1
"""Of the norm in units of effort: at degree -0.3 it doubles the bandwidth and no more."""

_SHARE_OF_INTERVAL = 0.8
_STEP = 0.01
_ROUNDING = 1e-9  # the floor is chosen for this very margin
_SLOWEST, _FASTEST = 0.5, 2.0  # multipliers of the bandwidth at the floor of the norm
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

    The largest degree of the goal's sign is taken that lies in the inner four fifths of the
    certified interval, keeps the bandwidth at the floor of the norm within half and twice the
    PID's, and keeps T kd lam / m within what sampling bears.
    """
    scale = effort_scale(candidates) if goal == "balanced" else 0.0
    proposals, bases = Proposals({}, {}), list[tuple[Candidate, Upgrade]]()
    for each in candidates:
        try:
            bases.append((each, _base(each, scale)))
        except HpidError as error:
            proposals.failures[each.pid.joint] = error
            progress([each.pid.joint])
    found = certified_degrees([(base.settings, base.inertia) for _, base in bases], progress)
    for (each, base), interval in zip(bases, found, strict=True):
        if isinstance(interval, GainError):
            proposals.failures[each.pid.joint] = interval
        else:
            proposals.found[each.pid.joint] = _proposal(
                base, each.pid.plant_inertia, goal, interval
            )
    return proposals


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


def _base(candidate: Candidate, scale: float) -> Upgrade:
    """Return the homogeneous loop of degree 0, with reasons, and remarks on the PID."""
    pid = candidate.pid
    reasons: dict[str, str] = dict.fromkeys(("gains.p", "gains.i", "gains.d"), "as before")
    base = replace(pid, law="hpid", mu=0.0)
    if scale:
        base = _in_units_of_effort(base, scale, reasons)
    base = _with_statistics(base, candidate.statistics, reasons)
    least, largest, limit = base.effort.u_clamp_min, base.effort.u_clamp_max, candidate.effort
    within = {
        "u_clamp_min": max(least, min(-limit, largest)),
        "u_clamp_max": min(largest, limit),
    }
    base = base.with_parameters(within)
    for name, was in (("u_clamp_min", least), ("u_clamp_max", largest)):
        if getattr(base.effort, name) != was:
            had = "" if abs(was) == LARGEST_EFFORT else f"; it was {was:g}"
            reasons[name] = f"effort limit of the URDF{had}"
    remarks = _sampling_remarks(base, candidate.inertia[0])
    return Upgrade(base, (0.0, 0.0), candidate.inertia, reasons, remarks)


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


def _proposal(base: Upgrade, known: float, goal: str, certified: Certificate) -> Upgrade:
    inertia, ends = base.inertia, (certified.lower, certified.upper)
    # The floor that sampling asks for depends on the inertia that is written.
    start = base.settings if known else replace(base.settings, inertia=inertia[1])
    chosen, limit = start, "the largest degree that is tried"
    sign = 1.0 if goal == "smooth" else -1.0
    for step in range(1, 50):
        degree = round(sign * step * _STEP, 6)
        try:
            following = replace(start, mu=degree)
            excess = _excess(following, ends, inertia[0])
        except NormError as error:  # its floor has no room below the cap
            excess = f"is refused: {error}"
        if excess:
            which = "no other degree than 0 qualifies" if chosen is start else "the next one"
            limit = f"{which}: {degree:+.2f} {excess}"
            break
        chosen = following
    reasons = dict(base.reasons)
    reasons["mu"] = (
        f"goal {goal}: {limit}; certified {ends[0]:+.3f} to {ends[1]:+.3f} for {inertia[0]:.3g} "
        f"to {inertia[1]:.3g} kg m^2"
    )
    reasons["law"] = "the homogeneous PID with the same gains"
    if known == 0.0:
        reasons["inertia"] = (
            f"largest of {inertia[0]:.6g} to {inertia[1]:.6g} kg m^2: unstable gains are refused"
        )
    return replace(base, settings=chosen, interval=ends, reasons=reasons)


def _in_units_of_effort(
    settings: LoopSettings, scale: float, reasons: dict[str, str]
) -> LoopSettings:
    reasons["norm.effort_scale"] = (
        "root mean square of p e in the bag, over all joints: both laws agree there"
    )
    reasons["norm.type"] = "the norm of both terms together, whatever the degree"
    reasons["norm.floor"] = "at degree -0.3 the bandwidth is doubled and no more"
    own = ("norm.error_scale", "norm.rate_weight")
    return settings.with_parameters(
        {
            "norm.type": "canonical",
            "norm.effort_scale": scale,
            "norm.floor": BALANCED_FLOOR,
            **{name: PARAMETERS[name].default for name in own},
        }
    )


def _with_statistics(
    settings: LoopSettings, statistics: LoopStatistics | None, reasons: dict[str, str]
) -> LoopSettings:
    is_own = not settings.norm.effort_scale
    if statistics is None:
        if is_own:
            reasons["norm.error_scale"] = "not measured: the error at which both laws agree"
            reasons["norm.rate_weight"] = "not measured"
        return settings
    rate = statistics.largest_rate
    changes: dict[str, float] = {"control_period": statistics.period}
    reasons["control_period"] = "median time between two states in the bag"
    if is_own:
        changes["norm.error_scale"] = statistics.largest_error
        reasons["norm.error_scale"] = "largest error in the bag: both laws agree there"
    if is_own and rate > 0.0:
        changes["norm.rate_weight"] = 1.0 / rate
        reasons["norm.rate_weight"] = f"one over the largest velocity in the bag, {rate:.3g} rad/s"
    if statistics.resolution > 0.0:
        changes["encoder_resolution"] = statistics.resolution
        reasons["encoder_resolution"] = "smallest step of the position in the bag"
    return settings.with_parameters(changes)


def _excess(settings: LoopSettings, interval: tuple[float, float], inertia: float) -> str:
    """Say what speaks against a degree; nothing if it qualifies."""
    lower, upper = (_SHARE_OF_INTERVAL * end for end in interval)
    if not lower <= settings.mu <= upper:
        return "leaves the inner four fifths of the certified interval"
    floor = settings.norm_floor
    multiplier = floor**settings.mu if floor else math.inf if settings.mu < 0.0 else 0.0
    if not _SLOWEST <= multiplier <= _FASTEST:
        return f"multiplies the bandwidth by {multiplier:.2f} at the norm's floor"
    margin = sampling_margin(
        settings.gains, settings.timing.control_period, max(multiplier, 1.0), inertia
    )
    if margin > GOOD_SAMPLING_MARGIN * (1.0 + _ROUNDING) and settings.mu < 0.0:
        return f"brings T kd lam / m to {margin:.2f}, above {GOOD_SAMPLING_MARGIN}"
    return ""


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
            inertia = inertia_of(loop, inertias.get(loop.joint))
            if own is not None:
                statistics = loop_statistics(own, loop.velocity.filter_time_constant)
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


_COMMENT_COLUMN = 48
_LEAST_PLAIN = 1e-4  # what is smaller would lose digits without an exponent


def upgrade_text(
    loops: Sequence[Upgrade | LoopSettings],
    header: Sequence[str],
    notes: Mapping[str, Sequence[str]],
    slides: Collection[str] = frozenset(),
) -> str:
    settings = [each.settings if isinstance(each, Upgrade) else each for each in loops]
    joints = inline_yaml([each.joint for each in settings])
    lines = [*(f"# {shown(line)}".rstrip() for line in header), ""]
    lines += [f"{ANYWHERE}joint_controllers:", "  ros__parameters:", f"    joints: {joints}"]
    lines += _inertia_ranges([each for each in loops if isinstance(each, Upgrade)], slides)
    for each, own in zip(loops, settings, strict=True):
        name = controller_name(own.joint)
        is_slide = own.joint in slides
        lines += ["", *controller_section(name, each, notes.get(own.joint, ()), is_slide=is_slide)]
    return "\n".join(lines) + "\n"


def controller_section(
    name: str, loop: Upgrade | LoopSettings, notes: Sequence[str], *, is_slide: bool
) -> list[str]:
    settings, reasons = (loop.settings, loop.reasons) if isinstance(loop, Upgrade) else (loop, {})
    said = [f"# {shown(note)}" for note in notes]
    parameters = _parameters(settings, reasons, is_slide=is_slide)
    if is_slide:
        said = [of_slide(line) for line in said]
    return [*said, f"{ANYWHERE}{name}:", "  ros__parameters:", *parameters]


def _inertia_ranges(upgrades: Sequence[Upgrade], slides: Collection[str]) -> list[str]:
    """Return a section for the commands that judge gains; a controller has one inertia."""
    if not upgrades:
        return []
    unit = unit_over("kg m^2", (each.settings.joint in slides for each in upgrades))
    lines = [
        "",
        f"# Least and largest inertia [{unit}], read by hpid check-gains and upgrade; no node",
    ]
    lines += ["# has this name.", f"{ANYWHERE}{INERTIA_RANGES}:", "  ros__parameters:"]
    for each in upgrades:
        low, high = (_value(value) for value in each.inertia)
        lines.append(f"    {_value(each.settings.joint)}: [{low}, {high}]")
    return lines


def _parameters(
    settings: LoopSettings, reasons: Mapping[str, str], *, is_slide: bool
) -> list[str]:
    lines: list[str] = []
    section = ""
    for name, value in settings.to_parameters().items():
        *path, last = name.split(".")
        inner = ".".join(path)
        if inner and inner != section:
            lines.append(f"    {inner}:")
        section = inner
        entry = f"{'      ' if inner else '    '}{last}: {_value(value)}"
        reason = _reason(reasons, name, value)
        said = of_slide(reason) if is_slide else reason
        lines.append(f"{entry:<{_COMMENT_COLUMN}}  # {said}")
    return lines


def _value(value: Value) -> str:
    """Return a YAML scalar that ROS reads as the type it is."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return inline_yaml(value)
    if 0.0 < abs(value) < _LEAST_PLAIN:
        return number_text(value)
    text = f"{value:.6g}"
    return text if "." in text and "e" not in text else f"{value:.10f}".rstrip("0") + "0"


def _reason(reasons: Mapping[str, str], name: str, value: Value) -> str:
    if name in reasons:
        return reasons[name]
    spec = PARAMETERS[name]
    origin = "default" if value == spec.default else "as before"
    text = spec.description
    is_word = text[1:2].islower()  # and no abbreviation
    return f"{origin}: {text[0].lower() if is_word else text[0]}{text[1:]}"
