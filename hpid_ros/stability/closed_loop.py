"""The closed loop around one joint, and certificates of its stability as plain data.

The scalar norms of :mod:`hpid_ros.control.norms` are what a loop calls; these give the same
values for many points at once.

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
from hpid_ros.control.norms import CanonicalNorm, WeightedNorm

Norm = WeightedNorm | CanonicalNorm

_NEWTON_STEPS = 60
_TOLERANCE = 1e-14
_LEAST = np.finfo(float).tiny


def require_known_norm(norm: object) -> None:
    """Refuse a norm that is neither weighted nor canonical."""
    if not isinstance(norm, WeightedNorm | CanonicalNorm):
        raise NormError(
            f"the norm must be a WeightedNorm or a CanonicalNorm, not {type(norm).__name__}"
        )


def norm_values(norm: Norm, errors: ArrayLike, rates: ArrayLike) -> Numbers:
    """Return the norm of many points."""
    require_known_norm(norm)
    e, de = np.broadcast_arrays(np.asarray(errors, float), np.asarray(rates, float))
    if isinstance(norm, WeightedNorm):
        power = np.abs(e) ** (1.0 / (1.0 - norm.degree))
        return np.asarray(norm.error_weight * power + norm.rate_weight * np.abs(de))
    (p11, p12), (_, p22) = norm.shape
    return canonical_values(norm.degree, (p11, p12, p22), e, de)


def canonical_values(
    degree: float,
    shape: tuple[float | Numbers, float | Numbers, float | Numbers],
    e: Numbers,
    de: Numbers,
    tolerance: float = _TOLERANCE,
) -> Numbers:
    """Return the canonical norm of many points.

    Newton's method in s = ln n on all points at once. The function is strictly monotone with
    slopes between the eigenvalues of the dilation's generator, so that a bracket exists; a point
    whose step leaves its own bracket is bisected.
    """
    p11, p12, p22 = shape
    r = 1.0 - degree
    # Brought to unit size, the inverse of a subnormal number would overflow.
    e, de = (np.where(np.abs(x) < _LEAST, 0.0, x) for x in (e, de))
    with np.errstate(divide="ignore"):
        scale = np.maximum(np.log(np.abs(e)) / r, np.log(np.abs(de)))
    is_zero = np.isneginf(scale)
    scale = np.where(is_zero, 0.0, scale)
    y1, y2 = e * np.exp(-r * scale), de * np.exp(-scale)
    y1 = np.where(is_zero, 1.0, y1)  # any point that is not zero; its norm is discarded
    first, cross, second = p11 * y1 * y1, 2.0 * p12 * y1 * y2, p22 * y2 * y2
    s = 0.5 * np.log(first + cross + second)
    low, high = np.full_like(s, -np.inf), np.full_like(s, np.inf)
    for _ in range(_NEWTON_STEPS):
        u, v = np.exp(-r * s), np.exp(-s)
        a, b, c = first * (u * u), cross * (u * v), second * (v * v)
        square = a + b + c
        value = np.log(square)
        is_inside = value > 0.0
        np.copyto(low, s, where=is_inside)
        np.copyto(high, s, where=~is_inside)
        step = 0.5 * value * square / (r * a + 0.5 * (1.0 + r) * b + c)
        after = s + step
        outside = (after < low) | (after > high)
        if outside.any():
            middle = np.where(np.isfinite(low + high), 0.5 * (low + high), after)
            after = np.where(outside, middle, after)
        moved = np.abs(after - s) > tolerance * (1.0 + np.abs(after))
        s = after
        if not moved.any():
            break
    return np.asarray(np.where(is_zero, 0.0, np.exp(scale + s)))


def unit_curve(norm: Norm, count: int) -> Numbers:
    """Return points on the curve norm = 1, closely spaced near the axes."""
    require_known_norm(norm)
    angle = np.linspace(0.0, 0.5 * np.pi, count)
    if isinstance(norm, WeightedNorm):
        share = np.sin(angle) ** 2
        error = (share / norm.error_weight) ** (1.0 - norm.degree)
        rate = (1.0 - share) / norm.rate_weight
        quadrant = np.stack([error, rate], axis=1)
        signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
        return (signs[:, None, :] * quadrant[None, :, :]).reshape(-1, 2)
    around = (angle[None, :] + 0.5 * np.pi * np.arange(4.0)[:, None]).ravel()
    (p11, p12), (_, p22) = norm.shape
    # Directions are spread evenly in units in which P has a unit diagonal.
    direction = np.stack([np.cos(around) / np.sqrt(p11), np.sin(around) / np.sqrt(p22)], axis=1)
    square = (
        p11 * direction[:, 0] ** 2
        + 2.0 * p12 * direction[:, 0] * direction[:, 1]
        + p22 * direction[:, 1] ** 2
    )
    return np.asarray(direction / np.sqrt(square)[:, None])


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
    n = norm_values(norm, error, rate)
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
                    "norms": [_norm_to_mapping(norm) for norm in span.norms],
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
                    norms=tuple(_norm_from_mapping(norm) for norm in span["norms"]),
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


def _norm_to_mapping(norm: Norm) -> dict[str, Any]:
    if isinstance(norm, WeightedNorm):
        return {
            "type": "weighted",
            "degree": norm.degree,
            "error_weight": norm.error_weight,
            "rate_weight": norm.rate_weight,
        }
    if isinstance(norm, CanonicalNorm):
        shape = [list(row) for row in norm.shape]
        return {"type": "canonical", "degree": norm.degree, "shape": shape}
    raise SettingError(f"a certificate of a {type(norm).__name__} cannot be saved")


def _norm_from_mapping(mapping: Mapping[str, Any]) -> Norm:
    if mapping["type"] == "weighted":
        return WeightedNorm(mapping["degree"], mapping["error_weight"], mapping["rate_weight"])
    if mapping["type"] == "canonical":
        return CanonicalNorm(mapping["degree"], mapping["shape"])
    raise SettingError(f"a norm must be weighted or canonical, not {mapping['type']!r}")
