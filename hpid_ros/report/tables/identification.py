"""What a robot's joints were found to be, as a person and as a program reads it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.text import Text

from hpid_ros.base.foreign_text import shown
from hpid_ros.identification.experiment_text import MovedInertia, unit
from hpid_ros.identification.results import (
    COULOMB,
    DELAY,
    EFFORT_SCALE,
    GRAVITY_COS,
    GRAVITY_SIN,
    INERTIA,
    OFFSET,
    PARAMETERS,
    STRIBECK,
    VISCOUS,
    Estimate,
    JointIdentification,
)
from hpid_ros.report.tables.wide_table import TableColumn, WideTable

_MILLISECONDS = 1e3
_NONE = "–"
_OF_SLIDES = "kg, N s/m and N, where joints that turn have kg m², N m s/rad and N m"


def report(
    found: Sequence[JointIdentification],
    sources: Mapping[str, str],
    slides: Sequence[str],
    moved: Mapping[str, MovedInertia],
    missing: Sequence[str] = (),
) -> Iterator[WideTable | Text | str]:
    """Yield what to print."""
    has_robot = bool(moved) or any(EFFORT_SCALE in each.estimates for each in found)
    yield _table(found, moved, has_robot)
    yield Text(_caption(has_robot), style="dim")
    if slides:
        yield f"{', '.join(map(shown, slides))}: {_OF_SLIDES}"
    used = {each.joint: sources.get(each.joint, "") for each in found}
    for source in dict.fromkeys(used.values()):
        names = [name for name, of in used.items() if of == source]
        whose = "" if len(names) == len(used) else f" of {', '.join(map(shown, names))}"
        yield f"efforts{whose}: {shown(source)}"
    for line in missing:
        yield Text(f"! {shown(line)}", style="yellow")
    for each in found:
        yield ""
        yield from _of_joint(each, each.joint in slides)


def _caption(has_robot: bool) -> str:
    inertia = (
        "rotor: reflected inertia that the links do not have; moves: 1 / (M⁻¹)ⱼⱼ over the motion, "
        "links and rotor"
        if has_robot
        else "inertia: with the other joints at rest"
    )
    return (
        f"SI units, delay in ms; ±: half of the 95 % interval; in brackets: not told. {inertia}. "
        "fit: share of the effort's variance."
    )


def _table(
    found: Sequence[JointIdentification], moved: Mapping[str, MovedInertia], has_robot: bool
) -> WideTable:
    inertia = "rotor" if has_robot else "inertia"
    columns = [TableColumn(inertia, [_cell(each, INERTIA) for each in found])]
    if has_robot:
        columns.append(TableColumn("moves", [_range(moved.get(each.joint)) for each in found]))
    columns += [
        TableColumn("viscous", [_cell(each, VISCOUS) for each in found]),
        TableColumn("Coulomb", [_cell(each, COULOMB) for each in found]),
        TableColumn("load", [_cell(each, OFFSET) for each in found]),
        TableColumn("delay", [_cell(each, DELAY, _MILLISECONDS) for each in found]),
        TableColumn("fit", [_percent(each) for each in found]),
    ]
    names = TableColumn("joint", [shown(each.joint) for each in found], is_text=True)
    return WideTable([names], columns)


def _percent(each: JointIdentification) -> str:
    return f"{math.floor(each.explained * 1000.0) / 10.0:.1f} %" if each.rows else _NONE


def _range(moved: MovedInertia | None) -> str:
    return _NONE if moved is None else f"{moved.least:.3g} … {moved.largest:.3g}"


def _cell(each: JointIdentification, name: str, factor: float = 1.0) -> str:
    estimate = each.estimates.get(name)
    if estimate is None:
        return _NONE
    return _plain(estimate, factor)


def with_interval(value: float, half_width: float) -> str:
    """Return a number and half of its interval, with as many decimals as that has to say."""
    if not math.isfinite(half_width) or half_width <= 0.0:
        return f"{value:.3g} ±{half_width:.2g}"
    decimals = 1 - math.floor(math.log10(half_width))
    if not -3 <= decimals <= 6:
        return f"{value:.3g} ±{half_width:.1e}"
    decimals = max(decimals, 0)
    return f"{value:.{decimals}f} ±{half_width:.{decimals}f}"


def _of_joint(each: JointIdentification, is_slide: bool) -> Iterator[str]:
    name = shown(each.joint)
    if each.rows:
        yield (
            f"{name}: {each.time:.1f} s used, {_angle(each.travel, is_slide)} travelled, up to "
            f"{each.speed:.2g} {_length(is_slide)}/s and {each.acceleration:.2g} "
            f"{_length(is_slide)}/s²; low pass {each.cutoff:g} Hz; {each.why}"
        )
    else:
        yield f"{name}:"
    yield from (f"  {shown(line)}" for line in each.remarks)
    yield from (f"  {line}" for line in _further(each, is_slide))
    for reason in dict.fromkeys(each.untold.values()):
        names = [name for name, why in each.untold.items() if why == reason]
        if names == [each.joint]:
            yield f"  nothing found: {reason}"
        else:
            yield f"  {', '.join(map(_words, names))} not told: {reason}"


def _further(each: JointIdentification, is_slide: bool) -> Iterator[str]:
    estimates, length = each.estimates, _length(is_slide)
    sine, cosine = estimates.get(GRAVITY_SIN), estimates.get(GRAVITY_COS)
    if sine is not None and cosine is not None:
        yield (
            f"gravity: ({_plain(sine)}) sin q + ({_plain(cosine)}) cos q "
            f"[{unit(GRAVITY_SIN, is_slide)}]"
        )
    if STRIBECK in estimates:
        yield (
            f"Stribeck: {_plain(estimates[STRIBECK])} {unit(STRIBECK, is_slide)} more when "
            f"creeping, gone by 1/e at {each.stribeck_speed:.2g} {length}/s"
        )
    if EFFORT_SCALE in estimates:
        yield f"effort: {_plain(estimates[EFFORT_SCALE])} {unit(COULOMB, is_slide)} a unit"
    if each.rows:
        yield (
            f"residual {each.residual:.3g} {unit(COULOMB, is_slide)} rms; condition number of the "
            f"scaled columns {each.condition:.3g}"
        )


def _plain(estimate: Estimate, factor: float = 1.0) -> str:
    text = with_interval(factor * estimate.value, factor * estimate.half_width)
    return text if estimate.is_told else f"({text})"


def _words(name: str) -> str:
    return {GRAVITY_SIN: "gravity", OFFSET: "load", EFFORT_SCALE: "effort scale"}.get(name, name)


def _length(is_slide: bool) -> str:
    return "m" if is_slide else "rad"


def _angle(value: float, is_slide: bool) -> str:
    return f"{value:.2g} {_length(is_slide)}"


def as_mapping(
    found: Sequence[JointIdentification],
    sources: Mapping[str, str],
    slides: Sequence[str],
    moved: Mapping[str, MovedInertia],
) -> dict[str, Any]:
    """Return everything as JSON has it, by joint."""
    facts = (
        *("method", "why", "cutoff", "rows", "time", "stribeck_speed", "residual", "explained"),
        *("condition", "travel", "speed", "acceleration"),
    )
    document = {}
    for each in found:
        is_slide = each.joint in slides
        document[each.joint] = {
            "estimates": {
                name: {
                    **asdict(estimate),
                    "low": estimate.low,
                    "high": estimate.high,
                    "unit": PARAMETERS[name][int(is_slide)],
                }
                for name, estimate in each.estimates.items()
            },
            "moved_inertia": moved[each.joint]._asdict() if each.joint in moved else None,
            "not_told": dict(each.untold),
            "remarks": list(each.remarks),
            "effort": sources.get(each.joint, ""),
            **{name: getattr(each, name) for name in facts},
        }
    return document
