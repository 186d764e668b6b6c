"""The closed loop around one joint, and certificates of its stability as plain data.

The state is x = (e, de/dt, d): position error in [rad], its rate in [rad/s], and what the
integral does not yet compensate of the disturbance, d = (p - I) / inertia in [rad/s^2].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.base.errors import HpidError, NormError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.norms import Norm, norm_from_mapping

_AGREEMENT = 1e-9  # relative, of a norm's two forms
_ROUNDING = 1e-10  # relative, of points that are on the curve
_POINTS = 3  # in each quadrant


def require_certifiable_norm(norm: object) -> None:
    """Refuse a norm whose certificate would not be that of the loop.

    What a loop calls must be its array form, and scale as its degree says.
    """
    name = type(norm).__name__
    if not isinstance(norm, Norm):
        raise NormError(
            f"a norm is certified by its array form: derive {name} from hpid_ros.control.Norm, "
            "with values next to __call__"
        )
    with np.errstate(all="ignore"):  # what is no norm may be zero or not a number
        curve = unit_curve(norm, _POINTS)
        points = np.concatenate([curve, curve * (np.e ** (1.0 - norm.degree), np.e)])
        values = norm.values(*points.T)
        expected = np.repeat([1.0, np.e], len(curve))
        for (error, rate), value, size in zip(
            points.tolist(), values.tolist(), expected.tolist(), strict=True
        ):
            where = f"at {error:.3g} rad and {rate:.3g} rad/s"
            if not abs(value - size) <= _AGREEMENT * size:
                raise NormError(
                    f"{name} is not homogeneous of degree {norm.degree:g}: {where} it is "
                    f"{value:.3g}, not {size:.3g}"
                )
            number = norm(error, rate)
            if not abs(number - value) <= _AGREEMENT * value:
                raise NormError(
                    f"{name} is {number:.3g} in the loop and {value:.3g} in its array form "
                    f"{where}: __call__ and values must be one function"
                )


def unit_curve(norm: Norm, count: int) -> Numbers:
    """Return points on the curve norm = 1, closely spaced near the axes."""
    points = norm.directions(count)
    values = norm.values(*points.T)
    if np.abs(values - 1.0).max() <= _ROUNDING:
        return points
    return np.asarray(points / values[:, None] ** (1.0 - norm.degree, 1.0))


class ScaledGains(NamedTuple):
    """Gains times factors: no parameters, and not held to their range."""

    p: float
    i: float
    d: float


def effective_gains(gains: Gains, inertia: float) -> ScaledGains:
    """Return the gains over the inertia, which are those on the unit double integrator."""
    return ScaledGains(gains.p / inertia, gains.i / inertia, gains.d / inertia)


def closed_loop_field(
    gains: Gains, norm: Norm, states: ArrayLike, inertia: float = 1.0
) -> Numbers:
    r"""Return the time derivative of the closed loop at many states.

    .. math::
        \ddot e = -\tfrac1m(k_p\lambda^2 e + k_d\lambda\dot e) + d, \qquad
        \dot d = -\tfrac1m k_i\lambda^3 e, \qquad \lambda = \|(e, \dot e)\|_d^{\mu}

    Source: the paper, equation (8), with effort u = kp lam^2 e + kd lam de/dt + I on
    m e'' = -u + p and a constant p.
    """
    x = np.asarray(states, float)
    error, rate, disturbance = x[..., 0], x[..., 1], x[..., 2]
    n = norm.values(error, rate)
    # At n = 0 error and rate are zero, and so are the terms, whatever the multiplier is.
    multiplier = np.where(n > 0.0, n, 1.0) ** norm.degree
    proportional = gains.p * multiplier**2 * error
    derivative = gains.d * multiplier * rate
    integral_rate = gains.i * multiplier**3 * error
    return np.stack(
        [rate, disturbance - (proportional + derivative) / inertia, -integral_rate / inertia],
        axis=-1,
    )


def dilated(degree: float, states: ArrayLike, s: ArrayLike) -> Numbers:
    r"""Return :math:`\mathrm{diag}(e^{(1-\mu)s}, e^{s}, e^{(1+\mu)s})\,x` for many states."""
    exponents = np.array([1.0 - degree, 1.0, 1.0 + degree])
    return np.asarray(np.exp(np.multiply.outer(np.asarray(s, float), exponents)) * states)


def state_norm(shape: ArrayLike, degree: float, states: ArrayLike) -> Numbers:
    """Return the canonical homogeneous norm of states of the closed loop, by bisection.

    The n > 0 that brings the state, dilated by -ln n, onto the sphere x'Px = 1. A certificate's
    P makes it a strict Lyapunov function.
    """
    x, p = np.asarray(states, float), np.asarray(shape, float)
    exponents = np.array([1.0 - degree, 1.0, 1.0 + degree])
    with np.errstate(divide="ignore"):
        scale = (np.log(np.abs(x)) / exponents).max(axis=-1)
    unit = dilated(degree, x, -scale)
    low, high = np.full(scale.shape, -200.0), np.full(scale.shape, 200.0)
    for _ in range(70):
        middle = 0.5 * (low + high)
        y = dilated(degree, unit, -middle)
        is_outside = np.einsum("...i,ij,...j->...", y, p, y) > 1.0
        low, high = np.where(is_outside, middle, low), np.where(is_outside, high, middle)
    return np.asarray(np.exp(scale + 0.5 * (low + high)))


Matrix = tuple[tuple[float, ...], ...]


def as_matrix(values: Numbers) -> Matrix:
    return tuple(map(tuple, values.tolist()))


FORMAT = "hpid_ros certificate 1"


@dataclass(frozen=True)
class CertifiedSpan:
    """One P that certifies a loop at several neighbouring degrees."""

    inertia: float  # [kg m^2] what one unit of effort accelerates
    # the law's norm at each degree, from the span's lower end to its upper one
    norms: tuple[Norm, ...]
    # symmetric 3x3 matrix P on (e [rad], de/dt [rad/s], (p - I)/inertia [rad/s^2])
    shape: Matrix
    rate: float  # [1/s] how fast the field enters the sphere x'Px = 1 where it does so slowest

    @property
    def lower(self) -> float:
        return self.norms[0].degree

    @property
    def upper(self) -> float:
        return self.norms[-1].degree


@dataclass(frozen=True)
class Certificate:
    """That a loop is stable in an interval of degrees, with all that is needed to check it."""

    gains: Gains  # gains of the loop
    spans: tuple[CertifiedSpan, ...]  # the spans, in order of inertia, then of degree

    def __post_init__(self) -> None:
        if not self.spans:
            raise SettingError("a certificate must hold at least one span of degrees, not none")
        for span in self.spans:
            degrees = [norm.degree for norm in span.norms]
            if not degrees or degrees != sorted(set(degrees)):
                raise SettingError(f"the degrees of a span must rise, not be {degrees}")
        for before, after in zip(self.spans, self.spans[1:], strict=False):
            if before.inertia == after.inertia and before.upper != after.lower:
                raise SettingError(
                    f"the spans of a certificate must follow each other, not end at "
                    f"{before.upper:g} and begin at {after.lower:g}"
                )

    @property
    def inertias(self) -> tuple[float, ...]:
        """The inertias that were certified, in [kg m^2]."""
        return tuple(sorted({span.inertia for span in self.spans}))

    @property
    def lower(self) -> float:
        """The least degree that is certified for every inertia."""
        return max(
            min(span.lower for span in self.spans if span.inertia == inertia)
            for inertia in self.inertias
        )

    @property
    def upper(self) -> float:
        """The largest degree that is certified for every inertia."""
        return min(
            max(span.upper for span in self.spans if span.inertia == inertia)
            for inertia in self.inertias
        )

    def contains(self, degree: float) -> bool:
        return self.lower <= degree <= self.upper

    def to_mapping(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "gains": {"p": self.gains.p, "i": self.gains.i, "d": self.gains.d},
            "spans": [
                {
                    "inertia": span.inertia,
                    "rate": span.rate,
                    "shape": [list(row) for row in span.shape],
                    "norms": [norm.to_mapping() for norm in span.norms],
                }
                for span in self.spans
            ],
        }

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Certificate:
        """Return the certificate that :meth:`to_mapping` gave."""
        if not isinstance(mapping, Mapping) or mapping.get("format") != FORMAT:
            raise SettingError(f"a certificate's format must be {FORMAT!r}")
        try:
            gains = Gains(*(float(mapping["gains"][term]) for term in "pid"))
            spans = tuple(
                CertifiedSpan(
                    inertia=float(span["inertia"]),
                    norms=tuple(norm_from_mapping(norm) for norm in span["norms"]),
                    shape=tuple(tuple(float(x) for x in row) for row in span["shape"]),
                    rate=float(span["rate"]),
                )
                for span in mapping["spans"]
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, HpidError):
                raise
            raise SettingError(f"a certificate lacks or misshapes an entry: {error!r}") from None
        return cls(gains, spans)
