"""Integrals of sampled signals, and the correctly rounded sum of an array.

Each block is split against a power of two into leading parts that add up without rounding, the
rest is split again until nothing is left, and :func:`math.fsum` adds the few exact parts.

Source: Rump, Ogita and Oishi, "Accurate floating-point summation" (2008), the extraction of
leading parts, here down to the last bit.

Quadrature: the composite trapezoidal rule on the real stamps, second order in the step. A
lost sample is bridged by a straight line. Every sum is correctly rounded, so that a number
depends neither on the order of the joints nor on numpy's version or SIMD width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.base.arrays import Numbers
from hpid_ros.recordings.series import SeriesError, require_finite

# One block stays in the first cache, and so many leading parts of 53 - 15 bits add up exactly.
_SUM_BLOCK = 1 << 13
_SMALL = 256  # fewer numbers are summed sooner than split
_HEADROOM_BITS = 15
_LARGEST_EXPONENT = 1000  # beyond, the power of two that splits would overflow
_LEAST_EXPONENT = -900  # below, the parts would be subnormal
_TOO_LARGE = "an integral of the recorded numbers is beyond 1.8e308: they are no joint's"


def exact_sum(values: Numbers) -> float:
    """Return the sum of finite numbers, rounded once; it depends on no order of them."""
    return exact_sum_of_blocks([values])


def exact_sum_of_blocks(blocks: Iterable[Numbers]) -> float:
    """Return the sum of all numbers of some arrays, rounded once.

    The sum of a long array that is computed block by block is never there as a whole.
    """
    parts: list[float] = []
    for values in blocks:
        if not np.isfinite(values).all():
            raise SeriesError(_TOO_LARGE)
        if values.size < _SMALL:
            parts.extend(values.tolist())
            continue
        for first in range(0, values.size, _SUM_BLOCK):
            _append_exact_parts(values[first : first + _SUM_BLOCK], parts)
    try:
        return math.fsum(parts)
    except OverflowError:
        raise SeriesError(_TOO_LARGE) from None


def _append_exact_parts(block: Numbers, parts: list[float]) -> None:
    """Append numbers whose exact sum is the block's."""
    rest = block
    while True:
        largest = max(float(rest.max()), -float(rest.min()))
        if largest == 0.0:
            return
        exponent = math.frexp(largest)[1]
        if not _LEAST_EXPONENT < exponent < _LARGEST_EXPONENT:
            parts.extend(rest.tolist())
            return
        splitter = math.ldexp(1.0, exponent + _HEADROOM_BITS)
        leading = (rest + splitter) - splitter
        parts.append(float(leading.sum()))
        rest = rest - leading


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
    times, samples = _lines(t, x)
    return _trapezoid(times, samples, lambda t, x: np.abs(x))


def itae(t: ArrayLike, e: ArrayLike) -> float:
    r"""Integral of the time-weighted absolute error, :math:`\int t |e|\,dt`."""
    times, samples = _lines(t, e)
    return _trapezoid(times, samples, lambda t, x: t * np.abs(x))


def square_integral(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of a square, :math:`\int x^2\,dt`: ISE of an error."""
    times, samples = _lines(t, x)
    return _trapezoid(times, samples, lambda t, x: np.square(x))


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
    return math.sqrt(_trapezoid(times, samples, lambda t, x: np.square(x)) / span)


def _trapezoid(t: Numbers, x: Numbers, integrand: Callable[[Numbers, Numbers], Numbers]) -> float:
    """Integrate a function of time and samples; only a block of it is ever in memory."""

    # numpy's own rule changed its name between 1.26 and 2, and sums in an order of its own.
    def areas() -> Iterator[Numbers]:
        for times, samples in zip(_blocks(t), _blocks(x), strict=True):
            with np.errstate(over="ignore", invalid="ignore"):  # the sum refuses what comes of it
                y = integrand(times, samples)
                area = 0.5 * np.diff(times) * (y[1:] + y[:-1])
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
