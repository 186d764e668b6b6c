"""What was identified as tables, figures, JSON and as a part of an experiment file."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.text import Text

from hpid_bench.report.figures import INK, REFERENCE_COLOR, RUN_STYLES
from hpid_bench.report.plots import (
    DOTS_PER_INCH,
    WIDTH_IN,
    add_legend,
    figure_style,
    laid_out,
    plain_ticks,
)
from hpid_bench.report.table import TableColumn, WideTable
from hpid_bench.tuning.identification.joint_identification import Fit, JointIdentification
from hpid_bench.tuning.identification.regression import (
    COULOMB,
    DELAY,
    EFFORT_SCALE,
    ESTIMATED_PARAMETERS,
    GRAVITY_COS,
    GRAVITY_SIN,
    INERTIA,
    OFFSET,
    STRIBECK,
    VISCOUS,
    Estimate,
)
from hpid_bench.tuning.identification.robot_identification import MovedInertia, RobotIdentification
from hpid_ros.base.text import figure_text, shown
from hpid_ros.base.units import Numbers
from hpid_ros.metrics.texts import UNDEFINED
from hpid_ros.motion.excitation import ExcitationPlan

_DIGITS = 4
_RATIO = 100.0
"""Where nobody knows it: with a gear of 1 a rotor as heavy as what it stands for would push back
as heavily on the link that carries it."""


def experiment_text(
    found: RobotIdentification,
    ratios: Mapping[str, float],
    origin: tuple[str, str] | None,
    header: Sequence[str],
) -> str:
    """Return a file that experiments extend.

    ``origin`` is the key (extends for an experiment file, description for a URDF) and the file
    of the robot. Without a robot there are no amendments of its rotors: the inertia found has the
    links in it.
    """
    lines = [f"# {shown(line)}" for line in header]
    key, file = origin or ("", "")
    if key == "extends":
        lines.append(f"extends: {_quoted(file)}")
    lines.append("robot:")
    if key == "description":
        lines += [f"  description: {_quoted(file)}", "  fixed_base: true"]
    amended, known = list[str](), list[str]()
    for each in found.joints:
        is_slide = each.joint in found.slides
        amended += _amendment(each, is_slide, ratios.get(each.joint, 1.0), origin is not None)
        known += _inertia(each, found.moved.get(each.joint), is_slide)
    lines += ["  joints:", *amended] if amended else ["  joints: {}"]
    lines += ["controllers:", "  joints:", *known] if known else []
    return "\n".join(lines) + "\n"


def _amendment(
    each: JointIdentification, is_slide: bool, ratio: float, has_robot: bool
) -> Iterator[str]:
    names = {INERTIA: "rotor_inertia"} if has_robot else {}
    names |= {VISCOUS: "damping", COULOMB: "friction"}
    ratio, whose = (ratio, "as before") if abs(ratio) != 1.0 else (_RATIO, "made up")
    entries, notes = [], []
    for name, key in names.items():
        estimate = each.reliable(name)
        if estimate is None:
            why = each.unreliable.get(name) or each.unreliable.get(each.joint) or "not looked for"
            notes.append(f"# {key} is not identified: {_one_line(why)}")
            continue
        value, reason = estimate.value, interval(estimate, unit(name, is_slide))
        if name == INERTIA:
            entries.append(f"gear_ratio: {_number(ratio)}  # {whose}; only Jr N^2 is known")
            value, reason = value / ratio**2, f"Jr N^2 {_number(value)} {reason}"
        entries.append(f"{key}: {_number(value)}  # {reason}")
    if entries:
        yield f"    {_quoted(each.joint)}:"
        yield from (f"      # {_one_line(remark)}" for remark in each.remarks)
        yield from (f"      {line}" for line in (*entries, *notes))
    else:
        yield from (f"    # {_one_line(each.joint)}: {line[2:]}" for line in notes[:1])


def _inertia(
    each: JointIdentification, moved: MovedInertia | None, is_slide: bool
) -> Iterator[str]:
    estimate, kind = each.reliable(INERTIA), unit(INERTIA, is_slide)
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
    return ESTIMATED_PARAMETERS[name][int(is_slide)]


def interval(estimate: Estimate, of: str) -> str:
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


_PLAN_ROW_HEIGHT_IN = 1.5
_REFERENCE, _LIMIT = RUN_STYLES[0].color, RUN_STYLES[1].color
_NEAR = 3.0  # a limit further away than so many times the motion is not drawn


@figure_style()
def excitation_figure(plan: ExcitationPlan) -> Figure:
    """Return a row for each joint: its position and its velocity, with limits that are near."""
    count = len(plan.joints)
    figure = Figure(figsize=(WIDTH_IN, _PLAN_ROW_HEIGHT_IN * count + 1.0), dpi=DOTS_PER_INCH)
    grid = figure.subplots(count, 2, squeeze=False, sharex=True)
    for number, ((left, right), planned) in enumerate(zip(grid, plan.joints, strict=True)):
        bounds, at = planned.bounds, plan.positions[:, number]
        left.set_title(figure_text(bounds.joint))
        _draw_planned(left, plan.times, at + bounds.position, (bounds.lower, bounds.upper))
        stop = planned.velocity_stop
        _draw_planned(right, plan.times, plan.velocities[:, number], (-stop, stop))
        left.set_ylabel(f"position [{bounds.unit}]")
        right.set_ylabel(f"velocity [{bounds.unit}/s]")
    for panel in grid[-1]:
        panel.set_xlabel("time [s]")
    handles = [
        Line2D([], [], color=_REFERENCE, linewidth=1.3, label="reference"),
        Line2D([], [], color=_LIMIT, linewidth=1.3, dashes=(7.0, 1.8), label="stopped beyond"),
    ]
    add_legend(figure, handles)
    return laid_out(figure)


def _draw_planned(
    panel: Axes, times: Numbers, values: Numbers, limits: tuple[float, float]
) -> None:
    panel.plot(times, values, color=_REFERENCE, linewidth=0.9)
    span = float(np.ptp(values)) or 1.0
    middle = 0.5 * float(np.max(values) + np.min(values))
    for limit in limits:
        if math.isfinite(limit) and abs(limit - middle) < _NEAR * span:
            panel.axhline(limit, color=_LIMIT, linewidth=1.0, dashes=(7.0, 1.8))
    panel.spines["bottom"].set_color(INK)
    plain_ticks(panel.yaxis, 4)


_ROW_HEIGHT_IN = 2.0
_BARE_HEIGHT_IN = 0.5
_SHARES = (2.3, 1.0)
_MEASURED, _PREDICTED, _RESIDUAL = REFERENCE_COLOR, RUN_STYLES[0].color, RUN_STYLES[1].color
_LINE_LENGTH = 52  # characters of a reason


@figure_style()
def identification_figure(
    found: Sequence[JointIdentification], slides: Sequence[str] = ()
) -> Figure:
    """Return a row for each joint: its efforts, and beside them what its motion cannot tell."""
    heights = [_ROW_HEIGHT_IN if each.fit is not None else _BARE_HEIGHT_IN for each in found]
    figure = Figure(figsize=(WIDTH_IN, sum(heights) + 0.6), dpi=DOTS_PER_INCH)
    grid = figure.subplots(
        len(found), 2, squeeze=False, width_ratios=_SHARES, height_ratios=heights
    )
    for (left, right), each in zip(grid, found, strict=True):
        left.set_title(figure_text(each.joint))
        unit = "N" if each.joint in slides else "N m"
        if each.fit is None:
            left.set_axis_off()
        else:
            _draw(left, each.fit, unit)
        _write_remarks(right, each)
    drawn = [axes for axes, each in zip(grid[:, 0], found, strict=True) if each.fit is not None]
    if drawn:
        drawn[-1].set_xlabel("time [s]")
    handles = [
        Line2D([], [], color=_MEASURED, linewidth=3.0, label="measured"),
        Line2D([], [], color=_PREDICTED, linewidth=1.3, label="predicted"),
        Line2D([], [], color=_PREDICTED, linewidth=0.5, alpha=0.5, label="left out"),
        Line2D([], [], color=_RESIDUAL, linewidth=0.9, label="residual"),
    ]
    add_legend(figure, handles)
    return laid_out(figure)


def _draw(panel: Axes, fit: Fit, unit: str) -> None:
    time = _packed(fit.time)
    panel.plot(time, fit.measured, color=_MEASURED, linewidth=3.0)
    predicted = np.where(fit.is_used, fit.predicted, np.nan)
    panel.plot(time, fit.predicted, color=_PREDICTED, linewidth=0.5, alpha=0.5)
    panel.plot(time, predicted, color=_PREDICTED, linewidth=1.3)
    residual = np.where(fit.is_used, fit.measured - fit.predicted, np.nan)
    panel.plot(time, residual, color=_RESIDUAL, linewidth=0.9)
    panel.axhline(0.0, color=INK, linewidth=0.5)
    panel.set_ylabel(f"effort [{unit}]")
    plain_ticks(panel.yaxis, 4)
    plain_ticks(panel.xaxis, 8)


def _packed(time: Numbers) -> Numbers:
    """Return times in which what lies between two spans is no longer than a tenth of all."""
    known = time[np.isfinite(time)]
    if not len(known):
        return np.asarray(time)
    steps = np.diff(known)
    usual = float(np.median(steps))
    length = float(np.sum(steps[steps < 4.0 * usual]))
    cut = np.concatenate([[0.0], np.cumsum(np.maximum(steps - max(0.1 * length, usual), 0.0))])
    packed = np.array(time)
    packed[np.isfinite(time)] = known - cut
    return packed


def _write_remarks(panel: Axes, each: JointIdentification) -> None:
    panel.set_axis_off()
    lines = [line for remark in each.remarks for line in _wrapped(remark)]
    lines += [
        line
        for what, reason in each.unreliable.items()
        for line in _wrapped(reason if what == each.joint else f"{what}: {reason}")
    ]
    text = "\n".join(map(figure_text, lines or ["all parameters were identified"]))
    panel.text(0.0, 1.0, text, va="top", fontsize=7.5, transform=panel.transAxes)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _LINE_LENGTH, subsequent_indent="  ")


_MILLISECONDS = 1e3
_OF_SLIDES = "kg, N s/m and N, where joints that turn have kg m², N m s/rad and N m"


def report(found: RobotIdentification) -> Iterator[WideTable | Text | str]:
    """Yield what to print."""
    has_robot = bool(found.moved) or any(EFFORT_SCALE in each.estimates for each in found.joints)
    yield _table(found, has_robot)
    yield Text(_caption(has_robot), style="dim")
    if found.slides:
        yield f"{', '.join(map(shown, found.slides))}: {_OF_SLIDES}"
    used = {each.joint: found.sources.get(each.joint, "") for each in found.joints}
    for source in dict.fromkeys(used.values()):
        names = [name for name, of in used.items() if of == source]
        whose = "" if len(names) == len(used) else f" of {', '.join(map(shown, names))}"
        yield f"efforts{whose}: {shown(source)}"
    for line in found.missing:
        yield Text(f"! {shown(line)}", style="yellow")
    for each in found.joints:
        yield ""
        yield from _of_joint(each, each.joint in found.slides)


def _caption(has_robot: bool) -> str:
    inertia = (
        "rotor: reflected inertia that the links do not have; moves: 1 / (M⁻¹)ⱼⱼ over the motion, "
        "links and rotor"
        if has_robot
        else "inertia: with the other joints at rest"
    )
    return (
        f"SI units, delay in ms; ±: half of the 95 % interval; in brackets: not identified. "
        f"{inertia}. fit: share of the effort's variance."
    )


def _table(found: RobotIdentification, has_robot: bool) -> WideTable:
    joints = found.joints

    def estimates(heading: str, name: str, factor: float = 1.0) -> TableColumn:
        known = [each.estimates.get(name) for each in joints]
        return TableColumn(
            heading, [_plain(each, factor) if each else UNDEFINED for each in known]
        )

    columns = [estimates("rotor" if has_robot else "inertia", INERTIA)]
    if has_robot:
        moved = [found.moved.get(each.joint) for each in joints]
        ranges = [
            f"{each.least:.3g} … {each.largest:.3g}" if each else UNDEFINED for each in moved
        ]
        columns.append(TableColumn("moves", ranges))
    fits = [
        f"{math.floor(each.explained * 1000.0) / 10.0:.1f} %" if each.rows else UNDEFINED
        for each in joints
    ]
    columns += [
        estimates("viscous", VISCOUS),
        estimates("Coulomb", COULOMB),
        estimates("load", OFFSET),
        estimates("delay", DELAY, _MILLISECONDS),
        TableColumn("fit", fits),
    ]
    names = TableColumn("joint", [shown(each.joint) for each in joints], is_text=True)
    return WideTable([names], columns)


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
    name, length = shown(each.joint), "m" if is_slide else "rad"
    if each.rows:
        yield (
            f"{name}: {each.time:.1f} s used, {each.travel:.2g} {length} travelled, up to "
            f"{each.speed:.2g} {length}/s and {each.acceleration:.2g} {length}/s²; low pass "
            f"{each.cutoff:g} Hz; {each.why}"
        )
    else:
        yield f"{name}:"
    yield from (f"  {shown(line)}" for line in each.remarks)
    yield from (f"  {line}" for line in _further(each, is_slide))
    for reason in dict.fromkeys(each.unreliable.values()):
        names = [name for name, why in each.unreliable.items() if why == reason]
        if names == [each.joint]:
            yield f"  nothing found: {reason}"
        else:
            words = [_SHORT.get(name, name) for name in names]
            yield f"  {', '.join(words)} not identified: {reason}"


def _further(each: JointIdentification, is_slide: bool) -> Iterator[str]:
    estimates = each.estimates
    sine, cosine = estimates.get(GRAVITY_SIN), estimates.get(GRAVITY_COS)
    if sine is not None and cosine is not None:
        yield (
            f"gravity: ({_plain(sine)}) sin q + ({_plain(cosine)}) cos q "
            f"[{unit(GRAVITY_SIN, is_slide)}]"
        )
    if STRIBECK in estimates:
        yield (
            f"Stribeck: {_plain(estimates[STRIBECK])} {unit(STRIBECK, is_slide)} more when "
            f"creeping, gone by 1/e at {each.stribeck_speed:.2g} {'m' if is_slide else 'rad'}/s"
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
    return text if estimate.is_reliable else f"({text})"


_SHORT = {GRAVITY_SIN: "gravity", OFFSET: "load", EFFORT_SCALE: "effort scale"}


def as_mapping(found: RobotIdentification) -> dict[str, Any]:
    """Return everything as JSON has it, by joint."""
    facts = (
        "method",
        "why",
        "cutoff",
        "rows",
        "time",
        "stribeck_speed",
        "residual",
        "explained",
        "condition",
        "travel",
        "speed",
        "acceleration",
    )
    document = {}
    for each in found.joints:
        is_slide, moved = each.joint in found.slides, found.moved.get(each.joint)
        document[each.joint] = {
            "estimates": {
                name: {
                    **asdict(estimate),
                    "low": estimate.low,
                    "high": estimate.high,
                    "unit": unit(name, is_slide),
                }
                for name, estimate in each.estimates.items()
            },
            "moved_inertia": None if moved is None else moved._asdict(),
            "not_told": dict(each.unreliable),
            "remarks": list(each.remarks),
            "effort": found.sources.get(each.joint, ""),
            **{name: getattr(each, name) for name in facts},
        }
    return document
