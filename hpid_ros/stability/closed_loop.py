"""The ideal closed loop of one joint, and the homogeneous norms on whole arrays.

The scalar norms of :mod:`hpid_ros.control.norms` are what a loop calls; these give the same
values for many points at once.

The state is x = (e, de/dt, d): position error in [rad], its rate in [rad/s], and what the
integral does not yet compensate of the disturbance, d = (p - I) / inertia in [rad/s^2].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import NormError
from hpid_ros.control.gains import Gains
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
        weighted: Numbers = norm.error_weight * power + norm.rate_weight * np.abs(de)
        return weighted
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
    norms: Numbers = np.where(is_zero, 0.0, np.exp(scale + s))
    return norms


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
    points: Numbers = direction / np.sqrt(square)[:, None]
    return points


def effective_gains(gains: Gains, inertia: float) -> Gains:
    """Return the gains over the inertia, which are those on the unit double integrator."""
    return Gains(gains.p / inertia, gains.i / inertia, gains.d / inertia)


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
    moved: Numbers = np.exp(np.multiply.outer(np.asarray(s, float), exponents)) * states
    return moved


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
    norms: Numbers = np.exp(scale + 0.5 * (low + high))
    return norms
