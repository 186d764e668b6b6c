"""Norm and multiplier of a recorded loop over time, from its settings and its errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpid_ros.analysis.signals import GainSignals, Signal
from hpid_ros.base.arrays import Numbers
from hpid_ros.control import LoopSettings
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.settings.assembly import make_law, make_norm
from hpid_ros.recordings.series import JointSeries, RunSeries
from hpid_ros.stability.closed_loop import norm_values


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
    from scipy.signal import lfilter  # slow to import, and only needed here

    steps = np.diff(t)
    period = float(np.median(steps))
    share = period / (settings.velocity.filter_time_constant + period)
    difference = np.append(0.0, np.diff(series.position) / steps)
    velocity: Numbers = lfilter([share], [1.0, share - 1.0], difference)
    return _reference_rate(series.reference, steps) - velocity


def _reference_rate(reference: Numbers, steps: Numbers) -> Numbers:
    """Return the rate of a reference; a jump from rest to rest has none."""
    moves = np.diff(reference)
    before, after = np.append(0.0, moves[:-1]), np.append(moves[1:], 0.0)
    is_jump = (moves != 0.0) & (before == 0.0) & (after == 0.0)
    return np.append(0.0, np.where(is_jump, 0.0, moves / steps))
