"""One joint's column out of a trajectory that came as arrays, checked as a whole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hpid_ros.errors import TrajectoryError
from hpid_ros.trajectory.joint_trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.trajectory.spline import Column, Knot

_LARGEST = 1e9  # as in joint_trajectory

Numbers = NDArray[np.float64]


def column_from_arrays(
    joint: str,
    names: Sequence[str],
    stamp_ns: int,
    times_ns: NDArray[np.int64],
    derivatives: tuple[Numbers, Numbers, Numbers],
) -> Column:
    """Return one joint's column; what :class:`JointTrajectory` refuses is refused here, too.

    Args:
        joint: A joint of the trajectory.
        names: All of its joints.
        stamp_ns: When it starts in [ns]; 0 means with the next state.
        times_ns: Time from start of each point in [ns].
        derivatives: Positions, velocities and accelerations, shape (points, joints); the latter
            two without columns where there are none.

    Raises:
        TrajectoryError: As for :class:`JointTrajectory`, or it has no such joint.
    """
    require_trajectory(names, stamp_ns, times_ns, derivatives)
    if joint not in names:
        raise TrajectoryError(f"the trajectory lacks the joint {joint!r}")
    return checked_column(joint, list(names).index(joint), stamp_ns, times_ns, derivatives)


def require_trajectory(
    names: Sequence[str],
    stamp_ns: int,
    times_ns: NDArray[np.int64],
    derivatives: tuple[Numbers, Numbers, Numbers],
) -> None:
    """Raise TrajectoryError for what :class:`JointTrajectory` refuses.

    Args:
        names: The joints.
        stamp_ns: As for :func:`column_from_arrays`.
        times_ns: Likewise.
        derivatives: Likewise.
    """
    for index in _suspects(len(names), stamp_ns, times_ns, derivatives):
        _check_alone(names, stamp_ns, times_ns, derivatives, index)
    # Two points at most: the joints, the stamp, and that there is a point at all.
    _check_alone(names, stamp_ns, times_ns, derivatives, len(times_ns) - 1)


def checked_column(
    joint: str,
    at: int,
    stamp_ns: int,
    times_ns: NDArray[np.int64],
    derivatives: tuple[Numbers, Numbers, Numbers],
) -> Column:
    """Return one joint's column of a trajectory that :func:`require_trajectory` let pass.

    Args:
        joint: The joint.
        at: Its place among the names.
        stamp_ns: As for :func:`column_from_arrays`.
        times_ns: Likewise.
        derivatives: Likewise.
    """
    rows = [
        each[:, at].tolist() if each.shape[1] else [None] * len(times_ns) for each in derivatives
    ]
    knots = tuple(map(Knot._make, zip(times_ns.tolist(), *rows, strict=True)))
    return Column(joint, knots, stamp_ns)


def _suspects(
    joints: int,
    stamp_ns: int,
    times_ns: NDArray[np.int64],
    derivatives: tuple[Numbers, Numbers, Numbers],
) -> list[int]:
    """Return the first points of each kind of fault, in their order."""
    if len(times_ns) == 0:
        return []
    suspects = [0]
    wrong = np.flatnonzero(np.diff(times_ns) <= 0)
    suspects += [int(wrong[0]) + 1] if len(wrong) else []
    for each in derivatives:
        if each.shape[1] == joints:
            bad = np.flatnonzero(~(np.abs(each) <= _LARGEST).all(axis=1))
            suspects += [int(bad[0])] if len(bad) else []
    return sorted(suspects)


def _check_alone(
    names: Sequence[str],
    stamp_ns: int,
    times_ns: NDArray[np.int64],
    derivatives: tuple[Numbers, Numbers, Numbers],
    index: int,
) -> None:
    """Check one point with the one before it, and what holds for all."""
    points = []
    for k in range(max(0, index - 1), index + 1):
        row = (tuple(each[k].tolist()) for each in derivatives)
        points.append(TrajectoryPoint(int(times_ns[k]), *row))
    first = max(0, index - 1)
    try:
        JointTrajectory(tuple(names), tuple(points), stamp_ns)
    except TrajectoryError as error:
        if first == 0:
            raise
        raise TrajectoryError(f"{error} (counted from point {first})") from None
