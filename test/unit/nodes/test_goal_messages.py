"""Goals of FollowJointTrajectory as arrays, and feedback as messages, without control_msgs."""

from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from harness.goals import fill_trajectory
from harness.groups import SECOND, SimulatedGroup, goal
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from hpid_ros.nodes.parts.goal_server import fill_feedback, request_of
from hpid_ros.nodes.parts.goals import GoalError

THERE = {"shoulder": [0.5, 1.0], "elbow": [0.1, 0.2]}


def message(positions, times, velocities=None, **fields):
    """Return what a goal's message looks like."""
    told = SimpleNamespace(
        trajectory=JointTrajectory(),
        multi_dof_trajectory=MultiDOFJointTrajectory(),
        path_tolerance=[],
        goal_tolerance=[],
        goal_time_tolerance=Duration(),
    )
    vars(told).update(fields)
    fill_trajectory(told.trajectory, positions, times, velocities)
    return told


def test_a_goal_is_read_as_it_was_written():
    asked = SimpleNamespace(name="elbow", position=0.1, velocity=-1.0, acceleration=0.0)
    told = message(
        THERE,
        [0.25, 1.5],
        {"shoulder": [1.0, 0.0], "elbow": [0.2, 0.0]},
        path_tolerance=[asked],
        goal_time_tolerance=Duration(sec=-1),
    )
    told.trajectory.header.stamp.sec = 7
    request = request_of(told)
    assert (request.names, request.stamp_ns) == (("shoulder", "elbow"), 7 * SECOND)
    assert request.times_ns.tolist() == [SECOND // 4, 3 * SECOND // 2]
    positions, velocities, accelerations, efforts = request.arrays
    assert positions.tolist() == [[0.5, 0.1], [1.0, 0.2]]
    assert velocities.tolist() == [[1.0, 0.2], [0.0, 0.0]]
    assert np.isnan(accelerations).all()
    assert np.isnan(efforts).all()
    assert request.path_tolerance == (asked,)
    assert request.goal_time_tolerance == -1.0


def test_points_may_differ_in_what_they_give():
    told = message(THERE, [1.0, 2.0])
    told.trajectory.points[1].velocities = [0.0, 0.0]
    assert np.isnan(request_of(told).arrays[1]).tolist() == [[True, True], [False, False]]


def test_what_is_no_trajectory_of_joints_is_refused():
    base = message(THERE, [1.0, 2.0])
    base.multi_dof_trajectory.joint_names = ["base"]
    with pytest.raises(GoalError, match="multi_dof_trajectory cannot be followed"):
        request_of(base)


def test_feedback_is_told_with_the_joints_in_their_order():
    group = SimulatedGroup()
    group.run(0.2)
    group.begin(goal(THERE, [0.5, 1.0]))
    group.run(0.3)
    feedback = group.follower.feedback()
    blank = SimpleNamespace(header=Header())
    written = fill_feedback(blank, group.settings.joints, feedback)
    assert written.joint_names == ["shoulder", "elbow"]
    assert (written.header.stamp.sec, written.header.stamp.nanosec) == (0, SECOND // 2)
    assert list(written.actual.positions) == [each[0] for each in feedback.actual]
    assert list(written.desired.accelerations) == [each[2] for each in feedback.desired]
    assert list(written.error.velocities) == [each[1] for each in feedback.error]
    assert written.error.time_from_start.nanosec == feedback.since_start_ns
