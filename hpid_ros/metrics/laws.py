"""What the controllers of a recording were set to, and what their laws did to their gains."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.assembly import make_law, make_norm
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.settings import LOOP_PARAMETERS, LoopSettings
from hpid_ros.messages.columns import JOINT_STATE
from hpid_ros.messages.messages import parameter_changes
from hpid_ros.messages.series import JointSeries, Retune, RunSeries
from hpid_ros.messages.storage import Storage
from hpid_ros.metrics.quantities import GainSignals, Signal
from hpid_ros.stability.closed_loop import norm_values

_HEADER = 12  # bytes of an encapsulation header and a stamp


def read_retunes(path: Path) -> tuple[Retune, ...]:
    """Return what was set at controllers that ran, each with the state before it."""
    with Storage(path) as bag:
        topics = bag.topics()
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        changes = parameter_changes(bag) if states else []
        if not changes:
            return ()
        stamps = _stamps_before([each.place for each in changes], bag, states[0])
    retunes = []
    for change, stamp_ns in zip(changes, stamps, strict=True):
        texts = [f"{k} = {_shown(v)}" for k, v in change.changed.items() if k in LOOP_PARAMETERS]
        if texts and stamp_ns is not None:
            retunes.append(Retune(stamp_ns, change.node, ", ".join(texts)))
    return tuple(retunes)


def _stamps_before(places: Sequence[int], bag: Storage, states: str) -> list[int | None]:
    """Return for each place the stamp of the last state before it, None if there is none."""
    stamps: list[int | None] = [None] * len(places)
    last: list[int] = [-1] * len(places)
    for batch in bag.batches(frozenset((states,))):
        before = np.searchsorted(batch.places, places) - 1
        for number, index in enumerate(before.tolist()):
            if index >= 0 and batch.places[index] > last[number] and batch.sizes[index] >= _HEADER:
                last[number] = int(batch.places[index])
                raw = batch.raw(
                    index
                )  # it begins with a header, whose first eight bytes these are
                seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
                stamps[number] = int(seconds) * NANOSECONDS + int(nanoseconds)
    return stamps


def _shown(value: Any) -> str:
    if value is None:
        return "unset"
    return f"{value:g}" if isinstance(value, float) else str(value)


def gains_of_runs(
    runs: Sequence[RunSeries], settings: Mapping[str, Mapping[str, LoopSettings]]
) -> dict[str, dict[str, GainSignals]]:
    """Return :func:`gain_signals` by label, of the runs whose loops are known."""
    found = {run.label: gain_signals(run, settings.get(run.label, {})) for run in runs}
    return {label: signals for label, signals in found.items() if signals is not None}


def gain_signals(
    run: RunSeries, settings: Mapping[str, LoopSettings]
) -> dict[str, GainSignals] | None:
    """Return norm and multiplier of each joint over time.

    The error's rate is computed as the loop does it: the reference's own rate minus the filtered
    difference of the positions.
    """
    if any(each.joint not in settings or not each.has_reference for each in run.joints):
        return None
    return {series.joint: _signals(series, settings[series.joint]) for series in run.joints}


def _signals(series: JointSeries, settings: LoopSettings) -> GainSignals:
    law, norm = make_law(settings), make_norm(settings)
    values = norm_values(norm, series.error, _error_rate(series, settings))
    if not isinstance(law, HomogeneousPid):
        multiplier = np.ones_like(values)
    else:
        limited = np.clip(values, law.norm_floor, law.norm_cap)
        at_zero = 1.0 if norm.degree == 0.0 else 0.0
        positive = np.where(limited > 0.0, limited, 1.0)
        multiplier = np.where(limited > 0.0, positive**norm.degree, at_zero)
    stamps = series.state_stamps_ns
    return GainSignals(Signal(stamps, values), Signal(stamps, multiplier))


def _error_rate(series: JointSeries, settings: LoopSettings) -> Numbers:
    t = series.time
    if t.size < 2:
        return np.zeros_like(t)
    steps = np.diff(t)
    period = float(np.median(steps))
    share = period / (settings.velocity.filter_time_constant + period)
    difference = np.append(0.0, np.diff(series.position) / steps)
    filtered = accumulate(share * difference, lambda last, new: (1.0 - share) * last + new)
    velocity: Numbers = np.fromiter(filtered, float, t.size)
    return _reference_rate(series.reference, steps) - velocity


def _reference_rate(reference: Numbers, steps: Numbers) -> Numbers:
    """Return the rate of a reference; a jump from rest to rest has none."""
    moves = np.diff(reference)
    before, after = np.append(0.0, moves[:-1]), np.append(moves[1:], 0.0)
    is_jump = (moves != 0.0) & (before == 0.0) & (after == 0.0)
    return np.append(0.0, np.where(is_jump, 0.0, moves / steps))
