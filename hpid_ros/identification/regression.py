r"""Linear regression whose columns have noise and whose residuals are correlated in time.

Least squares are biased where columns have noise. Instrumental variables z are correlated with a
column but not with its noise, and estimates are those for which the residual has nothing in
common with them,

.. math:: \sum_t z_t (y_t - x_t^T \theta) = 0

Covariances are robust to residuals whose size changes and that are correlated over many rows
(Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation
consistent covariance matrix", Econometrica 55, 1987), and intervals use critical values that know
over how many (Kiefer and Vogelsang, "A new asymptotic theory for
heteroskedasticity-autocorrelation robust tests", Econometric Theory 21, 2005).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from hpid_ros.base.arrays import Numbers

_LEAST_LAGS = 32  # rows; twice the width of the kernel
_UNCORRELATED = 0.05
_CORRELATION_TIMES = 4.0
_MOST_LAGS = 0.2  # of all rows


class Regression(NamedTuple):
    """A fit of R rows by P columns."""

    values: Numbers  # coefficients, (P,)
    covariance: Numbers  # of them, (P, P)
    critical: float  # half-width of a 95 % interval over the standard deviation
    residual: Numbers  # of each row, (R,); zero where a row has no weight
    rms: float  # root mean square of the residual
    condition: float  # condition number of the columns, each of them scaled to unit length
    sharing: Numbers

    @property
    def deviations(self) -> Numbers:
        """Standard deviations of the coefficients, (P,)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))

    def probability_of_none(self, places: list[int]) -> float:
        """Return the probability that coefficients which are zero would seem this large."""
        theta, block = self.values[places], self.covariance[np.ix_(places, places)]
        shrunk = (1.959964 / self.critical) ** 2
        statistic = float(theta @ np.linalg.pinv(block) @ theta) * shrunk
        return float(chi2.sf(statistic, len(places)))


def regress(
    instruments: Numbers, columns: Numbers, effort: Numbers, weight: Numbers
) -> Regression:
    """Fit efforts by columns, with one or two versions of everything."""
    x, y = columns * weight, effort * weight
    size = np.sqrt(np.mean(x**2, axis=(0, 2)) + 1e-300)[:, None]
    x, z = x / size, instruments * weight / size
    inverse = np.linalg.pinv(np.einsum("hpr,hqr->pq", z, x), rcond=1e-13)
    scaled = inverse @ np.einsum("hpr,hr->p", z, y)
    errors = y - np.einsum("p,hpr->hr", scaled, x)
    moments = np.einsum("hpr,hr->pr", z, errors)
    rows = int(np.count_nonzero(weight))
    residual = np.asarray(errors.mean(axis=0))
    lags = min(_lags(residual), max(1, int(_MOST_LAGS * rows)))
    freedom = rows / max(rows - len(scaled), 1)
    covariance = inverse @ _long_run(moments, lags) @ inverse.T * freedom
    left = float(np.mean(residual[weight > 0.0] ** 2))
    mean = x.mean(axis=0)
    singular = np.linalg.svd(mean[:, weight > 0.0], compute_uv=False)
    gram = mean @ mean.T
    return Regression(
        values=scaled / size[:, 0],
        covariance=covariance / (size * size.T),
        critical=_critical(lags / max(rows, 1)),
        residual=residual,
        rms=float(np.sqrt(left)),
        condition=float(singular[0] / max(singular[-1], 1e-300)),
        sharing=np.diagonal(np.linalg.pinv(gram)) * np.diagonal(gram),
    )


def _lags(residual: Numbers) -> int:
    """Return over how many rows residuals are taken to be correlated."""
    spectrum = np.abs(np.fft.rfft(residual, 2 * len(residual))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(residual)]
    if correlation[0] <= 0.0:
        return _LEAST_LAGS
    small = np.flatnonzero(correlation < _UNCORRELATED * correlation[0])
    first = int(small[0]) if len(small) else len(residual)
    time = float(np.sum(correlation[:first])) / float(correlation[0])
    return max(_LEAST_LAGS, round(_CORRELATION_TIMES * time))


def _long_run(moments: Numbers, lags: int) -> Numbers:
    """Return the sum of the moments' autocovariances, by Bartlett's weights, (P, P)."""
    total = moments @ moments.T
    for lag in range(1, lags + 1):
        shifted = moments[:, lag:] @ moments[:, :-lag].T
        total = total + (1.0 - lag / (lags + 1.0)) * (shifted + shifted.T)
    return np.asarray(total)


def _critical(share: float) -> float:
    """Return the 97.5 % point for Bartlett's weights over a share of all rows."""
    return 1.9600 + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3
