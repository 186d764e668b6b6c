"""Gains of a rule for several joints, with what can be said of them, as part of a YAML file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.certificate import DegreeInterval
from hpid_ros.errors import GainError, SettingError, unknown_name
from hpid_ros.tuning.certified_degrees import Loop, certified_degrees
from hpid_ros.tuning.margins import Margins, loop_margins
from hpid_ros.tuning.rules import RULES

_INERTIA_DIGITS, _GAIN_DIGITS = 3, 6


@dataclass(frozen=True)
class DesignedGains:
    """One joint's gains by a rule.

    Attributes:
        joint: The joint.
        inertia: What one unit of effort accelerates, in [kg m^2], to three digits.
        gains: The rule's gains on exactly that inertia, to six digits.
        margins: Of the loop with delay and velocity filter; None if it is unstable.
        interval: Certified degrees at the loop's norm; None if there are none.
        reason: Why it is unstable or not certified; empty if it is certified at its degree.
    """

    joint: str
    inertia: float
    gains: Gains
    margins: Margins | None
    interval: tuple[float, float] | None
    reason: str


def design(
    loops: Mapping[str, LoopSettings],
    inertias: Mapping[str, float],
    rule: str,
    closed_loop_time: float,
    delay: float,
    tell: Callable[[Sequence[str]], None] = lambda joints: None,
) -> dict[str, DesignedGains]:
    """Return the joints' gains by a rule, judged.

    Args:
        loops: By joint: its degree, norm and velocity filter are judged with.
        inertias: What one unit of effort accelerates, in [kg m^2], by joint.
        rule: Name of the rule in :data:`~hpid_ros.tuning.rules.RULES`.
        closed_loop_time: In [s].
        delay: Of the loop, in [s].
        tell: Called with the joints whose degrees have been certified.

    Raises:
        SettingError: There is no such rule, or a number is impossible.
        RunError: A process died.
    """
    if rule not in RULES:
        raise SettingError(unknown_name("rule", rule, RULES))
    judged: list[Loop] = []
    for joint, settings in loops.items():
        inertia = _rounded(inertias[joint], _INERTIA_DIGITS)
        exact = RULES[rule](inertia, closed_loop_time, delay)
        gains = Gains(*(_rounded(each, _GAIN_DIGITS) for each in (exact.p, exact.i, exact.d)))
        # The settings may hold other gains, which go with another inertia.
        judged.append((replace(settings, gains=gains, inertia=inertia), (inertia, inertia)))
    found = certified_degrees(judged, tell)
    return {
        joint: _designed(*loop, each, delay)
        for joint, loop, each in zip(loops, judged, found, strict=True)
    }


def _designed(
    settings: LoopSettings,
    inertia: tuple[float, float],
    found: DegreeInterval | GainError,
    delay: float,
) -> DesignedGains:
    is_filtered = settings.velocity_source == "filtered"
    filter_time = settings.velocity_filter_time_constant if is_filtered else 0.0
    margins, interval, reason = None, None, ""
    try:
        margins = loop_margins(settings.gains, inertia[0], delay=delay, filter_time=filter_time)
    except GainError as error:
        reason = str(error)
    if isinstance(found, GainError):
        reason = reason or str(found)
    else:
        interval = found.lower, found.upper
        if settings.law == "hpid" and not found.contains(settings.mu):
            reason = reason or f"mu = {settings.mu:g} is outside the certified interval"
    return DesignedGains(settings.joint, inertia[0], settings.gains, margins, interval, reason)


def yaml_text(designs: Mapping[str, DesignedGains], head: str) -> str:
    """Return the gains as ``controllers.joints`` of an experiment file, verdicts as comments.

    Args:
        designs: By the joint's name.
        head: What the first comment says.
    """
    rows = {joint: _row(each) for joint, each in designs.items()}
    width = max(len(joint) + len(row) for joint, row in rows.items())
    lines = [f"# {head}", "controllers:", "  joints:"]
    for joint, row in rows.items():
        padding = " " * (width - len(joint) - len(row))
        lines.append(f"    {joint}: {row}{padding}  # {verdict_text(designs[joint])}")
    return "\n".join(lines) + "\n"


def verdict_text(design: DesignedGains) -> str:
    """Return in a few words what is known of a joint's gains."""
    if design.interval is None:
        certified = "not certified"
    else:
        certified = "certified for mu in ({:+.2f}, {:+.2f})".format(*design.interval)
    words = [certified]
    if design.margins is not None:
        each = design.margins
        words += [
            f"GM {each.gain_reduction:.2f}..{each.gain:.3g}",
            f"PM {math.degrees(each.phase):.0f} deg",
            f"delay margin {1e3 * each.delay:.3g} ms",
            f"Ms {each.sensitivity:.2f}",
        ]
    if design.reason:
        words.append(design.reason)
    return ", ".join(words)


def _row(design: DesignedGains) -> str:
    gains = ", ".join(f"{name}: {number_text(getattr(design.gains, name))}" for name in "pid")
    return f"{{gains: {{{gains}}}, inertia: {number_text(design.inertia)}}}"


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def number_text(value: float) -> str:
    """Return a number to six digits, as YAML reads it as one: with a point."""
    text = f"{value:.{_GAIN_DIGITS}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    return text if "." in text else f"{text}.0"
