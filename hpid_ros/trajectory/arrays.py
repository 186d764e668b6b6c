"""One joint's column out of a trajectory that came as arrays, checked as a whole.

Nothing here is done point by point: a trajectory of 50 000 points is checked and taken in a few
milliseconds, most of them without Python's lock, so that a loop beside it goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from hpid_ros.errors import TrajectoryError, unknown_name
from hpid_ros.trajectory.joint_trajectory import TrajectoryPoint, require_trajectory
from hpid_ros.trajectory.spline import Column, Knot

_LARGEST = 1e9  # as in joint_trajectory

Numbers = NDArray[np.float64]
Integers = NDArray[np.int64]
Point = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...]]


class KnotArrays(Sequence[Knot]):
    """One joint's knots, each made when it is asked for.

    Args:
        times_ns: Times from the start of the trajectory in [ns].
        positions: In [rad].
        velocities: In [rad/s]; NaN where there is none.
        accelerations: In [rad/s^2], likewise.
    """

    def __init__(
        self, times_ns: Integers, positions: Numbers, velocities: Numbers, accelerations: Numbers
    ) -> None:
        self._times_ns, self._positions = times_ns, positions
        self._velocities, self._accelerations = velocities, accelerations

    def __len__(self) -> int:
        """Return the number of knots."""
        return len(self._times_ns)

    @overload
    def __getitem__(self, index: int) -> Knot: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Knot, ...]: ...
    def __getitem__(self, index: int | slice) -> Knot | tuple[Knot, ...]:
        """Return a knot, or some of them."""
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        velocity, acceleration = self._velocities[index], self._accelerations[index]
        return Knot(
            int(self._times_ns[index]),
            float(self._positions[index]),
            None if velocity != velocity else float(velocity),
            None if acceleration != acceleration else float(acceleration),
        )

    def __eq__(self, other: object) -> bool:
        """Tell whether another sequence has the same knots."""
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


def column_from_arrays(
    joint: str,
    names: Sequence[str],
    stamp_ns: int,
    times_ns: Integers,
    derivatives: tuple[Numbers, Numbers, Numbers],
    lengths: Integers,
    point: Callable[[int], Point],
) -> Column:
    """Return one joint's column; what ``JointTrajectory`` refuses is refused here, too.

    Args:
        joint: A joint of the trajectory.
        names: All of its joints.
        stamp_ns: When it starts in [ns]; 0 means with the next state.
        times_ns: Time from start of each point in [ns].
        derivatives: Positions, velocities and accelerations, one row a point. Only rows with one
            number for each joint are looked at.
        lengths: Numbers that each point has in each of them, shape (points, 3), or (1, 3) if all
            have the same.
        point: Returns one point as it came.

    Raises:
        TrajectoryError: As for ``JointTrajectory``, or it has no such joint.
    """
    require_arrays(names, stamp_ns, times_ns, derivatives, lengths, point)
    if joint not in names:
        raise TrajectoryError(unknown_name("joint", joint, names))
    return checked_column(joint, list(names).index(joint), stamp_ns, times_ns, derivatives)


def require_arrays(
    names: Sequence[str],
    stamp_ns: int,
    times_ns: Integers,
    derivatives: tuple[Numbers, Numbers, Numbers],
    lengths: Integers,
    point: Callable[[int], Point],
) -> None:
    """Refuse what ``JointTrajectory`` refuses; the arguments are those of column_from_arrays.

    Raises:
        TrajectoryError: As for ``JointTrajectory``.
    """
    for index in _suspects(len(names), stamp_ns, times_ns, derivatives, lengths):
        _check_alone(names, stamp_ns, point, index)
    # Two points at most: the joints, the stamp, and that there is a point at all.
    _check_alone(names, stamp_ns, point, len(times_ns) - 1)


def checked_column(
    joint: str,
    at: int,
    stamp_ns: int,
    times_ns: Integers,
    derivatives: tuple[Numbers, Numbers, Numbers],
) -> Column:
    """Return one joint's column of a trajectory that :func:`require_arrays` let pass.

    Args:
        joint: The joint.
        at: Its place among the names.
        stamp_ns: When the trajectory starts in [ns].
        times_ns: Time from start of each point in [ns].
        derivatives: As for :func:`column_from_arrays`.
    """
    none = np.full(len(times_ns), np.nan)
    p, v, a = (each[:, at].copy() if each.shape[1] else none for each in derivatives)
    return Column(joint, KnotArrays(times_ns, p, v, a), stamp_ns)


def _suspects(
    joints: int,
    stamp_ns: int,
    times_ns: Integers,
    derivatives: tuple[Numbers, Numbers, Numbers],
    lengths: Integers,
) -> list[int]:
    """Return the first points of each kind of fault, in their order."""
    if len(times_ns) == 0:
        return []
    suspects = [0]
    wrong = np.flatnonzero(np.diff(times_ns) <= 0)
    suspects += [int(wrong[0]) + 1] if len(wrong) else []
    odd = (lengths != joints) & ((lengths != 0) | [True, False, False])
    wrong = np.flatnonzero(odd.any(axis=1))
    suspects += [int(wrong[0])] if len(wrong) else []
    for k, each in enumerate(derivatives):
        if each.shape[1] == joints:
            bad = ~(np.abs(each) <= _LARGEST).all(axis=1) & (lengths[:, k] == joints)
            suspects += [int(np.argmax(bad))] if bad.any() else []
    return sorted(suspects)


def _check_alone(
    names: Sequence[str], stamp_ns: int, point: Callable[[int], Point], index: int
) -> None:
    """Check one point with the one before it, and what holds for all."""
    first = max(0, index - 1)
    points = [TrajectoryPoint(*point(k)) for k in range(first, index + 1)]
    require_trajectory(names, points, stamp_ns, first)
