"""Gains of published rules for one joint and for several, with their margins.

The rules' joint is the double integrator of the theory, m s^2, driven by the parallel PID that
this package has, u = p e + i integral of e + d de/dt; the margins are those of the loop as it
runs (:mod:`hpid_ros.stability.margins`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from hpid_bench.report.margin_text import (
    delay_margin_text,
    gain_margin_text,
    phase_margin_text,
    sensitivity_text,
)
from hpid_ros.base.errors import GainError, SettingError, unknown_name
from hpid_ros.base.rounding import significant
from hpid_ros.base.yaml_text import inline_yaml
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.settings import LoopSettings
from hpid_ros.stability.closed_loop import Certificate
from hpid_ros.stability.gain_check import Loop, certified_degrees
from hpid_ros.stability.margins import LoopFamily, Margins, margins_of


def simc(inertia: float, closed_loop_time: float, delay: float = 0.0) -> Gains:
    r"""Return the SIMC tuning of a double integrating process with delay, in parallel form.

    .. math::
        K_c = \frac{1}{k''} \frac{1}{4 (\tau_c + \theta)^2}, \qquad
        \tau_I = \tau_D = 4 (\tau_c + \theta)

    with :math:`k'' = 1/m` in series form, K_c (1 + 1 / (tau_I s)) (tau_D s + 1). In parallel form,
    with T = tau_c + theta: p = m / (2 T^2), i = m / (16 T^3), d = m / T.

    Source: S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
    Journal of Process Control 13 (2003) 291-309, Table 1, row "Double integrating", and the
    section on the ideal form.
    """
    time = 4.0 * _checked(inertia, closed_loop_time, delay)
    gain = 4.0 * inertia / time**2
    return Gains(p=2.0 * gain, i=gain / time, d=gain * time)


def pole_placement(inertia: float, closed_loop_time: float, delay: float = 0.0) -> Gains:
    """Return gains that put all three poles of m s^3 + d s^2 + p s + i in one place.

    The poles lie at -w, w = 1 / (closed_loop_time + delay): p = 3 w^2 m, i = w^3 m, d = 3 w m.
    The delay is counted as a slower loop, as SIMC does; the poles are those without it.

    Source: K. J. Astrom and T. Hagglund, "Advanced PID Control" (ISA, 2006), pole placement by
    comparing the coefficients of the characteristic polynomial.
    """
    rate = 1.0 / _checked(inertia, closed_loop_time, delay)
    return Gains(p=3.0 * rate**2 * inertia, i=rate**3 * inertia, d=3.0 * rate * inertia)


Rule = Callable[[float, float, float], Gains]

RULES: Mapping[str, Rule] = {"simc": simc, "pole-placement": pole_placement}
"""The rules by name: gains of inertia [kg m^2], closed-loop time [s] and delay [s]."""


def _checked(inertia: float, closed_loop_time: float, delay: float) -> float:
    """Return the sum of the times, of numbers that are allowed."""
    named = {"inertia": inertia, "closed-loop time": closed_loop_time}
    for name, value in named.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SettingError(f"the {name} must be positive and finite, not {value}")
    if not (math.isfinite(delay) and delay >= 0.0):
        raise SettingError(f"the delay must be finite and not negative, not {delay} s")
    return closed_loop_time + delay


_LARGEST_STUCK_ERROR = 0.1  # [rad], of a joint that friction holds
_INERTIA_DIGITS, _GAIN_DIGITS = 3, 6


@dataclass(frozen=True)
class DesignedGains:
    """One joint's gains by a rule."""

    inertia: float  # [kg m^2] what one unit of effort accelerates, to three digits
    gains: Gains  # the rule's gains on exactly that inertia, to six digits
    margins: Margins | None  # of the sampled and held loop, as a linear PID
    interval: tuple[float, float] | None  # certified degrees at the loop's norm
    reason: str  # why it is unstable or not certified; empty if it is certified at its degree


def design(
    loops: Mapping[str, LoopSettings],
    inertias: Mapping[str, float],
    rule: str,
    closed_loop_time: float,
    delay: float,
    family: Callable[[LoopSettings, tuple[float, float]], LoopFamily],
    progress: Callable[[Sequence[str]], None] = lambda joints: None,
) -> dict[str, DesignedGains]:
    """Return the joints' gains by a rule, judged.

    ``family`` makes the loop whose margins are told, of its settings and its joint's inertia.
    """
    if rule not in RULES:
        raise SettingError(unknown_name("rule", rule, RULES))
    judged: list[Loop] = []
    for joint, settings in loops.items():
        inertia = significant(inertias[joint], _INERTIA_DIGITS)
        exact = RULES[rule](inertia, closed_loop_time, delay)
        gains = Gains(*(significant(each, _GAIN_DIGITS) for each in (exact.p, exact.i, exact.d)))
        # The settings may hold other gains, which go with another inertia.
        judged.append((replace(settings, gains=gains, inertia=inertia), (inertia, inertia)))
    found = certified_degrees(judged, progress)
    return {
        joint: _designed(*loop, each, family)
        for joint, loop, each in zip(loops, judged, found, strict=True)
    }


def _designed(
    settings: LoopSettings,
    inertia: tuple[float, float],
    found: Certificate | GainError,
    family: Callable[[LoopSettings, tuple[float, float]], LoopFamily],
) -> DesignedGains:
    margins, interval, reason = None, None, ""
    try:
        margins = margins_of(family(settings, inertia).loop(inertia[0]))
    except (GainError, SettingError) as error:
        reason = str(error)
    if isinstance(found, GainError):
        reason = reason or str(found)
    else:
        interval = found.lower, found.upper
        if settings.is_homogeneous and not found.contains(settings.mu):
            reason = reason or f"mu = {settings.mu:g} is outside the certified interval"
    return DesignedGains(inertia[0], settings.gains, margins, interval, reason)


def yaml_text(designs: Mapping[str, DesignedGains], head: str) -> str:
    """Return the gains as ``controllers.joints`` of an experiment file, verdicts as comments."""
    rows = {}
    for joint, each in designs.items():
        gains = ", ".join(f"{name}: {number_text(getattr(each.gains, name))}" for name in "pid")
        row = f"{inline_yaml(joint)}: {{gains: {{{gains}}}, inertia: {number_text(each.inertia)}}}"
        rows[joint] = row
    width = max(map(len, rows.values()))
    lines = [f"# {head}", "controllers:", "  joints:"]
    for joint, row in rows.items():
        lines.append(f"    {row:<{width}}  # {verdict_text(designs[joint])}")
    return "\n".join(lines) + "\n"


def held_by_friction(joint: str, p: float, friction: float) -> str:
    """Return one line if friction alone holds a joint far from its reference; else nothing."""
    error = friction / p if p > 0.0 else 0.0
    if error <= _LARGEST_STUCK_ERROR:
        return ""
    return (
        f"{joint}: its friction of {friction:g} N m holds it up to {error:.2g} rad off "
        f"(friction / p); from there the integral alone moves it: raise the gains, or give its "
        f"rotor_inertia first"
    )


def verdict_text(design: DesignedGains) -> str:
    """Return in a few words what is known of a joint's gains."""
    words = ["not certified"]
    if design.interval is not None:
        words = ["certified for mu in ({:+.2f}, {:+.2f})".format(*design.interval)]
    if design.margins is not None:
        each = design.margins
        words += [
            f"GM {gain_margin_text(each)} dB",
            f"PM {phase_margin_text(each)} deg",
            f"DM {delay_margin_text(each)} ms",
            f"Ms {sensitivity_text(each)}",
        ]
    if design.reason:
        words.append(design.reason)
    return ", ".join(words)


def number_text(value: float) -> str:
    """Return a number to six digits, as YAML reads it as one: with a point."""
    mantissa, mark, exponent = f"{value:.{_GAIN_DIGITS}g}".partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{mark}{exponent}"
