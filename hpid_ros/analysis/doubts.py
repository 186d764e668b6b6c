"""Doubts about runs, in words: what was lost, and which joints do not follow their reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hpid_ros.base.foreign_text import shown
from hpid_ros.recordings.quality import DataQuality, StampQuality
from hpid_ros.recordings.series import JointSeries, RunSeries

SMALL = 0.05
"""An error below this is small for any joint, in [rad]."""
SHARE_OF_RANGE = 0.1
"""So is one below this share of the reference's range."""
SELDOM = 0.1
"""A joint follows if its error is small for at least this share of its motion."""
MOVED = 0.05
"""A joint whose position ranges over more than this has moved, in [rad]."""


def unfollowed(run: RunSeries) -> dict[str, float]:
    """Return the joints whose error was small hardly ever, from where the reference moved on."""
    told = [series for series in run.joints if series.reference.size]
    least = {series.joint: _usual_least(series) for series in told}
    allowed = {
        series.joint: max(SMALL, SHARE_OF_RANGE * float(np.ptp(series.reference)))
        for series in told
    }
    return {joint: error for joint, error in least.items() if error > allowed[joint]}


def unfollowed_lines(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a line for each run with joints that did not follow."""
    for run in runs:
        joints = unfollowed(run)
        if joints:
            shown = ", ".join(
                f"{joint} ({error:.3g} {'m' if joint in run.slides else 'rad'})"
                for joint, error in joints.items()
            )
            yield (
                f"run {run.label!r}: these joints do not follow their reference, and their ratios "
                f"say nothing of the controller: {shown}; in brackets the error that they exceed "
                f"{1 - SELDOM:.0%} of the time"
            )


def unfollowed_mapping(runs: Sequence[RunSeries]) -> Mapping[str, Mapping[str, float]]:
    """Return :func:`unfollowed` by label, of the runs that have such joints."""
    found = {run.label: unfollowed(run) for run in runs}
    return {label: joints for label, joints in found.items() if joints}


def _usual_least(series: JointSeries) -> float:
    moved = np.flatnonzero(series.reference != series.reference[0])
    error = np.abs(series.error[moved[0] :] if moved.size else series.error)
    return float(np.quantile(error, SELDOM))


COLUMNS = (
    *("joint", "stream", "clock", "samples", "rate [Hz]", "from [s]", "to [s]"),
    *("lost", "gaps", "longest gap [ms]", "at [s]", "repeated", "out of order", "not finite"),
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
            shown = "; ".join(parts[:3]) + (f"; {len(parts) - 3} more" if len(parts) > 3 else "")
            yield f"run {run.label!r}: {stream} are not complete: {shown}"
    received = [
        stream
        for stream in ("state", "command")
        if any(getattr(each, f"{stream}_clock") == "receive" for each in joints.values())
    ]
    if received:
        streams = " and ".join(f"{stream}s" for stream in received)
        yield f"run {run.label!r}: {streams} have their receive time, not a stamp of their own"
    idle = [
        series.joint
        for series in run.joints
        if series.effort.size and not series.effort.any() and np.ptp(series.position) > MOVED
    ]
    if idle:
        yield (
            f"run {run.label!r}: every effort of {', '.join(idle)} is 0, and the joint moved: "
            "nobody commanded it, or its driver fills in what it does not measure"
        )
    yield from unfollowed_lines([run])


def quality_rows(joint: str, quality: DataQuality) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a joint's states and commands, see :data:`COLUMNS`."""
    streams = (
        ("states", quality.states, quality.state_clock),
        ("commands", quality.commands, quality.command_clock),
    )
    for name, each, clock in streams:
        yield (
            *(joint, name, clock, each.count),
            f"{1.0 / each.period:.4g}" if each.period else "–",
            *(f"{each.begin:.3f}", f"{each.end:.3f}", each.lost, each.gaps),
            f"{1e3 * each.longest_gap:.3f}" if each.gaps else "–",
            f"{each.longest_gap_at:.3f}" if each.gaps else "–",
            *(each.repeated, each.out_of_order, each.not_finite),
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
