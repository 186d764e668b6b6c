r"""A joint by a relay's limit cycle: ultimate gain and period, inertia, damping; gains by SIMC.

Over whole cycles the first harmonics U of the effort and Y of the position are

.. math:: U / Y = -m \omega^2 + j b \omega

of the joint :math:`m \ddot q + b \dot q`. The describing function of a relay of amplitude a with
hysteresis h on :math:`s = e + T \dot e`, whose amplitude is A,

.. math:: N = \frac{4 a}{\pi A^2} \left(\sqrt{A^2 - h^2} - j h\right)

says the same without the recorded effort, :math:`U / Y = -N (1 + j T \omega)`, as far as the joint
filters the higher harmonics; where the two differ, it does not, or a limit was in the way.

Sources: K. J. Astrom and T. Hagglund, "Automatic tuning of simple regulators with specifications
on phase and amplitude margins", Automatica 20 (1984) 645-651; A. Gelb and W. E. Vander Velde,
"Multiple-Input Describing Functions and Nonlinear System Design" (McGraw-Hill, 1968), tables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.gain_design import simc
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.upgrade import Upgrade, upgrade
from hpid_ros.base.errors import SettingError
from hpid_ros.base.rounding import significant
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.settings import LoopSettings

_SWITCH = 1.5  # amplitudes: a switch at full weight is of two
_LEAST_CYCLES = 3
_LEAST_SAMPLES = 8  # in a cycle


@dataclass(frozen=True)
class RelayCycle:
    """A limit cycle."""

    cycles: int  # whole cycles that were used
    period: float  # [s] ultimate period
    spread: float  # standard deviation of the periods over their mean
    amplitude: float  # [rad] of the position's first harmonic
    ultimate_gain: float  # [N m/rad] |N|, of the gain on s at which the loop oscillates
    inertia: float  # [kg m^2] by the first harmonics
    damping: float  # [N m s/rad]
    described_inertia: float  # [kg m^2] the inertia by the describing function


def relay_cycle(
    record: JointRecord, amplitude: float, hysteresis: float, lead: float
) -> RelayCycle:
    """Return the limit cycle in a recording."""
    steps = np.diff(record.effort)
    ups = record.effort_time[1:][steps > _SWITCH * amplitude]
    if len(ups) < _LEAST_CYCLES + 2:
        raise SettingError(
            f"the relay switched {len(ups)} times upwards, {_LEAST_CYCLES + 2} are needed: there "
            f"was no limit cycle"
        )
    ups = ups[1:]  # the first cycle is not yet the one that stays
    begin, end, cycles = float(ups[0]), float(ups[-1]), len(ups) - 1
    period = (end - begin) / cycles
    if period < _LEAST_SAMPLES * record.period:
        raise SettingError(
            f"a cycle of {period:.3g} s has fewer than {_LEAST_SAMPLES} samples of "
            f"{record.period:.3g} s: a larger hysteresis makes it longer"
        )
    rate = 2.0 * math.pi / period
    effort = _held_harmonic(record.effort_time, record.effort, begin, end, rate)
    position = _sampled_harmonic(record.time, record.position, begin, end, rate)
    ratio = effort / position
    size = abs(position)
    leading = max(size * math.hypot(1.0, lead * rate), hysteresis)
    scale = 4.0 * amplitude / (math.pi * leading**2)
    in_phase = math.sqrt(leading**2 - hysteresis**2)
    return RelayCycle(
        cycles,
        period,
        float(np.std(np.diff(ups))) / period,
        size,
        scale * leading,
        -ratio.real / rate**2,
        ratio.imag / rate,
        scale * (in_phase + lead * rate * hysteresis) / rate**2,
    )


def _held_harmonic(
    time: Numbers, values: Numbers, begin: float, end: float, rate: float
) -> complex:
    """Return the first harmonic of what is held from each time on, over [begin, end]; exact."""
    edges = np.clip(np.append(time, end), begin, end)
    turns = np.exp(-1j * rate * (edges - begin))
    return complex(2.0 / (end - begin) * np.sum(values * np.diff(turns)) * 1j / rate)


def _sampled_harmonic(
    time: Numbers, values: Numbers, begin: float, end: float, rate: float
) -> complex:
    """Return the same of samples of something smooth."""
    inside = time[(time > begin) & (time < end)]
    at = np.concatenate([[begin], inside, [end]])
    there = np.interp(at, time, values)
    waves = (there - np.mean(there)) * np.exp(-1j * rate * (at - begin))
    areas = 0.5 * (waves[1:] + waves[:-1]) * np.diff(at)
    return complex(2.0 / (end - begin) * np.sum(areas))


_DIGITS = 4
_PATIENCE = 4.0  # delays: SIMC's own choice is one, for a joint without resonances


class Autotuned(NamedTuple):
    """Proposed gains, and the loop that has them."""

    pid: LoopSettings  # the linear loop
    upgrade: Upgrade  # the homogeneous one
    delay: float  # [s] effective delay that they are for
    closed_loop_time: float  # [s]


def effective_delay(settings: LoopSettings, delay: float, *, has_velocities: bool = True) -> float:
    """Return the delay that a rule should count: of the joint, the velocity and the sampling.

    Half a period of the hold, and the time constant of a first-order lag, count as delays.
    Source: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
    Journal of Process Control 13 (2003) 291-309, section 2, the half rule.
    """
    velocity = settings.velocity
    is_filtered = velocity.velocity_source == "filtered" or (
        velocity.is_measured and not has_velocities
    )
    filter_time = velocity.velocity_filter_time_constant if is_filtered else 0.0
    return delay + filter_time + 0.5 * settings.timing.control_period


def autotuned(
    settings: LoopSettings,
    inertia: tuple[float, float],
    delay: float,
    closed_loop_time: float | None,
    goal: str,
    *,
    has_velocities: bool = True,
) -> Autotuned:
    """Return SIMC gains for a joint, and the homogeneous PID with them."""
    if settings.model.is_decoupling:
        raise SettingError(
            "compensation decoupling has gains of a unit inertia: hpid gains designs them"
        )
    middle = significant(0.5 * (inertia[0] + inertia[1]), 3)
    effective = effective_delay(settings, delay, has_velocities=has_velocities)
    time = _PATIENCE * effective if closed_loop_time is None else closed_loop_time
    exact = simc(middle, time, effective)
    gains = Gains(*(significant(each, _DIGITS) for each in (exact.p, exact.i, exact.d)))
    pid = replace(settings, law="pid", mu=0.0, gains=gains, inertia=middle)
    found = upgrade(pid, inertia, goal)
    why = (
        f"SIMC, closed-loop time {time:.3g} s, delay {effective:.3g} s, inertia {middle:g} kg m^2"
    )
    reasons = {**found.reasons, **dict.fromkeys(("gains.p", "gains.i", "gains.d"), why)}
    reasons["inertia"] = "identified from a relay test"
    return Autotuned(pid, replace(found, reasons=reasons), effective, time)
