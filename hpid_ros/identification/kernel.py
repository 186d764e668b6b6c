r"""A zero-phase low pass for sampled signals and its derivatives, by one compact kernel.

Weak form: an equation of motion is multiplied by a kernel :math:`g(t - s)` and integrated over s;
integration by parts moves every derivative from the position to the kernel, which is known
exactly (Shinbrot, "On the analysis of linear and nonlinear systems", Trans. ASME 79, 1957). All
columns of the equation and its effort pass the same kernel: no phase comes between them, and
where they are linear in the position its shape cancels out. It ends after a few periods of
its cut-off frequency, so that a gap in a recording costs just the time around it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import make_interp_spline

from hpid_ros.base.arrays import Numbers

_HALF_WIDTH = 2.0  # periods of the cut-off frequency
_POWER = 4  # of the window (1 - x^2): its spectrum falls with the fifth power
_DEGREE = 7
_NODES = 801
_MOMENTS = 4
DERIVATIVES = (0, 1, 2)


class Kernel:
    """A symmetric low pass of compact support, and its first two derivatives."""

    def __init__(self, cutoff: float) -> None:
        self.cutoff = cutoff
        self.half_width = _HALF_WIDTH / cutoff
        at = np.linspace(-1.0, 1.0, _NODES)
        shape = np.sinc(2.0 * _HALF_WIDTH * at) * (1.0 - at**2) ** _POWER
        spline = make_interp_spline(at, shape, k=_DEGREE)
        area = float(spline.integrate(-1.0, 1.0))
        scale = self.half_width
        self._of = [
            (spline.derivative(order) if order else spline, 1.0 / (area * scale ** (order + 1)))
            for order in DERIVATIVES
        ]
        powers = [make_interp_spline(at, shape * at**p, k=_DEGREE) for p in range(_MOMENTS)]
        self._moments = [
            float(each.integrate(-1.0, 1.0)) / area * scale**p for p, each in enumerate(powers)
        ]

    def taps(self, offsets: Numbers, spacing: float, order: int) -> Numbers:
        """Return the weights of evenly spaced samples that give a smoothed derivative at 0.

        The moments of these sums are those of the integrals, so that a constant has no
        derivative, whatever the sampling.
        """
        spline, factor = self._of[order]
        sign = -1.0 if order % 2 else 1.0
        taps = sign * factor * spacing * spline(offsets / self.half_width)
        scaled = offsets / self.half_width
        rows = np.vander(scaled, _MOMENTS, increasing=True).T
        wanted = np.zeros(_MOMENTS)
        for power in range(order, _MOMENTS):
            descent = math.factorial(power) / math.factorial(power - order)
            wanted[power] = descent * self._moments[power - order] / self.half_width**power
        missing = wanted - rows @ taps
        weights = (1.0 - np.minimum(scaled**2, 1.0)) ** _POWER
        correction: Numbers = weights * (
            rows.T @ np.linalg.solve((rows * weights) @ rows.T, missing)
        )
        return np.asarray(taps + correction, dtype=np.float64)
