"""The ideal closed loop of one joint: the law's definition on a double integrator.

The state is x = (e, de/dt, d): position error in [rad], its rate in [rad/s], and what the
integral does not yet compensate of the disturbance, d = (p - I) / inertia in [rad/s^2].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hpid_ros.control.gains import Gains
from hpid_ros.control.norm_arrays import Array, Norm, norm_values


def effective_gains(gains: Gains, inertia: float) -> Gains:
    """Return the gains over the inertia, which are those on the unit double integrator.

    Args:
        gains: Gains in [N m] per unit.
        inertia: What one unit of effort accelerates, in [kg m^2].
    """
    return Gains(gains.p / inertia, gains.i / inertia, gains.d / inertia)


def closed_loop_field(gains: Gains, norm: Norm, states: ArrayLike, inertia: float = 1.0) -> Array:
    r"""Return the time derivative of the closed loop at many states.

    .. math::
        \ddot e = -\tfrac1m(k_p\lambda^2 e + k_d\lambda\dot e) + d, \qquad
        \dot d = -\tfrac1m k_i\lambda^3 e, \qquad \lambda = \|(e, \dot e)\|_d^{\mu}

    Source: the paper, equation (8), with effort u = kp lam^2 e + kd lam de/dt + I on
    m e'' = -u + p and a constant p.

    Args:
        gains: The gains.
        norm: The norm; its degree is the law's. Neither floor nor cap.
        states: Array of shape (..., 3).
        inertia: What one unit of effort accelerates, in [kg m^2].

    Returns:
        Array of the shape of ``states``, in [rad/s], [rad/s^2], [rad/s^3].
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


def dilated(degree: float, states: ArrayLike, s: ArrayLike) -> Array:
    r"""Return :math:`\mathrm{diag}(e^{(1-\mu)s}, e^{s}, e^{(1+\mu)s})\,x` for many states.

    Args:
        degree: Homogeneity degree mu.
        states: Array of shape (..., 3).
        s: Logarithms of the dilation, of a shape that broadcasts with ``states[..., 0]``.
    """
    exponents = np.array([1.0 - degree, 1.0, 1.0 + degree])
    moved: Array = np.exp(np.multiply.outer(np.asarray(s, float), exponents)) * states
    return moved


def state_norm(shape: ArrayLike, degree: float, states: ArrayLike) -> Array:
    """Return the canonical homogeneous norm of states of the closed loop, by bisection.

    The n > 0 that brings the state, dilated by -ln n, onto the sphere x'Px = 1. A certificate's
    P makes it a strict Lyapunov function.

    Args:
        shape: The 3x3 matrix P, positive definite, for which the dilation is monotone.
        degree: Homogeneity degree mu.
        states: Array of shape (..., 3), none of them zero.
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
    norms: Array = np.exp(scale + 0.5 * (low + high))
    return norms
