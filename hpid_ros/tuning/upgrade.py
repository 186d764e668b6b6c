"""From a tuned PID to the homogeneous PID with the same gains: every number with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hpid_ros.control import HomogeneousPid, LoopSettings
from hpid_ros.control.loop_figures import GOOD_SAMPLING_MARGIN, sampling_margin
from hpid_ros.control.stability import certified_degree_interval
from hpid_ros.errors import GainError
from hpid_ros.tuning.certified_degrees import norm_family
from hpid_ros.tuning.loop_statistics import LoopStatistics

GOALS = ("smooth", "fast")

_SHARE_OF_INTERVAL = 0.8
_STEP = 0.01
_SLOWEST, _FASTEST = 0.5, 2.0  # multipliers of the bandwidth at the floor of the norm


@dataclass(frozen=True)
class Upgrade:
    """A proposal for one joint.

    Attributes:
        settings: The homogeneous loop, ready to run.
        interval: Certified degrees.
        inertia: Least and largest inertia that they are certified for, in [kg m^2].
        reasons: Why a parameter has its value, by the parameter's name.
    """

    settings: LoopSettings
    interval: tuple[float, float]
    inertia: tuple[float, float]
    reasons: Mapping[str, str] = field(default_factory=dict)


def upgrade(
    pid: LoopSettings,
    inertia: tuple[float, float],
    goal: str,
    statistics: LoopStatistics | None = None,
) -> Upgrade:
    """Propose a degree and a norm for the gains of a PID.

    The largest degree of the goal's sign is taken that lies in the inner four fifths of the
    certified interval, keeps the bandwidth at the floor of the norm within half and twice the
    PID's, and keeps T kd lam / m within what sampling bears.

    Args:
        pid: The loop as it is; its gains stay.
        inertia: Least and largest inertia, in [kg m^2].
        goal: ``smooth`` (gains fall close to the target) or ``fast`` (they rise).
        statistics: Of a recording under the PID.

    Raises:
        GainError: The gains are not stable, or no degree is certified.
    """
    reasons: dict[str, str] = dict.fromkeys(("gains.p", "gains.i", "gains.d"), "as before")
    base = _with_statistics(replace(pid, law="hpid", mu=0.0), statistics, reasons)
    interval = certified_degree_interval(base.gains, norm_family(base), inertia)
    ends = (interval.lower, interval.upper)
    chosen, limit = base, "degree zero: no other one qualifies"
    sign = 1.0 if goal == "smooth" else -1.0
    for step in range(1, 50):
        degree = round(sign * step * _STEP, 6)
        candidate = replace(base, mu=degree)
        excess = _excess(candidate, ends, inertia[0])
        if excess:
            limit = f"the next one, {degree:+.2f}, {excess}"
            break
        chosen = candidate
    reasons["mu"] = (
        f"goal {goal}: {limit}; certified {ends[0]:+.3f} to {ends[1]:+.3f} for {inertia[0]:.3g} "
        f"to {inertia[1]:.3g} kg m^2"
    )
    reasons["law"] = "the homogeneous PID with the same gains"
    if pid.inertia == 0.0:
        chosen = replace(chosen, inertia=inertia[1])
        reasons["inertia"] = "largest of the robot's range: unstable gains are refused"
    return Upgrade(chosen, ends, inertia, reasons)


def _with_statistics(
    settings: LoopSettings, statistics: LoopStatistics | None, reasons: dict[str, str]
) -> LoopSettings:
    if statistics is None:
        reasons["norm.error_scale"] = "not measured: the error at which both laws agree"
        reasons["norm.rate_weight"] = "not measured"
        return settings
    rate = statistics.largest_rate
    changes: dict[str, float] = {
        "norm_error_scale": statistics.largest_error,
        "control_period": statistics.period,
    }
    reasons["norm.error_scale"] = "largest error in the bag: both laws agree there"
    reasons["control_period"] = "median time between two states in the bag"
    if rate > 0.0:
        changes["norm_rate_weight"] = 1.0 / rate
        reasons["norm.rate_weight"] = f"one over the largest velocity in the bag, {rate:.3g} rad/s"
    if statistics.resolution > 0.0:
        changes["encoder_resolution"] = statistics.resolution
        reasons["encoder_resolution"] = "smallest step of the position in the bag"
    return replace(settings, **changes)  # type: ignore[arg-type]


def _excess(settings: LoopSettings, interval: tuple[float, float], inertia: float) -> str:
    """Say what speaks against a degree; nothing if it qualifies."""
    lower, upper = (_SHARE_OF_INTERVAL * end for end in interval)
    if not lower <= settings.mu <= upper:
        return "leaves the inner four fifths of the certified interval"
    law = settings.make_law()
    if not isinstance(law, HomogeneousPid):
        raise GainError("only the homogeneous law has a degree")
    multiplier = law.norm_floor**settings.mu
    if not _SLOWEST <= multiplier <= _FASTEST:
        return f"multiplies the bandwidth by {multiplier:.2f} at the norm's floor"
    margin = sampling_margin(
        settings.gains, settings.control_period, max(multiplier, 1.0), inertia
    )
    if margin > GOOD_SAMPLING_MARGIN and settings.mu < 0.0:
        return f"brings T kd lam / m to {margin:.2f}, above {GOOD_SAMPLING_MARGIN}"
    return ""
