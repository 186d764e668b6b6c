"""Findings as the part of an experiment file that says them: YAML, a reason for each number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from hpid_ros.base.text import shown
from hpid_ros.tuning.identification_results import (
    COULOMB,
    INERTIA,
    PARAMETERS,
    VISCOUS,
    Estimate,
    JointIdentification,
)

_DIGITS = 4
_RATIO = 100.0
"""Where nobody knows it: with a gear of 1 a rotor as heavy as what it stands for would push back
as heavily on the link that carries it."""


class MovedInertia(NamedTuple):
    """What a joint's motor moves, over the poses of a recording, in [kg m^2]; [kg] of a slide."""

    least: float  # of all poses
    mean: float  # over the poses
    largest: float  # of all poses


class Origin(NamedTuple):
    """Where a file's robot is from."""

    key: str  # extends for an experiment file, description for a URDF
    file: str  # as the file names it


def experiment_text(
    found: Sequence[JointIdentification],
    moved: Mapping[str, MovedInertia],
    slides: Sequence[str],
    ratios: Mapping[str, float],
    origin: Origin | None,
    header: Sequence[str],
) -> str:
    """Return a file that experiments extend.

    Without a robot there are no amendments of its rotors: the inertia found has the links in it.
    """
    lines = [f"# {shown(line)}" for line in header]
    if origin is not None and origin.key == "extends":
        lines.append(f"extends: {_quoted(origin.file)}")
    lines.append("robot:")
    if origin is not None and origin.key == "description":
        lines += [f"  description: {_quoted(origin.file)}", "  fixed_base: true"]
    amended = [line for each in found for line in _amendment(each, slides, ratios, origin)]
    lines += ["  joints:", *amended] if amended else ["  joints: {}"]
    known = [line for each in found for line in _inertia(each, moved.get(each.joint), slides)]
    lines += ["controllers:", "  joints:", *known] if known else []
    return "\n".join(lines) + "\n"


def _amendment(
    each: JointIdentification,
    slides: Sequence[str],
    ratios: Mapping[str, float],
    origin: Origin | None,
) -> Iterator[str]:
    names = {INERTIA: "rotor_inertia"} if origin is not None else {}
    names |= {VISCOUS: "damping", COULOMB: "friction"}
    ratio = ratios.get(each.joint, 1.0)
    ratio, whose = (ratio, "as before") if abs(ratio) != 1.0 else (_RATIO, "made up")
    entries, notes = [], []
    for name, key in names.items():
        estimate = each.estimates.get(name)
        if estimate is not None and estimate.is_told:
            reason = interval(estimate, unit(name, each.joint in slides))
            if key == "rotor_inertia":
                entries.append(f"gear_ratio: {_number(ratio)}  # {whose}; only Jr N^2 is known")
                reason = f"Jr N^2 {_number(estimate.value)} {reason}"
            value = estimate.value / (ratio**2 if key == "rotor_inertia" else 1.0)
            entries.append(f"{key}: {_number(value)}  # {reason}")
        else:
            why = each.untold.get(name) or each.untold.get(each.joint) or "not looked for"
            notes.append(f"# {key} is not told: {_one_line(why)}")
    if entries:
        yield f"    {_quoted(each.joint)}:"
        yield from (f"      # {_one_line(remark)}" for remark in each.remarks)
        yield from (f"      {line}" for line in (*entries, *notes))
    else:
        yield from (f"    # {_one_line(each.joint)}: {line[2:]}" for line in notes[:1])


def _inertia(
    each: JointIdentification, moved: MovedInertia | None, slides: Sequence[str]
) -> Iterator[str]:
    estimate = each.told(INERTIA)
    kind = unit(INERTIA, each.joint in slides)
    if moved is not None and estimate is not None:
        value = moved.mean
        reason = (
            f"[{kind}], from {_number(moved.least)} to {_number(moved.largest)} along the motion, "
            "other joints free; links and rotor"
        )
    elif estimate is not None:
        value, reason = estimate.value, f"{interval(estimate, kind)}, other joints at rest"
    else:
        return
    yield f"    {_quoted(each.joint)}: {{inertia: {_number(value)}}}  # {reason}"


def unit(name: str, is_slide: bool) -> str:
    """Return the unit of a parameter."""
    return PARAMETERS[name][int(is_slide)]


def interval(estimate: Estimate, of: str) -> str:
    """Return an interval in words."""
    return f"[{of}], 95 %: {_number(estimate.low)} to {_number(estimate.high)}"


def _number(value: float) -> str:
    """Return a number that YAML takes for one: 1e-05 would be a text."""
    text = f"{value:.{_DIGITS}g}"
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if mark else text


def _quoted(text: str) -> str:
    plain = text.replace("_", "").replace("-", "")
    if plain.isascii() and plain.isalnum() and plain[:1].isalpha() and text.lower() not in _WORDS:
        return text
    return '"' + _one_line(text).replace("\\", "\\\\").replace('"', '\\"') + '"'


_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}


def _one_line(text: str) -> str:
    return " ".join(text.split())
