"""Integrals of sampled signals: arrays in, numbers out.

Quadrature: the composite trapezoidal rule on the real stamps, second order in the step. A
lost sample is bridged by a straight line. Every sum is correctly rounded, so that a number
depends neither on the order of the joints nor on numpy's version or SIMD width.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hpid_ros.analysis.exact_sum import exact_sum
from hpid_ros.analysis.series import SeriesError, require_finite


def total_variation(u: ArrayLike) -> float:
    r"""Total variation of a sampled signal: the IVC of an effort.

    .. math:: \sum_k |u_{k+1} - u_k|

    The sampled form of the paper's :math:`\int |du/dt|\,dt`. It needs no stamps: a step counts
    by its height, however long it took.

    Args:
        u: Samples, (M,).

    Returns:
        The variation, in the unit of u; zero for fewer than two samples.

    Raises:
        SeriesError: If u is not a line of finite numbers.
    """
    samples = _line("u", u)
    return exact_sum(np.abs(np.diff(samples)))


def integral_of_absolute(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of an absolute value, :math:`\int |x|\,dt`: IAVC of an effort, IAE of an error.

    Args:
        t: Increasing times, (M,), in [s].
        x: Samples, (M,).

    Returns:
        The integral, in the unit of x times [s]; zero for fewer than two samples.

    Raises:
        SeriesError: If the two are not lines of finite numbers of one length, or t falls.
    """
    times, samples = _lines(t, x)
    return _trapezoid(times, np.abs(samples))


def itae(t: ArrayLike, e: ArrayLike) -> float:
    r"""Integral of the time-weighted absolute error, :math:`\int t |e|\,dt`.

    Args:
        t: Increasing times since the start of the experiment, (N,), in [s].
        e: Error, (N,), in [rad].

    Returns:
        The integral, in [rad s^2]; zero for fewer than two samples.

    Raises:
        SeriesError: If the two are not lines of finite numbers of one length, or t falls.
    """
    times, samples = _lines(t, e)
    return _trapezoid(times, times * np.abs(samples))


def square_integral(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of a square, :math:`\int x^2\,dt`: ISE of an error.

    Args:
        t: Increasing times, (M,), in [s].
        x: Samples, (M,).

    Returns:
        The integral, in the unit of x squared times [s]; zero for fewer than two samples.

    Raises:
        SeriesError: If the two are not lines of finite numbers of one length, or t falls.
    """
    times, samples = _lines(t, x)
    return _trapezoid(times, np.square(samples))


def l2_norm(t: ArrayLike, x: ArrayLike) -> float:
    r"""L2 norm of a signal, :math:`(\int x^2\,dt)^{1/2}`.

    Args:
        t: Increasing times, (M,), in [s].
        x: Samples, (M,).

    Returns:
        The norm, in the unit of x times [s^0.5]; zero for fewer than two samples.

    Raises:
        SeriesError: If the two are not lines of finite numbers of one length, or t falls.
    """
    return math.sqrt(square_integral(t, x))


def root_mean_square(t: ArrayLike, x: ArrayLike) -> float:
    r"""Root of the mean square over time, :math:`(\frac1T\int x^2\,dt)^{1/2}`.

    Args:
        t: Increasing times, (M,), in [s].
        x: Samples, (M,), at least one.

    Returns:
        The mean, in the unit of x; of a single instant, the magnitude there.

    Raises:
        SeriesError: If the two are not lines of finite numbers of one length, or t falls.
    """
    times, samples = _lines(t, x)
    if not samples.size:
        raise SeriesError("a mean over time needs at least one sample, got none")
    span = float(times[-1] - times[0])
    if span == 0.0:
        return abs(float(samples[0]))
    return math.sqrt(_trapezoid(times, np.square(samples)) / span)


def _trapezoid(t: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    # numpy's own rule changed its name between 1.26 and 2, and sums in an order of its own.
    return exact_sum(0.5 * np.diff(t) * (y[1:] + y[:-1]))


def _lines(t: ArrayLike, x: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    times, samples = _line("t", t), _line("x", x)
    if times.size != samples.size:
        raise SeriesError(f"t and x must be of one length, got {times.size} and {samples.size}")
    if np.any(np.diff(times) < 0.0):
        raise SeriesError("t must not fall: sort the samples by their stamps first")
    return times, samples


def _line(name: str, values: ArrayLike) -> NDArray[np.float64]:
    line = np.asarray(values, dtype=np.float64)
    if line.ndim != 1:
        raise SeriesError(f"{name} must be one-dimensional, got shape {line.shape}")
    require_finite(name, line)
    return line
