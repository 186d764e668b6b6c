"""A trajectory of several joints, and one joint's column of a trajectory of arrays.

Source: ``trajectory_msgs/msg/JointTrajectory``; the checks are those with which
``joint_trajectory_controller`` rejects a message.

Nothing here is done point by point: a trajectory of 50 000 points is checked and taken in a few
milliseconds, most of them without Python's lock, so that a loop beside it goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import TrajectoryError, unknown_name
from hpid_ros.base.units import Numbers
from hpid_ros.motion.spline import Column, Knot

_LARGEST = 1e9  # [rad, rad/s, rad/s^2]; beyond it is no joint, and splines overflow


class TrajectoryPoint(NamedTuple):
    """One instant of all joints.

    Attributes:
        time_from_start_ns: In [ns].
        positions: One for each joint, in [rad].
        velocities: One for each joint in [rad/s], or empty.
        accelerations: One for each joint in [rad/s^2], or empty.
        efforts: One for each joint in [N m], or empty.
    """

    time_from_start_ns: int
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()
    accelerations: tuple[float, ...] = ()
    efforts: tuple[float, ...] = ()


@dataclass(frozen=True)
class JointTrajectory:
    """A checked trajectory.

    Attributes:
        joint_names: The joints, each once.
        points: At least one point; times from the start strictly increase from 0 or later. Where
            the stamp is not 0, points may lie before it, but not before instant 0.
        stamp_ns: When it starts in [ns]; 0 means with the next state.

    Raises:
        TrajectoryError: No joint, a joint twice, no point, times that do not increase, an
            array of another length than the joints, a number that is not finite.
    """

    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        require_trajectory(self.joint_names, self.points, self.stamp_ns)

    def started(self, start_ns: int) -> JointTrajectory:
        """Return the same motion as one that is under way, for whoever comes later.

        A stamp of 0 means "with the next state", so a start at instant 0 is told as a stamp of
        1 ns and times that are 1 ns shorter. Whoever follows the motion already and takes this
        one over after its first point keeps the same reference, to the last bit.

        Args:
            start_ns: When it started in [ns].
        """
        stamp_ns = max(start_ns, 1)
        ahead_ns = stamp_ns - start_ns
        points = tuple(
            point._replace(time_from_start_ns=point.time_from_start_ns - ahead_ns)
            for point in self.points
        )
        return JointTrajectory(self.joint_names, points, stamp_ns)

    def column(self, joint: str) -> Column:
        """Return one joint's part.

        Args:
            joint: A joint of the trajectory.

        Raises:
            TrajectoryError: The trajectory has no such joint.
        """
        if joint not in self.joint_names:
            raise TrajectoryError(unknown_name("joint", joint, self.joint_names))
        index = self.joint_names.index(joint)
        knots = tuple(
            Knot(
                point.time_from_start_ns,
                point.positions[index],
                point.velocities[index] if point.velocities else None,
                point.accelerations[index] if point.accelerations else None,
                point.efforts[index] if point.efforts else None,
            )
            for point in self.points
        )
        return Column(joint, knots, self.stamp_ns)


def require_trajectory(
    joint_names: Sequence[str], points: Sequence[TrajectoryPoint], stamp_ns: int, first: int = 0
) -> None:
    """Refuse what is no trajectory."""
    if not joint_names or len(set(joint_names)) != len(joint_names):
        raise TrajectoryError(
            f"a trajectory must name each of its joints once, not {list(joint_names)}"
        )
    if not points:
        raise TrajectoryError("a trajectory must have at least one point, not none")
    if stamp_ns < 0:
        raise TrajectoryError(f"a trajectory cannot start at {stamp_ns} ns, before 0")
    before = -1 - stamp_ns
    for index, point in enumerate(points, first):
        if point.time_from_start_ns <= before:
            raise TrajectoryError(
                f"times must increase from {-stamp_ns} ns on; point {index} has "
                f"{point.time_from_start_ns} ns after {before} ns"
            )
        before = point.time_from_start_ns
        _require_point(joint_names, index, point)


def _require_point(joint_names: Sequence[str], index: int, point: TrajectoryPoint) -> None:
    count = len(joint_names)
    arrays: tuple[tuple[str, Sequence[float], tuple[int, ...]], ...] = (
        ("positions", point.positions, (count,)),
        ("velocities", point.velocities, (0, count)),
        ("accelerations", point.accelerations, (0, count)),
        ("efforts", point.efforts, (0, count)),
    )
    for name, values, lengths in arrays:
        if len(values) not in lengths:
            allowed = " or ".join(str(length) for length in lengths)
            raise TrajectoryError(f"point {index} must have {allowed} {name}, not {len(values)}")
        for joint, value in zip(joint_names, values, strict=False):
            if not math.isfinite(value):
                raise TrajectoryError(
                    f"{name} of point {index} must be finite, not {value} for {joint!r}"
                )
            if abs(value) > _LARGEST:
                raise TrajectoryError(
                    f"{name} of point {index} must be within {_LARGEST:g}, "
                    f"not {value} for {joint!r}"
                )


Integers = NDArray[np.int64]
Point = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Time from start [ns], positions, velocities, accelerations and efforts."""


class PointArrays(NamedTuple):
    """The numbers of all points, one row a point, one column a joint.

    Where no point has any an array may be without columns, and a row of NaN is a point that has
    none.
    """

    positions: Numbers  # [rad]
    velocities: Numbers  # [rad/s]
    accelerations: Numbers  # [rad/s^2]
    efforts: Numbers  # [N m]


class KnotArrays(Sequence[Knot]):
    """One joint's knots, each made when it is asked for."""

    def __init__(
        self,
        times_ns: Integers,
        positions: Numbers,
        velocities: Numbers,
        accelerations: Numbers,
        efforts: Numbers,
    ) -> None:
        self._times_ns, self._positions = times_ns, positions
        self._rest = velocities, accelerations, efforts

    @property
    def gives_effort(self) -> bool:
        """Whether every knot has an effort."""
        return not np.isnan(self._rest[2]).any()

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
        rest = (float(each[index]) for each in self._rest)
        return Knot(
            int(self._times_ns[index]),
            float(self._positions[index]),
            *(None if value != value else value for value in rest),
        )

    def __eq__(self, other: object) -> bool:
        """Return whether another sequence has the same knots."""
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


def column_from_arrays(
    joint: str,
    names: Sequence[str],
    stamp_ns: int,
    times_ns: Integers,
    arrays: PointArrays,
    lengths: Integers,
    point: Callable[[int], Point],
) -> Column:
    """Return one joint's column; what ``JointTrajectory`` refuses is refused here, too."""
    require_arrays(names, stamp_ns, times_ns, arrays, lengths, point)
    if joint not in names:
        raise TrajectoryError(unknown_name("joint", joint, names))
    return checked_column(joint, list(names).index(joint), stamp_ns, times_ns, arrays)


def require_arrays(
    names: Sequence[str],
    stamp_ns: int,
    times_ns: Integers,
    arrays: PointArrays,
    lengths: Integers,
    point: Callable[[int], Point],
) -> None:
    """Refuse what ``JointTrajectory`` refuses; the arguments are those of column_from_arrays."""
    for index in _suspects(len(names), times_ns, arrays, lengths):
        _check_alone(names, stamp_ns, point, index)
    # Two points at most: the joints, the stamp, and that there is a point at all.
    _check_alone(names, stamp_ns, point, len(times_ns) - 1)


def checked_column(
    joint: str,
    at: int,
    stamp_ns: int,
    times_ns: Integers,
    arrays: PointArrays,
) -> Column:
    """Return one joint's column of a trajectory that :func:`require_arrays` let pass."""
    none = np.full(len(times_ns), np.nan)
    columns = (each[:, at].copy() if each.shape[1] else none for each in arrays)
    return Column(joint, KnotArrays(times_ns, *columns), stamp_ns)


def _suspects(
    joints: int,
    times_ns: Integers,
    arrays: PointArrays,
    lengths: Integers,
) -> list[int]:
    """Return the first points of each kind of fault, in their order."""
    if len(times_ns) == 0:
        return []
    suspects = [0]
    wrong = np.flatnonzero(np.diff(times_ns) <= 0)
    suspects += [int(wrong[0]) + 1] if len(wrong) else []
    odd = (lengths != joints) & ((lengths != 0) | [True, False, False, False])
    wrong = np.flatnonzero(odd.any(axis=1))
    suspects += [int(wrong[0])] if len(wrong) else []
    for k, each in enumerate(arrays):
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
