r"""Homogeneous norms of one joint's error state.

The dilation is :math:`d(s) = \mathrm{diag}(e^{(1-\mu)s}, e^{s})` on (error, error rate). A
homogeneous norm is continuous, positive definite and scales as :math:`\|d(s)x\|_d = e^s \|x\|_d`.

Source: the paper, section "Homogeneous norm".

A class is all that there is of a norm: what a loop calls, the same for many points at once, which
certificates need, its names in parameters and in C, and what of it is saved.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from hpid_ros.base.errors import NormError, SettingError
from hpid_ros.base.units import Numbers

DEGREE_LIMIT = 0.5
"""Degrees lie strictly between minus and plus this."""

GOOD_SAMPLING_MARGIN = 0.25
"""T kd lam / m up to which sampling is not felt; see
:func:`~hpid_ros.stability.gain_check.sampling_margin`."""


def require_degree(degree: float) -> None:
    """Refuse a homogeneity degree that the law does not allow."""
    if not -DEGREE_LIMIT < degree < DEGREE_LIMIT:
        raise NormError(f"the degree mu must lie in (-0.5, 0.5), not {degree}")


class Norm(ABC):
    """A homogeneous norm of one degree.

    A norm of one's own needs ``degree``, ``__call__`` and ``values``. Both must be the same
    function: what is certified is that of ``values``, and a certificate is refused where they
    differ. One that parameters can name is in :data:`NORMS`, and has all that is here.

    Attributes:
        degree: Homogeneity degree mu, in (-0.5, 0.5).
    """

    __slots__ = ()

    type: ClassVar[str] = ""  # its name in norm.type, and in C
    c_function: ClassVar[str] = ""  # its name in tuning/templates/loop.c; empty: not exported
    constants: ClassVar[tuple[str, ...]] = ()  # what it is made of, after its degree

    degree: float

    @classmethod
    def scaled(cls, degree: float, error_scale: float, rate_weight: float) -> Norm:
        """Return the norm that is 1 for an error of ``error_scale`` at rest.

        It is a function of error / error_scale and rate_weight x error rate alone: certificates
        of loops that differ by their units are computed once.

        Args:
            degree: Homogeneity degree mu, in (-0.5, 0.5).
            error_scale: e_max in [rad].
            rate_weight: Weight of the error rate, in [s/rad].

        Raises:
            NormError: There is no such norm.
        """
        raise NormError(f"a {cls.__name__} is not made of norm.error_scale and norm.rate_weight")

    @abstractmethod
    def __call__(self, error: float, error_rate: float) -> float:
        """Return the norm; zero only at the origin.

        Args:
            error: Reference minus measured position, in [rad].
            error_rate: Its time derivative, in [rad/s].
        """

    @abstractmethod
    def values(self, errors: Numbers, rates: Numbers) -> Numbers:
        """Return the norm of many points.

        Args:
            errors: In [rad], of any shape.
            rates: In [rad/s], of the same shape.
        """

    def directions(self, count: int) -> Numbers:
        """Return points in all directions, closely spaced near the axes.

        Args:
            count: Points in each quadrant, the axes included.

        Returns:
            Error in [rad] and error rate in [rad/s], of shape (4 count, 2), of any norm.
        """
        error, rate = self.values(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
        return _quadrants(count, self.degree, error, rate)

    def to_mapping(self) -> dict[str, Any]:
        """Return what of it is saved in a certificate, as plain data."""
        if NORMS.get(self.type) is not type(self):
            raise SettingError(f"a certificate of a {type(self).__name__} cannot be saved")
        own = {name: np.asarray(getattr(self, name)).tolist() for name in self.constants}
        return {"type": self.type, "degree": self.degree, **own}

    def __repr__(self) -> str:
        values = [self.degree, *(getattr(self, name) for name in self.constants)]
        return f"{type(self).__name__}({', '.join(map(str, values))})"


def norm_from_mapping(mapping: Mapping[str, Any]) -> Norm:
    """Return the norm that :meth:`Norm.to_mapping` gave."""
    kind: Any = NORMS.get(str(mapping["type"]))
    if kind is None:
        raise SettingError(f"a norm must be {' or '.join(NORMS)}, not {mapping['type']!r}")
    norm: Norm = kind(mapping["degree"], *(mapping[name] for name in kind.constants))
    return norm


def _quadrants(count: int, degree: float, error_weight: float, rate_weight: float) -> Numbers:
    """Return points on the curve of the weighted norm, closely spaced near the axes."""
    share = np.sin(np.linspace(0.0, 0.5 * np.pi, count)) ** 2
    error = (share / error_weight) ** (1.0 - degree)
    rate = (1.0 - share) / rate_weight
    quadrant = np.stack([error, rate], axis=1)
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    return np.asarray((signs[:, None, :] * quadrant[None, :, :]).reshape(-1, 2))


@dataclass(frozen=True, slots=True, repr=False)
class WeightedNorm(Norm):
    r"""Weighted homogeneous norm.

    .. math:: \|(e, \dot e)\|_d = \gamma_1 |e|^{1/(1-\mu)} + \gamma_2 |\dot e|

    Source: the paper, section "Homogeneous norm", weights r = (1 - mu, 1).

    Args:
        degree: Homogeneity degree mu, in (-0.5, 0.5).
        error_weight: gamma_1, in [1 / rad^{1/(1-mu)}].
        rate_weight: gamma_2, in [s/rad].

    Raises:
        NormError: The degree is out of range or a weight is not positive and finite.
    """

    # Frozen: a law writes it out with the constants that it has when the law is made.
    type = "weighted"
    c_function = "weighted_norm"
    constants = ("error_weight", "rate_weight")

    degree: float
    error_weight: float
    rate_weight: float
    error_exponent: float = field(init=False)  # 1 / (1 - mu)

    def __post_init__(self) -> None:
        require_degree(self.degree)
        for name in self.constants:
            _require_positive(name, getattr(self, name))
        for name in ("degree", *self.constants):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "error_exponent", 1.0 / (1.0 - self.degree))

    @classmethod
    def scaled(cls, degree: float, error_scale: float, rate_weight: float) -> WeightedNorm:
        r"""Return the norm :math:`(|e|/e_{max})^{1/(1-\mu)} + \gamma_2 |\dot e|`.

        An error of ``error_scale`` at rest has norm 1 whatever the degree.

        Args:
            degree: Homogeneity degree mu, in (-0.5, 0.5).
            error_scale: e_max in [rad], fixed in advance.
            rate_weight: gamma_2 in [s/rad].

        Raises:
            NormError: As for the class, or ``error_scale`` is not positive and finite.
        """
        require_degree(degree)
        _require_positive("error_scale", error_scale)
        try:
            error_weight = float(error_scale) ** (-1.0 / (1.0 - degree))
        except OverflowError:
            raise NormError(f"an error_scale of {error_scale:g} rad is too small") from None
        return cls(degree, error_weight, rate_weight)

    def __call__(self, error: float, error_rate: float) -> float:
        """Return the norm; zero only at the origin."""
        weighted_error: float = self.error_weight * abs(error) ** self.error_exponent
        return weighted_error + self.rate_weight * abs(error_rate)

    def values(self, errors: Numbers, rates: Numbers) -> Numbers:
        """Return the norm of many points.

        Args:
            errors: In [rad], of any shape.
            rates: In [rad/s], of the same shape.
        """
        power = np.abs(errors) ** self.error_exponent
        return np.asarray(self.error_weight * power + self.rate_weight * np.abs(rates))

    def directions(self, count: int) -> Numbers:
        """Return points of norm 1, closely spaced near the axes.

        Args:
            count: Points in each quadrant, the axes included.
        """
        return _quadrants(count, self.degree, self.error_weight, self.rate_weight)


class CanonicalNorm(Norm):
    r"""Canonical homogeneous norm: the n > 0 with :math:`\|d(-\ln n)\,x\|_P = 1`.

    Source: the paper, equation (3), with the weighted Euclidean norm of P; monotone if and only
    if :math:`P \succ 0` and :math:`PG + GP \succ 0` for G = diag(1 - mu, 1), which is
    :math:`4(1-\mu)p_{11}p_{22} > (2-\mu)^2 p_{12}^2`.

    Args:
        degree: Homogeneity degree mu, in (-0.5, 0.5).
        shape: The symmetric 2x2 matrix P, rows or nested sequences.

    Raises:
        NormError: The degree is out of range, or P is not a finite symmetric positive definite
            2x2 matrix for which the dilation is monotone.
    """

    __slots__ = ("_fastest", "_p11", "_p12", "_p22", "_slowest", "degree")

    type = "canonical"
    c_function = "canonical_norm"
    constants = ("shape",)

    _SLOPE_MARGIN = 1e-6
    _TOLERANCE = 1e-15
    _ITERATIONS_AT_MOST = 60
    _SMALLEST = -400.0  # of ln n: exp(1.5 * 400) is still finite

    def __init__(self, degree: float, shape: Sequence[Sequence[float]]) -> None:
        require_degree(degree)
        p11, p12, p22 = _checked_shape(shape)
        if not 4.0 * (1.0 - degree) * p11 * p22 > ((2.0 - degree) * p12) ** 2:
            raise NormError(
                f"the dilation of degree {degree} is not monotone for P = [[{p11:g}, {p12:g}], "
                f"[{p12:g}, {p22:g}]]: 4 (1 - mu) p11 p22 = {4 * (1 - degree) * p11 * p22:g} must "
                f"exceed (2 - mu)^2 p12^2 = {((2 - degree) * p12) ** 2:g}"
            )
        self.degree = float(degree)
        self._p11, self._p12, self._p22 = p11, p12, p22
        self._slowest, self._fastest = self._slopes()

    @classmethod
    def scaled(cls, degree: float, error_scale: float, rate_weight: float) -> CanonicalNorm:
        r"""Return the norm of :math:`P = \mathrm{diag}(e_{max}^{-2}, \gamma_2^2)`.

        An error of ``error_scale`` at rest has norm 1 whatever the degree.

        Args:
            degree: Homogeneity degree mu, in (-0.5, 0.5).
            error_scale: e_max in [rad], fixed in advance.
            rate_weight: gamma_2 in [s/rad].

        Raises:
            NormError: As for the class.
        """
        try:
            shape = (error_scale**-2, 0.0), (0.0, rate_weight**2)
        except (OverflowError, ZeroDivisionError):
            raise NormError(
                f"an error_scale of {error_scale:g} rad and a rate_weight of "
                f"{rate_weight:g} s/rad are too small or too large for a canonical norm"
            ) from None
        return cls(degree, shape)

    @property
    def shape(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The matrix P."""
        return (self._p11, self._p12), (self._p12, self._p22)

    def _slopes(self) -> tuple[float, float]:
        """Return the least and largest slope of -0.5 ln(y'Py) in ln n.

        They are the generalised eigenvalues of ((PG + GP)/2, P), the roots of a quadratic, which
        is a double one when mu p12 = 0; the margin covers what the root loses to rounding then.
        """
        r = 1.0 - self.degree
        a, b, c = r * self._p11, 0.5 * (1.0 + r) * self._p12, self._p22
        quadratic = self._p11 * self._p22 - self._p12**2
        linear = a * self._p22 + c * self._p11 - 2.0 * b * self._p12
        constant = a * c - b * b
        root = math.sqrt(max(linear * linear - 4.0 * quadratic * constant, 0.0))
        fastest = (linear + root) / (2.0 * quadratic)
        slowest = constant / (quadratic * fastest)
        return slowest * (1.0 - self._SLOPE_MARGIN), fastest * (1.0 + self._SLOPE_MARGIN)

    def __call__(self, error: float, error_rate: float) -> float:
        """Return the norm; zero only at the origin.

        Newton's method in s = ln n, safeguarded by bisection; the point is first brought to
        unit size by the dilation itself, so that no square under- or overflows.
        """
        if error == 0.0 and error_rate == 0.0:
            return 0.0
        r = 1.0 - self.degree
        scale = max(
            math.log(abs(error)) / r if error else -math.inf,
            math.log(abs(error_rate)) if error_rate else -math.inf,
        )
        if scale < self._SMALLEST:  # the reciprocal overflows; in two steps it is not needed
            growth = math.exp(-r * 0.5 * scale)
            y1, y2 = error * growth * growth, 0.0
            if error_rate:  # else the growth of what is 0 may overflow
                growth = math.exp(-0.5 * scale)
                y2 = error_rate * growth * growth
        else:
            y1 = error * math.exp(-r * scale)
            y2 = error_rate * math.exp(-scale)
        return math.exp(scale + self._solve(y1, y2))

    def _solve(self, error: float, error_rate: float) -> float:
        """Return s = ln n of a point of about unit size."""
        r, p11, p12, p22 = 1.0 - self.degree, self._p11, self._p12, self._p22
        square = p11 * error * error + 2.0 * p12 * error * error_rate + p22 * error_rate**2
        start = 0.5 * math.log(square)
        ends = (start / self._fastest, start / self._slowest)
        low, high = min(ends) - self._SLOPE_MARGIN, max(ends) + self._SLOPE_MARGIN
        s = min(max(start, low), high)
        for _ in range(self._ITERATIONS_AT_MOST):
            y1, y2 = error * math.exp(-r * s), error_rate * math.exp(-s)
            a, b, c = p11 * y1 * y1, p12 * y1 * y2, p22 * y2 * y2
            square = a + 2.0 * b + c
            value = math.log(square)
            if value > 0.0:
                low = s
            else:
                high = s
            move = value * square / (2.0 * (r * a + (1.0 + r) * b + c))
            if not low <= s + move <= high:
                move = 0.5 * (low + high) - s
            s += move
            if abs(move) <= self._TOLERANCE * (1.0 + abs(s)):
                break
        return s

    def values(self, errors: Numbers, rates: Numbers) -> Numbers:
        """Return the norm of many points.

        Args:
            errors: In [rad], of any shape.
            rates: In [rad/s], of the same shape.
        """
        return canonical_values(self.degree, (self._p11, self._p12, self._p22), errors, rates)

    def directions(self, count: int) -> Numbers:
        """Return points of norm 1, closely spaced near the axes.

        Args:
            count: Points in each quadrant, the axes included.
        """
        angle = np.linspace(0.0, 0.5 * np.pi, count)
        around = (angle[None, :] + 0.5 * np.pi * np.arange(4.0)[:, None]).ravel()
        p11, p12, p22 = self._p11, self._p12, self._p22
        # Directions are spread evenly in units in which P has a unit diagonal.
        direction = np.stack(
            [np.cos(around) / np.sqrt(p11), np.sin(around) / np.sqrt(p22)], axis=1
        )
        square = (
            p11 * direction[:, 0] ** 2
            + 2.0 * p12 * direction[:, 0] * direction[:, 1]
            + p22 * direction[:, 1] ** 2
        )
        return np.asarray(direction / np.sqrt(square)[:, None])


_ARRAY_STEPS = 60
_ARRAY_TOLERANCE = 1e-14
_LEAST = np.finfo(float).tiny


def canonical_values(
    degree: float,
    shape: tuple[float | Numbers, float | Numbers, float | Numbers],
    e: Numbers,
    de: Numbers,
    tolerance: float = _ARRAY_TOLERANCE,
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
    for _ in range(_ARRAY_STEPS):
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


NORMS: Mapping[str, type[Norm]] = {kind.type: kind for kind in (WeightedNorm, CanonicalNorm)}
"""The norms that parameters can name, by the value of norm.type."""


@dataclass(frozen=True)
class NormFamily:
    """A norm for every degree, all of them 1 for an error of ``error_scale`` at rest."""

    type: str  # a name of NORMS
    error_scale: float  # [rad] e_max
    rate_weight: float  # [s/rad] weight of the error rate

    def __call__(self, degree: float) -> Norm:
        """Return the norm of a degree."""
        kind = NORMS.get(self.type)
        if kind is None:
            raise NormError(f"there is no norm of type {self.type!r}")
        return kind.scaled(degree, self.error_scale, self.rate_weight)


def require_floor(floor: float, cap: float) -> None:
    """Refuse a floor of the norm that leaves no room below its cap."""
    if not 0.0 <= floor < cap:
        raise NormError(
            f"the norm's floor must be at least 0 and below its cap {cap}, not {floor}"
        )


def sampling_floor(
    norm: Norm,
    *,
    period: float,
    damping_rate: float,  # [1/s] kd / m
    resolution: float = 0.0,
    filter_time_constant: float = 0.0,
    cap: float = sys.float_info.max,
) -> float:
    """Return the least value of the norm that measurement and sampling can bear.

    The largest of 1e-6; the norm of two encoder steps in position and of the rate that they
    feign behind the velocity filter; and, for a negative degree, the norm at which the gain
    multiplier brings ``T kd lam / m`` to 0.25 (docs/theory.md, Sampling).

    Source: Livne and Levant, "Proper discretization of homogeneous differentiators" (2014), for
    the principle; the numbers were measured on the sampled double integrator.
    """
    floor = 1e-6
    if resolution > 0.0:
        feigned_rate = 2.0 * resolution / (filter_time_constant + period)
        feigned = norm(2.0 * resolution, 0.0) + norm(0.0, feigned_rate)
        if not feigned < cap:
            raise NormError(
                f"the apparent motion of an encoder_resolution of {resolution:g} rad has the norm "
                f"{feigned:.3g}, which is the floor and must lie below norm.cap = {cap:g}"
            )
        floor = max(floor, feigned)
    if norm.degree < 0.0 and damping_rate > 0.0:
        # In logarithms: close to degree zero the floor is too large, or too small, for a number.
        logarithm = math.log(GOOD_SAMPLING_MARGIN) - math.log(period) - math.log(damping_rate)
        log_floor = logarithm / norm.degree
        if not log_floor < math.log(cap):
            least = _power_of_ten(log_floor / math.log(10.0))
            raise NormError(
                f"T kd lam / m must not exceed {GOOD_SAMPLING_MARGIN:g}: with "
                f"T kd / m = {period * damping_rate:g} and mu = {norm.degree:g} that takes a "
                f"norm.floor of {least} or more, and below norm.cap = {cap:g}: lower gains.d "
                f"or the period, choose another mu, or set norm.floor"
            )
        floor = max(floor, math.exp(log_floor))
    return floor


def _power_of_ten(exponent: float) -> str:
    is_number = exponent < sys.float_info.max_10_exp
    return f"{10.0**exponent:.3g}" if is_number else f"10^{exponent:.3g}"


def _require_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise NormError(f"{name} must be positive and finite, not {value}")


def _checked_shape(shape: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    try:
        (p11, p12), (p21, p22) = ((float(x) for x in row) for row in shape)
    except (TypeError, ValueError):
        raise NormError(f"the shape P must be a 2x2 matrix of numbers, not {shape!r}") from None
    if not all(math.isfinite(x) for x in (p11, p12, p21, p22)):
        raise NormError(f"the shape P must be finite, not [[{p11}, {p12}], [{p21}, {p22}]]")
    if p12 != p21:
        raise NormError(f"the shape P must be symmetric, not [[.., {p12:g}], [{p21:g}, ..]]")
    if not (p11 > 0.0 and p11 * p22 > p12 * p12):
        raise NormError(
            f"the shape P must be positive definite: p11 = {p11:g} must exceed 0 and p11 p22 = "
            f"{p11 * p22:g} must exceed p12^2 = {p12 * p12:g}"
        )
    return p11, p12, p22
