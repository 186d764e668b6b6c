"""Messages of FollowJointTrajectory: goals read into arrays, feedback and results written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from trajectory_msgs.msg import JointTrajectoryPoint

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.goals import AskedTolerance, Feedback, GoalError, GoalRequest
from hpid_ros.trajectory.joint_trajectory import Point, PointArrays
from hpid_ros.wire import MOST_POINTS

_ARRAYS = ("positions", "velocities", "accelerations", "effort")


def request_of(goal: Any) -> GoalRequest:
    """Read a goal; this takes a while where it has many points.

    Args:
        goal: A ``FollowJointTrajectory.Goal``.

    Raises:
        GoalError: It is no trajectory of joints.
    """
    if goal.multi_dof_trajectory.points or goal.multi_dof_trajectory.joint_names:
        raise GoalError("multi_dof_trajectory cannot be followed, only trajectory")
    trajectory = goal.trajectory
    names, points = tuple(trajectory.joint_names), trajectory.points
    if len(points) > MOST_POINTS:
        raise GoalError(f"a goal may have {MOST_POINTS - 1} points, not {len(points)}")
    times_ns = np.array([_nanoseconds(each.time_from_start) for each in points], np.int64)
    columns = [[getattr(each, field) for each in points] for field in _ARRAYS]
    lengths = np.array([[len(each) for each in rows] for rows in columns], np.int64).T
    arrays = PointArrays(*(_values(rows, len(names)) for rows in columns))
    request = GoalRequest(
        names,
        _nanoseconds(trajectory.header.stamp),
        times_ns,
        arrays,
        _tolerances(goal.path_tolerance),
        _tolerances(goal.goal_tolerance),
        _nanoseconds(goal.goal_time_tolerance) * SECONDS_PER_NANOSECOND,
    )

    def point(index: int) -> Point:
        p, v, a, e = (tuple(rows[index]) for rows in columns)
        return int(times_ns[index]), p, v, a, e

    request.require_trajectory(lengths, point)
    return request


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def _values(rows: Sequence[Sequence[float]], joints: int) -> Numbers:
    """Return the numbers of each point; NaN where it has not one for each joint."""
    if rows and all(len(row) == joints for row in rows):
        return np.array(rows, np.float64).reshape(len(rows), joints)
    values = np.full((len(rows), joints), np.nan)
    for index, row in enumerate(rows):
        if len(row) == joints:
            values[index] = row
    return values


def _tolerances(messages: Iterable[Any]) -> tuple[AskedTolerance, ...]:
    return tuple(
        AskedTolerance(each.name, each.position, each.velocity, each.acceleration)
        for each in messages
    )


def fill_feedback(message: Any, names: Sequence[str], feedback: Feedback) -> Any:
    """Write feedback into a message and return it.

    Args:
        message: A new ``FollowJointTrajectory.Feedback``.
        names: All joints, in the order of the feedback.
        feedback: How the goal is doing.
    """
    seconds, nanoseconds = divmod(feedback.stamp_ns, NANOSECONDS)
    message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
    message.joint_names = list(names)
    message.desired = _point(feedback.desired, feedback.since_start_ns)
    message.actual = _point(feedback.actual, feedback.since_start_ns)
    message.error = _point(feedback.error, feedback.since_start_ns)
    return message


def _point(joints: Sequence[Sequence[float]], since_start_ns: int) -> JointTrajectoryPoint:
    """Return a point with as many derivatives as the joints have."""
    seconds, nanoseconds = divmod(since_start_ns, NANOSECONDS)
    arrays = dict(zip(_ARRAYS, map(list, zip(*joints, strict=True)), strict=False))
    return JointTrajectoryPoint(
        time_from_start=Duration(sec=seconds, nanosec=nanoseconds), **arrays
    )
