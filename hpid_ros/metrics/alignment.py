"""The same motion in several recordings: where it begins in each, and which part all have.

Recorders are started by hand: one motion lies at another time in each recording. Runs are laid
over each other where their references begin, where these first move, or by the shift that fits
best.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.series import JointSeries, RunSeries

ALIGNMENTS = ("auto", "begin", "motion", "none")
"""How runs are laid over each other; see :class:`hpid_ros.metrics.measure.Measuring`."""

DURATION_WITHIN = 0.01  # durations, and rates of states, that differ by a lower share are the same
REFERENCE_WITHIN = 0.02  # references that differ by a lower share of their range are the same
REFERENCE_AT_LEAST = 1e-3  # [rad] or by less than this
SHORTEST = 0.1  # [s] shorter common times say nothing of whole motions: runs are left as they are
_POINTS = 4096  # of a reference's course, at most
_COMPARED = 512  # points at which two courses are compared
_LAGS = 2048  # shifts that are tried
_ALIKE = 0.06  # share of the points that may differ: a jump between two samples
_AT_REST = 1e-6  # of the range: a reference that moves less rests
_NOISE = 3.0  # times the usual noise of a resting reference
_BETTER = 0.25  # of the squared difference: a fit that is worth leaving the motion's begin for


class ReferenceCourse(NamedTuple):
    """A joint's reference over the time of its run."""

    times: Numbers  # [s] since the first state of any joint, (n,)
    values: Numbers  # [rad], (n,)


@dataclass(frozen=True)
class Outline:
    """What runs are laid over each other by."""

    duration: float  # [s] from the first to the last state
    period: float  # [s] mean time between two states
    reference_from: float | None  # [s] when the first joint came under its reference
    motion_from: float | None  # [s] last state before a reference first moves; None without one
    courses: Mapping[str, ReferenceCourse]  # by joint

    @property
    def has_motion(self) -> bool:
        return self.motion_from is not None


class Cut(NamedTuple):
    """The part of a recording that is common to all."""

    start: float  # [s] its begin since the first state of any joint
    end: float  # its end, likewise
    text: str  # the same in words; empty where it is the whole recording
    shift: float | None = (
        None  # [s] by which it lies later than in the first run, if it was sought
    )


class RunWindow(NamedTuple):
    """The part of one recording that was asked for."""

    start: float  # [s] since the first state of any joint
    end: float | None = None  # likewise; None for as long as all recordings last


def parse_windows(texts: Sequence[str]) -> dict[str, RunWindow]:
    """Return the windows of single recordings, ``LABEL=START`` or ``LABEL=START:END``."""
    windows: dict[str, RunWindow] = {}
    for text in texts:
        label, _, times = text.rpartition("=")
        start, _, end = times.partition(":")
        try:
            window = RunWindow(float(start), float(end) if end else None)
            is_window = 0.0 <= window.start < (math.inf if window.end is None else window.end)
        except ValueError:
            is_window = False
        if not label or not is_window:
            raise SettingError(
                f"a window must be LABEL=START or LABEL=START:END in s, with 0 <= START < END, "
                f"got {text!r}"
            )
        windows[label] = window
    return windows


def window_cuts(
    outlines: Sequence[Outline], windows: Sequence[RunWindow | None]
) -> tuple[Cut, ...]:
    """Return the windows that were asked for, from their starts on as long as all of them last."""
    wanted = [each or RunWindow(0.0) for each in windows]
    ends = [
        one.duration if each.end is None else min(each.end, one.duration)
        for one, each in zip(outlines, wanted, strict=True)
    ]
    room = min(end - each.start for end, each in zip(ends, wanted, strict=True))
    if room <= 0.0:
        return ()
    return tuple(
        Cut(
            each.start,
            each.start + room,
            f"{room:.4g} s from {each.start:.4g} s on, as asked for; ITAE counts time from there",
            each.start - wanted[0].start,
        )
        for each in wanted
    )


class JointCourse(NamedTuple):
    """By what one joint of a run is laid over that of another."""

    moved: float | None  # [s] when its reference first moves, since the run's first state
    reference: ReferenceCourse | None  # None without one


def course_of(series: JointSeries, start_ns: int) -> JointCourse:
    """Return the course of a joint's reference, in times since a run's first state."""
    if not series.has_reference:
        return JointCourse(None, None)
    known = slice(None) if series.known is None else series.known
    stamps, values = series.state_stamps_ns[known], series.reference[known]
    step = -(-len(stamps) // _POINTS)
    begin_ns = _motion_begin(series)
    return JointCourse(
        None if begin_ns is None else (begin_ns - start_ns) / NANOSECONDS,
        ReferenceCourse((stamps[::step] - start_ns) / NANOSECONDS, values[::step].copy()),
    )


def outline_of(run: RunSeries, courses: Mapping[str, JointCourse] | None = None) -> Outline:
    """Return by what a run is laid over others; each joint's course may be known already."""
    if courses is None:
        courses = {each.joint: course_of(each, run.start_ns) for each in run.joints}
    states = max(each.states for each in run.outlines)
    joints = run.quality.joints.values()
    began = [each.reference_from for each in joints if each.reference_from is not None]
    moved = [each.moved for each in courses.values() if each.moved is not None]
    return Outline(
        run.duration,
        run.duration / max(1, states - 1),
        min(began, default=None),
        min(moved, default=None),
        {k: each.reference for k, each in courses.items() if each.reference is not None},
    )


def _motion_begin(series: JointSeries) -> int | None:
    """Return the stamp of the last state before a reference moves; None if it never does."""
    if not series.has_reference:
        return None
    known = slice(None) if series.known is None else series.known
    values, stamps = series.reference[known], series.state_stamps_ns[known]
    span = float(np.ptp(values))
    if span <= REFERENCE_AT_LEAST:
        return None
    rest = float(np.median(values[: max(1, len(values) // 100)]))
    off = np.abs(values - rest)
    moved = int(np.argmax(off > max(REFERENCE_AT_LEAST, REFERENCE_WITHIN * span)))
    before = off[:moved]
    within = _AT_REST * span
    early = before[: len(before) // 2]
    if np.count_nonzero(before <= within) < 3 and len(early) >= 8:
        halves = np.array_split(early, 2)
        if np.mean(halves[1]) < 2.0 * np.mean(halves[0]):  # noise, and no motion from the start on
            within = _NOISE * float(np.quantile(early, 0.75))
    at_rest = np.flatnonzero(before <= within)
    return int(stamps[at_rest[-1] if len(at_rest) else 0])


def cuts_of(outlines: Sequence[Outline], align: str, labels: Sequence[str]) -> tuple[Cut, ...]:
    """Return the part of each recording to compare; nothing if the whole ones are."""
    if align == "none" or not outlines:
        return ()
    if align == "motion":
        return _by_motion(outlines, labels)
    cuts = common_cuts(outlines)
    if align == "begin" or len(outlines) < 2:
        return cuts
    starts = [each.start for each in cuts] or [0.0] * len(outlines)
    if _are_alike(outlines, starts):
        return cuts
    for other in (_by_motion(outlines, labels), _by_fit(outlines, labels)):
        if other and _are_alike(outlines, [each.start for each in other]):
            return other
    return cuts


def common_cuts(outlines: Sequence[Outline]) -> tuple[Cut, ...]:
    """Return the common part from where references begin; nothing if runs begin and end alike.

    Where a recording has no reference, they are laid beside each other at their first states.
    """
    if len(outlines) < 2:
        return ()
    durations = [each.duration for each in outlines]
    begins = [each.reference_from for each in outlines]
    has_references = all(begin is not None for begin in begins)
    starts = [begin or 0.0 for begin in begins] if has_references else [0.0] * len(outlines)
    room = min(duration - start for duration, start in zip(durations, starts, strict=True))
    within = DURATION_WITHIN * max(durations)
    are_alike = max(durations) - min(durations) <= within and max(starts) - min(starts) <= within
    if are_alike or room < SHORTEST:
        return ()
    where = "its reference begins" if has_references else "its states do"
    return tuple(
        Cut(
            start,
            start + room,
            ""
            if duration - room <= DURATION_WITHIN * room
            else f"cut to {room:.4g} s of {duration:.4g} s, from {start:.4g} s on, where {where}",
        )
        for start, duration in zip(starts, durations, strict=True)
    )


def _by_motion(outlines: Sequence[Outline], labels: Sequence[str]) -> tuple[Cut, ...]:
    """Return the common part from where the references first move; nothing if one does not."""
    begins = [each.motion_from for each in outlines]
    starts = [each for each in begins if each is not None]
    if len(starts) < len(outlines):
        return ()
    shifted = [starts[0]]
    for one, start in zip(outlines[1:], starts[1:], strict=True):
        # The begin is known to a sample, and noise hides it: the courses say it better.
        fit = _best_shift(outlines[0], one, start - starts[0], 0.1 * outlines[0].duration)
        is_better = abs(fit - (start - starts[0])) > max(one.period, outlines[0].period)
        if is_better and _distance(outlines[0], one, fit) < _BETTER * _distance(
            outlines[0], one, start - starts[0]
        ):
            start = starts[0] + fit
        shifted.append(start)
    return _cuts(outlines, labels, shifted, "where its reference first moves")


def _by_fit(outlines: Sequence[Outline], labels: Sequence[str]) -> tuple[Cut, ...]:
    """Return the common part by the shifts with which the references fit best."""
    first = outlines[0]
    shifts = [0.0]
    for each in outlines[1:]:
        shift = _best_shift(first, each, 0.5 * (each.duration - first.duration), math.inf)
        shifts.append(shift)
    early = min(shifts)
    starts = [shift - min(early, 0.0) for shift in shifts]
    return _cuts(outlines, labels, starts, "by the shift with which its reference fits best")


def _cuts(
    outlines: Sequence[Outline], labels: Sequence[str], starts: Sequence[float], how: str
) -> tuple[Cut, ...]:
    if min(starts) < 0.0:
        starts = [start - min(starts) for start in starts]
    room = min(each.duration - start for each, start in zip(outlines, starts, strict=True))
    if room < SHORTEST:
        return ()
    found: list[Cut] = []
    for start in starts:
        shift = start - starts[0]
        against = f", shifted by {shift:+.4g} s against {labels[0]}" if found else ""
        text = f"{room:.4g} s from {start:.4g} s on, {how}{against}; ITAE counts time from there"
        found.append(Cut(start, start + room, text, shift))
    return tuple(found)


def _joints(one: Outline, other: Outline) -> Iterator[tuple[ReferenceCourse, ReferenceCourse]]:
    for name, course in one.courses.items():
        if name in other.courses:
            yield course, other.courses[name]


def _differences(one: Outline, other: Outline, shift: float) -> Iterator[tuple[Numbers, float]]:
    """Yield how far references lie apart over the common time, and their range, by joint."""
    for a, b in _joints(one, other):
        first = max(a.times[0], b.times[0] - shift)
        last = min(a.times[-1], b.times[-1] - shift)
        if last <= first:
            yield np.empty(0), 1.0
            continue
        at = np.linspace(first, last, _COMPARED)
        off = np.interp(at, a.times, a.values) - np.interp(at + shift, b.times, b.values)
        yield off, max(float(np.ptp(a.values)), float(np.ptp(b.values)))


def _distance(one: Outline, other: Outline, shift: float) -> float:
    """Return the mean square of what references differ by, over their ranges."""
    sums = [
        float(np.mean(np.square(off))) / span**2 if off.size else math.inf
        for off, span in _differences(one, other, shift)
        if span > REFERENCE_AT_LEAST
    ]
    return math.fsum(sums) / len(sums) if sums else 0.0


def _best_shift(one: Outline, other: Outline, guess: float, reach: float) -> float:
    """Return by how much later the other run has the same motion, in [s].

    At least half of the shorter run is common to both.
    """
    half = 0.5 * min(one.duration, other.duration)
    low = max(guess - reach, half - one.duration)
    high = min(guess + reach, other.duration - half)
    if not low < high:
        return guess
    shifts = np.linspace(low, high, _LAGS if math.isinf(reach) else _LAGS // 8)
    step = float(shifts[1] - shifts[0])
    best = min(shifts.tolist(), key=lambda shift: _distance(one, other, shift))
    while step > 1e-5:
        around = (best - step / 2.0, best, best + step / 2.0)
        best = min(around, key=lambda shift: _distance(one, other, shift))
        step /= 2.0
    return float(best)


def _are_alike(outlines: Sequence[Outline], starts: Sequence[float]) -> bool:
    """Return whether all references are the first one's, laid beside each other at some starts."""
    for each, start in zip(outlines[1:], starts[1:], strict=True):
        for off, span in _differences(outlines[0], each, start - starts[0]):
            within = max(REFERENCE_AT_LEAST, REFERENCE_WITHIN * span)
            if not off.size or np.mean(np.abs(off) > within) > _ALIKE:
                return False
    return True
