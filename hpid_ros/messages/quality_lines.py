"""What a run's numbers must be read with, in lines and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hpid_ros.base.text import shown
from hpid_ros.messages.quality import DataQuality, StampQuality
from hpid_ros.messages.series import JointSeries, RunSeries

SMALL_ERROR = 0.05  # an error below this is small for any joint, in [rad]
SHARE_OF_RANGE = 0.1  # so is one below this share of the reference's range
_SELDOM = 0.1  # a joint follows if its error is small for at least this share of its motion
_MUCH = 0.05  # of the states' time
_MOVED = 0.05  # a joint whose position ranges over more than this has moved, in [rad]


def unfollowed(run: RunSeries) -> dict[str, float]:
    """Return the joints whose error was small hardly ever, from where the reference moved on."""
    found = {}
    for series in run.joints:
        usual_least = _usual_least(series)
        if usual_least is not None:
            found[series.joint] = usual_least
    return found


def _usual_least(series: JointSeries) -> float | None:
    """Return the error that a joint hardly ever falls below; None if it follows its reference."""
    if not series.has_reference:
        return None
    moved = np.flatnonzero(series.reference != series.reference[0])
    error, known = np.abs(series.error), series.known
    if known is None:
        known = np.ones(error.size, dtype=np.bool_)
    if moved.size and known[moved[0] :].any():
        error, known = error[moved[0] :], known[moved[0] :]
    usual_least = float(np.quantile(error[known], _SELDOM))
    reference = series.reference if series.known is None else series.reference[series.known]
    reference_range = float(np.ptp(reference))
    follows = usual_least <= max(SMALL_ERROR, SHARE_OF_RANGE * reference_range)
    return None if follows else usual_least


def unfollowed_lines(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a line for each run with joints that did not follow."""
    for run in runs:
        yield from _unfollowed_line(run, unfollowed(run))


def _unfollowed_line(run: RunSeries, joints: Mapping[str, float]) -> Iterator[str]:
    if joints:
        listed = ", ".join(
            f"{joint} ({error:.3g} {'m' if joint in run.slides else 'rad'})"
            for joint, error in joints.items()
        )
        yield (
            f"run {run.label!r}: these joints do not follow their reference, and their ratios "
            f"say nothing of the controller: {listed}; in brackets the error that they exceed "
            f"{1 - _SELDOM:.0%} of the time"
        )


def unfollowed_mapping(runs: Sequence[RunSeries]) -> Mapping[str, Mapping[str, float]]:
    """Return :func:`unfollowed` by label, of the runs that have such joints."""
    found = {run.label: unfollowed(run) for run in runs}
    return {label: joints for label, joints in found.items() if joints}


QUALITY_COLUMNS = (
    "joint",
    "stream",
    "clock",
    "samples",
    "rate [Hz]",
    "from [s]",
    "to [s]",
    "lost",
    "gaps",
    "longest gap [ms]",
    "at [s]",
    "repeated",
    "out of order",
    "not finite",
)


def quality_lines(run: RunSeries) -> Iterator[str]:
    """Yield one line for each thing about a recording that its numbers must be read with."""
    for line in _lines(run):
        yield shown(line)


def _lines(run: RunSeries) -> Iterator[str]:
    joints = run.quality.joints
    for line in run.quality.lines:
        yield f"run {run.label!r}: {line}"
    for stream in ("states", "commands"):
        qualities = {name: getattr(quality, stream) for name, quality in joints.items()}
        parts = [f"{name}: {_defects(each)}" for name, each in qualities.items() if _defects(each)]
        if parts:
            listed = "; ".join(parts[:3]) + (f"; {len(parts) - 3} more" if len(parts) > 3 else "")
            yield f"run {run.label!r}: {stream} are not complete: {listed}"
    alone = [name for name, each in joints.items() if each.states.count == 1]
    if alone:
        names = ", ".join(alone)
        yield f"run {run.label!r}: a single state of {names}: integrals over no time are 0"
    received = [
        stream
        for stream in ("state", "command")
        if any(getattr(each, f"{stream}_clock") == "receive" for each in joints.values())
    ]
    if received:
        streams = " and ".join(f"{stream}s" for stream in received)
        yield f"run {run.label!r}: {streams} have their receive time, not a stamp of their own"
    partly = [name for name, each in joints.items() if each.uncovered > _MUCH]
    if partly:
        yield (
            f"run {run.label!r}: the efforts of {', '.join(partly)} begin after the states or end "
            f"before them, by more than {_MUCH:.0%} of the time: their numbers are of the rest"
        )
    for line in _without_reference(joints):
        yield f"run {run.label!r}: {line}"
    idle, errors = [], {}
    for series in run.joints:
        if series.effort.size and not series.effort.any() and np.ptp(series.position) > _MOVED:
            idle.append(series.joint)
        usual_least = _usual_least(series)
        if usual_least is not None:
            errors[series.joint] = usual_least
    if idle:
        yield (
            f"run {run.label!r}: every effort of {', '.join(idle)} is 0, and the joint moved: "
            "nobody commanded it, or its driver fills in what it does not measure"
        )
    yield from _unfollowed_line(run, errors)


def _span_text(begin: float, end: float) -> str:
    return f"{begin:.3f} s to {end:.3f} s"


def _without_reference(joints: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield a line for each way in which references do not cover the states."""
    found: dict[str, list[str]] = {}
    held: dict[str, list[str]] = {}
    for name, each in joints.items():
        if each.held_before > _MUCH * (each.states.end - each.states.begin):
            held.setdefault(f"{each.reference_from:.3f} s", []).append(name)
        if each.without_reference > _MUCH:
            spans = ", ".join(_span_text(*span) for span in each.reference_spans)
            text = f"{spans}, and the states from {_span_text(each.states.begin, each.states.end)}"
            found.setdefault(text, []).append(name)
    for text, names in held.items():
        yield (
            f"the reference of {', '.join(names)} begins at {text}: before it the first position "
            "counts, at which the joint rested"
        )
    for text, names in found.items():
        yield (
            f"the reference of {', '.join(names)} is known from {text}: the numbers of the error "
            "are of this time"
        )


def quality_rows(joint: str, quality: DataQuality) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a joint's states and commands, see :data:`QUALITY_COLUMNS`."""
    streams = (
        ("states", quality.states, quality.state_clock),
        ("commands", quality.commands, quality.command_clock),
    )
    for name, each, clock in streams:
        yield (
            joint,
            name,
            clock,
            each.count,
            f"{1.0 / each.period:.4g}" if each.period else "–",
            f"{each.begin:.3f}",
            f"{each.end:.3f}",
            each.lost,
            each.gaps,
            f"{1e3 * each.longest_gap:.3f}" if each.gaps else "–",
            f"{each.longest_gap_at:.3f}" if each.gaps else "–",
            each.repeated,
            each.out_of_order,
            each.not_finite,
        )


def _defects(quality: StampQuality) -> str:
    counts = {
        "lost": quality.lost,
        "repeated": quality.repeated,
        "out of order": quality.out_of_order,
        "not finite": quality.not_finite,
    }
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    if quality.gaps:
        parts.append(
            f"longest gap {1e3 * quality.longest_gap:.3g} ms at {quality.longest_gap_at:.3f} s"
        )
    return ", ".join(parts)
