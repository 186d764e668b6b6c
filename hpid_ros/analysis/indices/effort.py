"""Costs of an effort beside its size: time at its limits, chatter, mechanical work."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hpid_ros.analysis.indices.integrals import exact_sum, exact_sum_of_blocks
from hpid_ros.base.arrays import Numbers
from hpid_ros.recordings.series import JointSeries

SEGMENT = 1.0
"""Length of the segments of Welch's method, in [s]; the whole signal if it is shorter."""
SHORTEST_SEGMENT = 16
"""With fewer samples there is no spectrum."""
SPECTRUM_DIGITS = 12
"""Fast Fourier transforms differ between processors beyond these."""
LEAST_FREQUENCY = 0.5
"""Where drawings begin, in [Hz]: half a segment of Welch's method says nothing below."""
EVEN_WITHIN = 1e-3
"""Periods that differ by less than this share are the same."""
GAP = 1.75
"""Steps longer than so many periods have lost samples; shorter ones are late samples."""
MOST_BRIDGED = 2.0
"""Where more than every other sample is missing, nothing is known of what is fast."""
PLATEAU = 5
"""So many equal commands in a row at the extreme value are a limit."""
AT_LIMIT = 1e-9
"""Relative distance at which an effort is at its limit."""


BLOCK = 1 << 16
"""Samples that are worked on at once."""
WINDOWS = 512
"""Windows of Welch's method that are transformed at once."""


class Spectrum(NamedTuple):
    """A one-sided power spectral density."""

    frequency: Numbers  # [Hz] increasing from zero, (K,)
    density: Numbers  # [Hz] in the signal's unit squared over, (K,)
    ends_at_half_rate: bool  # whether the last frequency is half the sampling rate


def saturation_share(series: JointSeries, limit: float | None = None) -> float:
    """Share of the time in which the effort is at a limit, in [%].

    A command holds until the next one. Where no limit is known, an effort is at one when it is
    the run's highest or lowest and stays so, to the last bit, over at least :data:`PLATEAU`
    commands: a clamp gives such plateaus and a moving loop does not.
    """
    effort, t = series.effort, series.command_time
    if effort.size < 2:
        return 0.0
    if limit is not None:
        is_limited = np.abs(effort) >= limit * (1.0 - AT_LIMIT)
    else:
        highest, lowest = effort.max(), effort.min()
        if highest == lowest:
            return 0.0
        is_limited = _on_plateau(effort == highest) | _on_plateau(effort == lowest)
    return 100.0 * exact_sum(np.diff(t)[is_limited[:-1]]) / float(t[-1] - t[0])


def energy(series: JointSeries) -> float | None:
    r"""Mechanical work that effort and joint exchange, :math:`\int |u\,\dot y|\,dt`, in [J].

    Exact for an effort that holds between commands and a position that is monotone there:
    :math:`\sum_k |u_k| |y_{k+1} - y_k|`, with no velocity to estimate. Both directions count:
    braking takes work from the joint that few drives give back.
    """
    if not series.effort.size:
        return 0.0
    effort, t = series.effort, series.time
    if series.command_time[-1] < t[0] or series.command_time[0] > t[-1]:
        return None
    ends = np.append(series.command_time, max(t[-1], series.command_time[-1]))

    def work() -> Iterator[Numbers]:
        for first in range(0, effort.size, BLOCK):
            held = effort[first : first + BLOCK]
            position = np.interp(ends[first : first + held.size + 1], t, series.position)
            yield np.abs(held) * np.abs(np.diff(position))

    return exact_sum_of_blocks(work())


def spectrum(t: Numbers, x: Numbers) -> Spectrum | None:
    """Return a signal's power spectral density by Welch's method.

    Hann windows of one second that overlap by half, each without its mean. Where the time
    between samples varies, each counts as one period, and straight lines bridge what was lost:
    interpolating all of them at even times would take away what is fast.
    """
    if x.size < SHORTEST_SEGMENT or t[-1] <= t[0]:
        return None
    even = _evenly_spaced(t, x)
    rate = (even.size - 1) / float(t[-1] - t[0])
    length = min(even.size, max(SHORTEST_SEGMENT, round(SEGMENT * rate)))
    return _mean_of_windows(even, rate, length)


def amplitude_density(series: JointSeries) -> Spectrum | None:
    """Return the root of the effort's power density as a drawing shows it, in [N m / Hz^0.5].

    It begins where a window of a second says something, and lacks the bin at half the sampling
    rate of an even number of samples. That one is its own mirror image: a one-sided density has
    half of its neighbours' there, a drop that no signal has.
    """
    found = spectrum(series.command_time, series.effort)
    if found is None:
        return None
    shown = (found.frequency >= LEAST_FREQUENCY) & (found.density > 0.0)
    shown[-1] &= not found.ends_at_half_rate
    return found._replace(frequency=found.frequency[shown], density=np.sqrt(found.density[shown]))


def _evenly_spaced(t: Numbers, x: Numbers) -> Numbers:
    """Return samples one period apart: those there are, and what bridges the gaps."""
    steps = np.diff(t)
    period = float(np.median(steps))
    periods = np.where(steps > GAP * period, np.rint(steps / period), 1.0)
    places = np.concatenate([[0.0], np.cumsum(periods)])
    is_even = float(np.abs(steps - period).max()) <= EVEN_WITHIN * period
    if is_even or places[-1] > MOST_BRIDGED * x.size:
        return np.interp(np.linspace(t[0], t[-1], x.size), t, x)
    return np.interp(np.arange(places[-1] + 1.0), places, x)


def _mean_of_windows(x: Numbers, rate: float, length: int) -> Spectrum:
    """Return Welch's mean over all windows, a few hundred at a time: hours fit into memory."""
    step = length - length // 2
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)  # periodic, of Hann
    windows = sliding_window_view(x, length)[::step]
    power = np.zeros(length // 2 + 1)
    for first in range(0, len(windows), WINDOWS):
        some = windows[first : first + WINDOWS]
        lines = np.fft.rfft((some - some.mean(axis=1, keepdims=True)) * window, axis=1)
        power += (lines.real**2 + lines.imag**2).sum(axis=0)
    density = power / (len(windows) * rate * np.square(window).sum())
    is_even = length % 2 == 0
    density[1 : -1 if is_even else None] *= 2.0  # one-sided
    frequency = np.fft.rfftfreq(length, 1.0 / rate).astype(np.float64)
    return Spectrum(frequency, density, is_even)


def chatter(series: JointSeries, cutoff: float) -> float | None:
    r"""Root mean square of the effort above a frequency, :math:`(\int_{f_c} S\,df)^{1/2}`."""
    found = spectrum(series.command_time, series.effort)
    if found is None or found.frequency[-1] <= cutoff:
        return None
    bins = found.density[found.frequency >= cutoff]
    width = float(found.frequency[1])
    value = math.sqrt(exact_sum(bins) * width)
    return float(f"{value:.{SPECTRUM_DIGITS}g}")


def _on_plateau(is_extreme: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the true samples stand in a row of at least :data:`PLATEAU`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_extreme.astype(np.int8), [0]])))
    plateau = np.zeros(is_extreme.size, dtype=np.bool_)
    for first, stop in edges.reshape(-1, 2):
        plateau[first:stop] = stop - first >= PLATEAU
    return plateau
