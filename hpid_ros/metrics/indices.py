"""Indices of one joint: integrals, effort, step response.

Definitions of rise, settling and overshoot as MATLAB's ``stepinfo`` and python-control's
``step_info`` have them: 10 % to 90 %, 2 %, percent of the height.

Quadrature: the composite trapezoidal rule on the real stamps, second order in the step. A
lost sample is bridged by a straight line. Every sum is correctly rounded
(:mod:`~hpid_ros.metrics.summation`), so that a number depends neither on the order of the joints
nor on numpy's version or SIMD width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from hpid_ros.base.rounding import significant
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.series import JointSeries, SeriesError, require_finite
from hpid_ros.metrics.summation import exact_sum, exact_sum_of_blocks

_INTEGRAND_BLOCK = 1 << 16  # samples of an integrand that are in memory at once


def total_variation(u: ArrayLike) -> float:
    r"""Total variation of a sampled signal: the IVC of an effort.

    .. math:: \sum_k |u_{k+1} - u_k|

    The sampled form of the paper's :math:`\int |du/dt|\,dt`. It needs no stamps: a step counts
    by its height, however long it took.
    """
    samples = _line("u", u)
    with np.errstate(over="ignore"):  # the sum refuses what comes of it
        return exact_sum_of_blocks(np.abs(np.diff(block)) for block in _blocks(samples))


def integral_of_absolute(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of an absolute value, :math:`\int |x|\,dt`: IAVC of an effort, IAE of an error."""
    return _trapezoid(t, x, lambda t, x: np.abs(x))


def itae(t: ArrayLike, e: ArrayLike) -> float:
    r"""Integral of the time-weighted absolute error, :math:`\int t |e|\,dt`."""
    return _trapezoid(t, e, lambda t, x: t * np.abs(x))


def square_integral(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of a square, :math:`\int x^2\,dt`: ISE of an error."""
    return _trapezoid(t, x, lambda t, x: np.square(x))


def l2_norm(t: ArrayLike, x: ArrayLike) -> float:
    r"""L2 norm of a signal, :math:`(\int x^2\,dt)^{1/2}`."""
    return math.sqrt(square_integral(t, x))


def root_mean_square(t: ArrayLike, x: ArrayLike) -> float:
    r"""Root of the mean square over time, :math:`(\frac1T\int x^2\,dt)^{1/2}`."""
    times, samples = _lines(t, x)
    if not samples.size:
        raise SeriesError("a mean over time needs at least one sample, got none")
    span = float(times[-1] - times[0])
    if span == 0.0:
        return abs(float(samples[0]))
    return math.sqrt(square_integral(times, samples) / span)


def root_mean_square_of_parts(parts: Sequence[tuple[Numbers, Numbers]]) -> float:
    """Return the root of the mean square over the times of all parts."""
    if len(parts) == 1:
        return root_mean_square(*parts[0])
    span = math.fsum(float(t[-1] - t[0]) for t, _ in parts)
    if span == 0.0:
        return math.sqrt(float(np.mean(np.concatenate([np.square(x) for _, x in parts]))))
    return math.sqrt(math.fsum(square_integral(*part) for part in parts) / span)


def _trapezoid(
    t: ArrayLike, x: ArrayLike, integrand: Callable[[Numbers, Numbers], Numbers]
) -> float:
    """Integrate a function of time and samples; only a block of it is ever in memory."""
    times, samples = _lines(t, x)

    # numpy's own rule changed its name between 1.26 and 2, and sums in an order of its own.
    def areas() -> Iterator[Numbers]:
        for some_times, some in zip(_blocks(times), _blocks(samples), strict=True):
            with np.errstate(over="ignore", invalid="ignore"):  # the sum refuses what comes of it
                y = integrand(some_times, some)
                area = 0.5 * np.diff(some_times) * (y[1:] + y[:-1])
            yield area

    return exact_sum_of_blocks(areas())


def _blocks(x: Numbers) -> Iterator[Numbers]:
    """Yield pieces of a line; each begins with the last sample of the one before."""
    for first in range(0, max(x.size - 1, 1), _INTEGRAND_BLOCK):
        yield x[first : first + _INTEGRAND_BLOCK + 1]


def _lines(t: ArrayLike, x: ArrayLike) -> tuple[Numbers, Numbers]:
    times, samples = _line("t", t), _line("x", x)
    if times.size != samples.size:
        raise SeriesError(f"t and x must be of one length, got {times.size} and {samples.size}")
    if np.any(times[1:] < times[:-1]):
        raise SeriesError("t must not fall: sort the samples by their stamps first")
    return times, samples


def _line(name: str, values: ArrayLike) -> Numbers:
    line = np.asarray(values, dtype=np.float64)
    if line.ndim != 1:
        raise SeriesError(f"{name} must be one-dimensional, got shape {line.shape}")
    require_finite(name, line)
    return line


SEGMENT = 1.0  # [s] of Welch's method; the whole signal if it is shorter
SHORTEST_SEGMENT = 16  # with fewer samples there is no spectrum
SPECTRUM_DIGITS = 12  # fast Fourier transforms differ between processors beyond these
LEAST_FREQUENCY = 0.5  # [Hz] where drawings begin: half a segment says nothing below
EVEN_WITHIN = 1e-3  # periods that differ by less than this share are the same
GAP = 1.75  # steps longer than so many periods have lost samples; shorter ones are late samples
MOST_BRIDGED = 2.0  # with more than every other sample lost, nothing is known of what is fast
PLATEAU = 5  # so many equal commands in a row at the extreme value are a limit
AT_LIMIT = 1e-9  # relative distance at which an effort is at its limit
BLOCK = 1 << 16  # samples that are worked on at once
WINDOWS = 512  # windows of Welch's method that are transformed at once


class Spectrum(NamedTuple):
    """A one-sided power spectral density."""

    frequency: Numbers  # [Hz] increasing from zero, (K,)
    density: Numbers  # the signal's unit squared per Hz, (K,)
    ends_at_half_rate: bool  # whether the last frequency is half the sampling rate


def saturation_share(series: JointSeries, limit: float | None = None) -> float:
    """Share of the time in which the effort is at a limit, in [%].

    A command holds until the next one. Where no limit is known, an effort is at one when it is
    the run's highest or lowest and stays so, to the last bit, over at least :data:`PLATEAU`
    commands: a clamp gives such plateaus and a moving loop does not. Zero is no limit.
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
        is_limited = np.zeros(effort.size, dtype=np.bool_)
        for extreme in (highest, lowest):
            if extreme != 0.0:  # without a command there is no effort, and that is no limit
                is_limited |= _on_plateau(effort == extreme)
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
    are_states = series.command_stamps_ns is series.state_stamps_ns

    def work() -> Iterator[Numbers]:
        for first in range(0, effort.size, BLOCK):
            held = effort[first : first + BLOCK]
            if are_states:  # as interpolated at the states themselves; after the last it rests
                position = series.position[first : first + held.size + 1]
                held = held[: position.size - 1]
            else:
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
    if even is None:
        return None
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


def _evenly_spaced(t: Numbers, x: Numbers) -> Numbers | None:
    """Return samples one period apart: those there are, and what bridges the gaps, if few."""
    steps = np.diff(t)
    period = float(np.median(steps))
    periods = np.where(steps > GAP * period, np.rint(steps / period), 1.0)
    places = np.concatenate([[0.0], np.cumsum(periods)])
    is_even = float(np.abs(steps - period).max()) <= EVEN_WITHIN * period
    if is_even:
        return np.interp(np.linspace(t[0], t[-1], x.size), t, x)
    if places[-1] > MOST_BRIDGED * x.size:
        return None
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
    return significant(math.sqrt(exact_sum(bins) * width), SPECTRUM_DIGITS)


def _on_plateau(is_extreme: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the true samples stand in a row of at least :data:`PLATEAU`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_extreme.astype(np.int8), [0]])))
    plateau = np.zeros(is_extreme.size, dtype=np.bool_)
    for first, stop in edges.reshape(-1, 2):
        plateau[first:stop] = stop - first >= PLATEAU
    return plateau


SHORTEST_HOLD = 0.1  # a reference that moves again within this time has not stepped, in [s]
LEAST_HEIGHT = 1e-3  # lower steps are not told from sensor noise, in [rad]
LEAST_SHARE = 0.1  # steps lower than this share of the joint's highest are left out
RISE_FROM, RISE_TO = 0.1, 0.9
SETTLED_WITHIN = 0.02
STEADY_SHARE = 0.1  # the steady-state error is the mean over this last part of the hold


class Step(NamedTuple):
    """One step: samples ``first`` to ``stop`` (exclusive) of the joint hold the new value."""

    first: int  # the first sample at the new reference
    stop: int  # the first sample after the hold
    start: float  # [rad] the reference before the step
    goal: float  # [rad] the new reference

    @property
    def height(self) -> float:
        """Goal minus start, in [rad]."""
        return self.goal - self.start


class StepResponse(NamedTuple):
    """How a joint answered one step; see docs/indices.md."""

    rise_time: float  # [s] from 10 % to 90 % of the height; infinite if 90 % is never reached
    settling_time: float  # [s] from the step until the joint stays within 2 % of the height
    overshoot: float  # [% of the height] largest excursion beyond the goal
    steady_state_error: float  # [rad] magnitude of the mean error over the last tenth of the hold


def find_steps(series: JointSeries) -> list[Step]:
    """Return the steps of a joint's reference.

    A step is a jump between two samples, out of rest into a hold; at the first sample, the jump
    is from the measured position. Smooth motions have none.
    """
    reference, stamps = series.reference, series.state_stamps_ns
    if not series.has_reference:
        return []
    steps = []
    for begin, stop in _holds(reference, stamps):
        if begin == 0:
            start = float(series.position[0])
        elif begin >= 2 and reference[begin - 2] != reference[begin - 1]:
            continue  # the end of a motion
        else:
            start = float(reference[begin - 1])
        steps.append(Step(begin, stop, start, float(reference[begin])))
    highest = max((abs(step.height) for step in steps), default=0.0)
    least = max(LEAST_HEIGHT, LEAST_SHARE * max(highest, float(np.ptp(reference))))
    return [step for step in steps if abs(step.height) >= least]


def _holds(reference: Numbers, stamps_ns: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield first sample and end of every stretch of one value that lasts long enough.

    Made for hours of motion, in which nearly every sample is another: beside one flag for each
    sample nothing is kept but what holds.
    """
    is_same = np.zeros(reference.size + 1, dtype=np.bool_)
    np.equal(reference[1:], reference[:-1], out=is_same[1:-1])
    edges = np.flatnonzero(is_same[1:] != is_same[:-1])
    pairs = {int(first): int(last) + 1 for first, last in edges.reshape(-1, 2)}
    # A value of one sample holds as well, where the next sample is late.
    least_ns = round(SHORTEST_HOLD * NANOSECONDS)
    for index in np.flatnonzero(np.diff(stamps_ns) >= least_ns):
        if not is_same[index] and not is_same[index + 1]:
            pairs[int(index)] = int(index) + 1
    for first in sorted(pairs):
        # The value lasts to the next one.
        end = min(pairs[first], reference.size - 1)
        if stamps_ns[end] - stamps_ns[first] >= least_ns:
            yield first, pairs[first]


def step_response(series: JointSeries, step: Step) -> StepResponse:
    t = series.time[step.first : step.stop]
    position = series.position[step.first : step.stop]
    progress = (position - step.start) / step.height
    begin, end = (_first_crossing(t, progress, level) for level in (RISE_FROM, RISE_TO))
    tail = t >= t[-1] - STEADY_SHARE * (t[-1] - t[0])
    error = step.goal - position[tail]
    return StepResponse(
        rise_time=end - begin if math.isfinite(end) else math.inf,
        settling_time=_settling_time(t, progress),
        overshoot=100.0 * max(0.0, float(progress.max()) - 1.0),
        steady_state_error=abs(exact_sum(error)) / error.size,
    )


def _first_crossing(t: Numbers, x: Numbers, level: float) -> float:
    """Return when x first reaches a level, on straight lines between samples, in [s]."""
    reached = np.flatnonzero(x >= level)
    if not reached.size:
        return math.inf
    k = int(reached[0])
    if k == 0:
        return float(t[0])
    share = (level - x[k - 1]) / (x[k] - x[k - 1])
    return float(t[k - 1] + share * (t[k] - t[k - 1]))


def _settling_time(t: Numbers, progress: Numbers) -> float:
    """Return the time after which progress stays near one, on straight lines, in [s]."""
    deviation = np.abs(progress - 1.0)
    outside = np.flatnonzero(deviation > SETTLED_WITHIN)
    if not outside.size:
        return 0.0
    k = int(outside[-1])
    if k + 1 == t.size:
        return math.inf
    level = 1.0 + math.copysign(SETTLED_WITHIN, progress[k] - 1.0)
    share = (level - progress[k]) / (progress[k + 1] - progress[k])
    return float(t[k] + share * (t[k + 1] - t[k]) - t[0])
