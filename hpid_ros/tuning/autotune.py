"""From what a relay test tells of a joint to SIMC gains and the homogeneous PID with them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.tuning.rules import simc
from hpid_ros.tuning.upgrade import Upgrade, upgrade

_DIGITS = 4
_PATIENCE = 4.0  # delays: SIMC's own choice is one, for a joint without resonances


class Autotuned(NamedTuple):
    """Proposed gains, and the loop that has them."""

    pid: LoopSettings  # the linear loop
    upgrade: Upgrade  # the homogeneous one
    delay: float  # [s] effective delay that they are for
    closed_loop_time: float  # [s]


def effective_delay(settings: LoopSettings, delay: float) -> float:
    """Return the delay that a rule should count: of the joint, the velocity and the sampling.

    Half a period of the hold, and the time constant of a first-order lag, count as delays.
    Source: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
    Journal of Process Control 13 (2003) 291-309, section 2, the half rule.
    """
    velocity = settings.velocity
    filtered = velocity.filter_time_constant if velocity.source == "filtered" else 0.0
    return delay + filtered + 0.5 * settings.timing.control_period


def autotuned(
    settings: LoopSettings,
    inertia: tuple[float, float],
    delay: float,
    closed_loop_time: float | None,
    goal: str,
) -> Autotuned:
    """Return SIMC gains for a joint, and the homogeneous PID with them."""
    if settings.model.is_decoupling:
        raise SettingError(
            "compensation decoupling has gains of a unit inertia: hpid gains designs them"
        )
    middle = float(f"{0.5 * (inertia[0] + inertia[1]):.3g}")
    effective = effective_delay(settings, delay)
    time = _PATIENCE * effective if closed_loop_time is None else closed_loop_time
    exact = simc(middle, time, effective)
    gains = Gains(*(float(f"{each:.{_DIGITS}g}") for each in (exact.p, exact.i, exact.d)))
    pid = replace(settings, law="pid", mu=0.0, gains=gains, inertia=middle)
    found = upgrade(pid, inertia, goal)
    why = (
        f"SIMC, closed-loop time {time:.3g} s, delay {effective:.3g} s, inertia {middle:g} kg m^2"
    )
    reasons = {**found.reasons, **dict.fromkeys(("gains.p", "gains.i", "gains.d"), why)}
    reasons["inertia"] = "identified from a relay test"
    return Autotuned(pid, replace(found, reasons=reasons), effective, time)
