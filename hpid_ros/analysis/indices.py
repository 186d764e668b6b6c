r"""Performance indices of a run, and nothing else: arrays in, named numbers out.

IVC, IAVC, ITAE of each joint and the L2 norms over all joints, as in the paper's section
"Experimental assessment of HPID on the mobile manipulator".

Quadrature: the composite trapezoidal rule on the real stamps, second order in the step. A
lost sample is bridged by a straight line. Every sum is correctly rounded (:func:`math.fsum`),
so that a number depends neither on the order of the joints nor on numpy's version or SIMD width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hpid_ros.analysis.series import JointSeries, RunSeries, SeriesError, require_finite
from hpid_ros.errors import unknown_name


@dataclass(frozen=True)
class Quantity:
    """What a number of this module is called.

    Attributes:
        key: Name of its attribute and of its entry in files.
        symbol: Short name in tables.
        unit: Its unit, without brackets.
        meaning: Plain words.
    """

    key: str
    symbol: str
    unit: str
    meaning: str


IVC = Quantity("ivc", "IVC", "N m", "variation of the effort")
IAVC = Quantity("iavc", "IAVC", "N m s", "effort spent")
ITAE = Quantity("itae", "ITAE", "rad s^2", "time-weighted error")
EFFORT_L2 = Quantity("effort_l2", "||u||", "N m s^0.5", "L2 norm of the effort")
ERROR_L2 = Quantity("error_l2", "||e||", "rad s^0.5", "L2 norm of the error")
INDICES = (IVC, IAVC, ITAE)
NORMS = (EFFORT_L2, ERROR_L2)


@dataclass(frozen=True)
class JointIndices:
    """The three indices of one joint, or their sums over joints.

    Attributes:
        ivc: Total variation of the effort, in [N m].
        iavc: Integral of the absolute effort, in [N m s].
        itae: Integral of the absolute error times the time since the first state, in [rad s^2].
    """

    ivc: float
    iavc: float
    itae: float


@dataclass(frozen=True)
class RunIndices:
    """All numbers of one run.

    Attributes:
        label: Name of the run.
        joints: Indices by joint name, in the run's order.
        totals: Their sums over all joints.
        effort_l2: L2 norm of the effort over all joints, in [N m s^0.5].
        error_l2: L2 norm of the error over all joints, in [rad s^0.5].
    """

    label: str
    joints: Mapping[str, JointIndices]
    totals: JointIndices
    effort_l2: float
    error_l2: float

    def value(self, quantity: Quantity, joint: str | None = None) -> float:
        """Return one number of this run.

        Args:
            quantity: Which one, of :data:`INDICES` or :data:`NORMS`.
            joint: The joint, or None for all of them. A norm has no value for a single joint.

        Raises:
            SeriesError: If the run has no such joint, or a norm is asked of one joint.
        """
        if quantity in NORMS:
            if joint is not None:
                raise SeriesError(f"{quantity.symbol} is over all joints, got joint {joint!r}")
            return float(getattr(self, quantity.key))
        if joint is not None and joint not in self.joints:
            raise SeriesError(unknown_name("joint", joint, self.joints))
        return float(getattr(self.totals if joint is None else self.joints[joint], quantity.key))

    def as_mapping(self) -> dict[str, object]:
        """Return the numbers with their units as plain dicts, ready for JSON."""
        return {
            "label": self.label,
            "units": {quantity.key: quantity.unit for quantity in (*INDICES, *NORMS)},
            "joints": {name: _as_mapping(indices) for name, indices in self.joints.items()},
            "totals": _as_mapping(self.totals),
            "effort_l2": self.effort_l2,
            "error_l2": self.error_l2,
        }


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
    return math.fsum(np.abs(np.diff(samples)).tolist())


def integral_of_absolute(t: ArrayLike, x: ArrayLike) -> float:
    r"""Integral of an absolute value, :math:`\int |x|\,dt`: the IAVC of an effort.

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
    return math.sqrt(_square_integral(t, x))


def joint_indices(series: JointSeries) -> JointIndices:
    """Return the three indices of one joint; time counts from its first state.

    Args:
        series: The joint.
    """
    return JointIndices(
        ivc=total_variation(series.effort),
        iavc=integral_of_absolute(series.command_time, series.effort),
        itae=itae(series.time, series.error),
    )


def run_indices(run: RunSeries) -> RunIndices:
    """Return all numbers of one run.

    The squares of the L2 norms are sums of the joints' own integrals, which equals the paper's
    integral of the sum and needs no stamps in common.

    Args:
        run: The run.
    """
    joints = {series.joint: joint_indices(series) for series in run.joints}
    totals = {
        q.key: math.fsum(getattr(joint, q.key) for joint in joints.values()) for q in INDICES
    }
    effort = math.fsum(_square_integral(s.command_time, s.effort) for s in run.joints)
    error = math.fsum(_square_integral(s.time, s.error) for s in run.joints)
    return RunIndices(
        label=run.label,
        joints=joints,
        totals=JointIndices(**totals),
        effort_l2=math.sqrt(effort),
        error_l2=math.sqrt(error),
    )


def _as_mapping(indices: JointIndices) -> dict[str, float]:
    return {quantity.key: getattr(indices, quantity.key) for quantity in INDICES}


def _square_integral(t: ArrayLike, x: ArrayLike) -> float:
    times, samples = _lines(t, x)
    return _trapezoid(times, np.square(samples))


def _trapezoid(t: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    # numpy's own rule changed its name between 1.26 and 2, and sums in an order of its own.
    return math.fsum((0.5 * np.diff(t) * (y[1:] + y[:-1])).tolist())


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
