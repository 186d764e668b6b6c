"""What a homogeneous law did to its gains, computed again from a recording.

Position and velocity are estimated by the loop's own estimation, sample by sample. Two things a
recording does not tell, and they are approximate: the reference's rate, which is the difference
of its positions around each state, and what the loop did where it took over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.control.assembly import make_law, make_norm
from hpid_ros.control.estimation import Estimation
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.norms import Norm
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.signals import Signal


class GainSignals(NamedTuple):
    """What a joint's homogeneous law did to its gains."""

    norm: Signal  # homogeneous norm of error and error rate at each state, before floor and cap
    # factor of the loop's bandwidth: the norm, within floor and cap, to the power of the degree
    multiplier: Signal


RunGainSignals = Mapping[str, Mapping[str, GainSignals]]  # what the laws did, by label and joint
RunLoops = Mapping[str, Mapping[str, LoopSettings]]  # settings by label and joint


def gains_of_runs(runs: Sequence[RunSeries], loops: RunLoops) -> dict[str, dict[str, GainSignals]]:
    """Return :func:`gain_signals` by label, of the runs of which they can be told."""
    found = {run.label: gain_signals(run, loops.get(run.label, {})) for run in runs}
    return {label: signals for label, signals in found.items() if signals is not None}


def gain_notes(runs: Sequence[RunSeries], loops: RunLoops) -> list[str]:
    """Return what :func:`gains_of_runs` must be read with, one line each."""
    lines = []
    for run in runs:
        settings = loops.get(run.label, {})
        if not _are_known(run, settings):
            continue
        untold = [why for each in run.joints if (why := _why_untold(each, settings[each.joint]))]
        if untold:
            lines.append(f"run {run.label!r}: norm and multiplier are not shown: {untold[0]}")
        elif run.retunes:
            lines.append(
                f"run {run.label!r}: parameters were changed while it ran; norm and multiplier "
                "are those of the parameters with which it began"
            )
    return lines


def gain_signals(
    run: RunSeries, settings: Mapping[str, LoopSettings]
) -> dict[str, GainSignals] | None:
    """Return norm and multiplier of each joint over time; None where they cannot be told."""
    if not _are_known(run, settings):
        return None
    found = {}
    for series in run.joints:
        loop = settings[series.joint]
        if _why_untold(series, loop):
            return None
        reference = run.quality.joints.get(series.joint)
        stands = reference is not None and _is_of_setpoints(reference.reference)
        found[series.joint] = _signals(series, loop, reference_stands=stands)
    return found


def _are_known(run: RunSeries, settings: Mapping[str, LoopSettings]) -> bool:
    return all(each.joint in settings and each.has_reference for each in run.outlines)


def _is_of_setpoints(reference: str) -> bool:
    """Return whether a reference, as its quality names it, has no rate: setpoints stand."""
    return all(part.startswith("setpoint ") for part in reference.split(" and "))


def _why_untold(series: JointSeries, settings: LoopSettings) -> str:
    """Return why a recording does not tell what a loop estimated; empty if it does."""
    if settings.velocity.is_measured and series.velocity is None:
        return f"{series.joint} used the velocities of the states, which were not read"
    if settings.velocity.velocity_source == "observer" and settings.model.is_on:
        return f"{series.joint} had an observer and a model, whose efforts are not recorded"
    return ""


def _signals(
    series: JointSeries, settings: LoopSettings, *, reference_stands: bool
) -> GainSignals:
    law, norm = make_law(settings), make_norm(settings)
    rates = np.zeros_like(series.time) if reference_stands else _reference_rate(series)
    errors = _errors(series, settings, rates)
    values = np.array([_norm_of(norm, *each) for each in errors])
    multiplier = np.ones_like(values)
    if isinstance(law, HomogeneousPid):
        multiplier = np.array([_multiplier(law, *each) for each in errors])
    stamps = series.state_stamps_ns
    return GainSignals(Signal(stamps, values), Signal(stamps, multiplier))


def _norm_of(norm: Norm, error: float, error_rate: float) -> float:
    try:
        return norm(error, error_rate)
    except OverflowError:  # a recording may hold positions that no loop takes
        return math.inf


def _multiplier(law: HomogeneousPid, error: float, error_rate: float) -> float:
    try:
        return law.multiplier(error, error_rate)
    except OverflowError:
        return float(law.norm_cap**law.norm.degree)


def _errors(
    series: JointSeries, settings: LoopSettings, reference_rates: Numbers
) -> list[tuple[float, float]]:
    """Return error and error rate at each state, by what the loop estimated."""
    estimation = Estimation(settings)
    velocities = [None] * series.time.size if series.velocity is None else series.velocity.tolist()
    efforts = _active_efforts(series) if estimation.has_observer else None
    rows = zip(
        series.state_stamps_ns.tolist(),
        series.position.tolist(),
        velocities,
        series.reference.tolist(),
        reference_rates.tolist(),
        strict=True,
    )
    errors = []
    before_ns = int(series.state_stamps_ns[0])
    for k, (stamp_ns, position, velocity, reference, reference_rate) in enumerate(rows):
        dt = (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
        if dt > settings.timing.state_timeout:  # the loop took over
            estimation.forget_velocity()
            dt = 0.0
        if efforts is not None:
            estimation.note_applied(efforts[k], 1.0)
        is_reported = velocity is not None and velocity == velocity
        estimation.update(position, velocity if is_reported else None, dt)
        errors.append((reference - estimation.position, reference_rate - estimation.velocity))
        before_ns = stamp_ns
    return errors


def _active_efforts(series: JointSeries) -> list[float]:
    """Return the effort that acted on the joint up to each state: the last command before it."""
    last = np.searchsorted(series.command_stamps_ns, series.state_stamps_ns) - 1
    if not series.has_effort:
        return [0.0] * len(last)
    active: Numbers = np.where(last < 0, 0.0, series.effort[np.maximum(last, 0)])
    return list(map(float, active))


def _reference_rate(series: JointSeries) -> Numbers:
    """Return the rate of a reference at each state; a jump from rest to rest has none.

    It is the slope from the state before to the one after, or on the one side of a jump.
    """
    if series.time.size < 2:
        return np.zeros_like(series.time)
    steps, moves = np.diff(series.time), np.diff(series.reference)
    before, after = np.append(0.0, moves[:-1]), np.append(moves[1:], 0.0)
    is_jump = (moves != 0.0) & (before == 0.0) & (after == 0.0)
    moves = np.where(is_jump, 0.0, moves)
    steps_seen = np.where(is_jump, 0.0, steps)
    way = np.append(0.0, moves) + np.append(moves, 0.0)
    time = np.append(0.0, steps_seen) + np.append(steps_seen, 0.0)
    rate: Numbers = np.divide(way, time, out=np.zeros_like(way), where=time > 0.0)
    return rate
