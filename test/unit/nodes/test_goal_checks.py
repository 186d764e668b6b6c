"""Which goals are obeyed: joint_trajectory_controller's rules; goals and feedback as messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from harness.goals import fill_trajectory
from harness.groups import SECOND, SimulatedGroup, goal
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory

from hpid_ros.base.errors import SettingError
from hpid_ros.messages.bounds import LIVE
from hpid_ros.messages.joint_trajectory import encode_trajectory
from hpid_ros.nodes.parts.goal_server import fill_feedback, request_of
from hpid_ros.nodes.parts.goals import (
    GoalError,
    GoalRequest,
    GroupSettings,
    JointFacts,
    ResultCode,
    Tolerance,
    for_all_joints,
)

JOINTS = ("shoulder", "elbow", "slide")
FACTS = {"slide": JointFacts(unit="m")}
WHOLE = {"shoulder": [1.0, 2.0], "elbow": [0.0, 0.5], "slide": [0.1, 0.2]}


def settings(**values):
    return GroupSettings.from_parameters(JOINTS, FACTS, values)


def code_of(request, **values):
    with pytest.raises(GoalError) as refused:
        request.require_group(settings(**values))
    return refused.value.code, str(refused.value)


def asked(joint, position=0.0, velocity=0.0, acceleration=0.0):
    """Return what is used of a message JointTolerance."""
    return SimpleNamespace(
        name=joint, position=position, velocity=velocity, acceleration=acceleration
    )


@pytest.mark.parametrize(
    ("names", "code", "line"),
    [
        ([], "INVALID_JOINTS", "each of its joints once, not \\[\\]"),
        (["a", "a"], "INVALID_JOINTS", "each of its joints once"),
        (["a", "b", "c"], "INVALID_GOAL", "must have 3 positions, not 2"),
    ],
)
def test_what_is_no_trajectory_is_refused(names, code, line):
    """Of those of test_safety_trajectories one: it is the same check."""
    points = [JointTrajectoryPoint(positions=[1.0, 1.0])]
    raw = serialize_message(JointTrajectory(joint_names=names, points=points))
    with pytest.raises(GoalError, match=line) as refused:
        GoalRequest.of(raw)
    assert refused.value.code is ResultCode[code]


@pytest.mark.parametrize(
    ("count", "is_mixed", "line"),
    [
        pytest.param(
            LIVE.points, False, "may have 49999 points, not 50000", marks=pytest.mark.slow
        ),
        (LIVE.mixed_points, True, "may have 4999 points that differ in their arrays"),
    ],
)
def test_a_goal_has_no_more_points_than_controllers_take(count, is_mixed, line):
    none = np.full((count, 1), np.nan)
    arrays = np.zeros((count, 1)), np.zeros((count, 1)), none, none
    if is_mixed:
        arrays[1][0] = np.nan
    for most in (count, count - 1):
        times_ns, least = np.arange(1, most + 1), [each[:most] for each in arrays]
        raw = encode_trajectory(0, ["a"], times_ns, least)
        if most == count:
            with pytest.raises(GoalError, match=line):
                GoalRequest.of(raw)
    GoalRequest.of(raw)


def test_joints_must_be_the_groups_and_all_of_them_unless_some_will_do():
    assert settings() is not None
    request = goal(WHOLE, [0.0, 1.0])
    request.require_group(settings())
    code, line = code_of(goal({**WHOLE, "elbw": [0.0, 0.0]}, [0.0, 1.0]))
    assert code is ResultCode.INVALID_JOINTS
    assert "unknown joint 'elbw'; did you mean 'elbow'?" in line
    some = goal({"elbow": [1.0]}, [1.0])
    code, line = code_of(some)
    assert code is ResultCode.INVALID_JOINTS
    assert "lacks shoulder, slide" in line
    some.require_group(settings(allow_partial_joints_goal=True))


def test_a_goal_ends_at_rest_unless_it_may_end_in_motion():
    velocities = {name: [0.5, 0.0] for name in WHOLE}
    goal(WHOLE, [0.0, 1.0], velocities).require_group(settings())
    velocities["slide"] = [0.0, 1e-3]
    moving = goal(WHOLE, [0.0, 1.0], velocities)
    code, line = code_of(moving)
    assert code is ResultCode.INVALID_GOAL
    assert "not slide at 0.001 m/s" in line
    moving.require_group(settings(allow_nonzero_velocity_at_trajectory_end=True))


@pytest.mark.parametrize(
    ("value", "kept"), [(0.0, 0.2), (-1.0, 0.0), (0.5, 0.5), (-0.99999994, 0.0)]
)
def test_a_tolerance_of_zero_is_the_default_and_minus_one_is_none(value, kept):
    default = settings(
        **{
            "constraints.elbow.trajectory": 0.2,
            "constraints.elbow.goal": 0.2,
            "constraints.goal_time": 0.2,
            "constraints.stopped_velocity_tolerance": 0.2,
        }
    )
    found = goal(
        WHOLE,
        [0.0, 1.0],
        path_tolerance=(asked("elbow", value, value),),
        goal_tolerance=(asked("elbow", value, value),),
        goal_time_tolerance=value,
    ).require_group(default)
    assert found.path["elbow"].position == kept
    assert found.goal["elbow"] == (kept, kept)
    assert found.goal_time == kept
    assert found.path["shoulder"] == (0.0, 0.0)
    assert found.goal["shoulder"] == (0.0, 0.2)


@pytest.mark.parametrize("bad", [-0.5, -2.0, float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["position", "velocity", "acceleration"])
def test_a_tolerance_that_is_none_is_refused(bad, field):
    for where in ("path_tolerance", "goal_tolerance"):
        code, line = code_of(goal(WHOLE, [0.0, 1.0], **{where: (asked("elbow", **{field: bad}),)}))
        assert code is ResultCode.INVALID_GOAL
        assert f"{where} of elbow: {field} must be positive, 0 for the default or -1" in line
    code, _ = code_of(goal(WHOLE, [0.0, 1.0], goal_time_tolerance=bad))
    assert code is ResultCode.INVALID_GOAL
    unknown = (asked("knee", 0.1),)
    code, line = code_of(goal(WHOLE, [0.0, 1.0], path_tolerance=unknown))
    assert code is ResultCode.INVALID_JOINTS
    assert "path_tolerance: unknown joint 'knee'" in line


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_violation_is_an_error_beyond_a_tolerance_that_is_enforced(p, v, most_p, most_v):
    line = Tolerance(most_p, most_v).violation(p, v, "m")
    assert bool(line) == ((0.0 < most_p < abs(p)) or (0.0 < most_v < abs(v)))


def test_a_goal_is_told_to_all_joints_and_has_begun_for_each_of_them():
    request = goal({"elbow": [1.0, 2.0]}, [0.5, 1.0], {"elbow": [0.3, 0.0]})
    now_ns = 5 * SECOND
    standing = [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9)]
    told = for_all_joints(
        request,
        JOINTS,
        now_ns - 1,
        now_ns,
        standing=standing,
        rest=[10.0, 20.0, 30.0],
        settling=0.5,
    )
    assert (told.names, told.stamp_ns) == (JOINTS, now_ns - 1)
    assert told.times_ns.tolist() == [0, SECOND // 2, SECOND]
    positions, velocities, accelerations, _ = told.arrays
    assert positions.tolist() == [[10.0, 0.4, 30.0], [10.0, 1.0, 30.0], [10.0, 2.0, 30.0]]
    assert velocities.tolist() == [[0.0, 0.5, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.0]]
    assert np.isnan(accelerations).all()
    for joint in range(3):
        assert told.column(joint).is_under_way(now_ns)


def test_efforts_of_a_goal_are_told_to_its_joints_from_its_start_on():
    request = goal({"elbow": [1.0, 2.0]}, [0.5, 1.0], efforts={"elbow": [3.0, 5.0]})
    standing = [(0.0, 0.0, 0.0)] * 3
    told = for_all_joints(
        request, JOINTS, 4 * SECOND, 4 * SECOND, standing=standing, rest=[0.0] * 3, settling=0.5
    )
    elbow, slide = (told.column(k).start(4 * SECOND, 0.0) for k in (1, 2))
    planned = [elbow.effort(round((4.0 + t) * SECOND)) for t in (0.0, 0.5, 0.75, 1.0, 2.0)]
    assert planned == pytest.approx([3.0, 3.0, 4.0, 5.0, 5.0])
    assert slide.effort(5 * SECOND) == 0.0
    assert told.column(1).gives_effort


def test_a_goal_whose_first_point_is_now_gets_none_before_it():
    request = goal({name: [1.0, 2.0] for name in JOINTS}, [0.0, 1.0])
    told = for_all_joints(
        request, JOINTS, 4, 5, standing=[(0.0, 0.0, 0.0)] * 3, rest=[0.0] * 3, settling=0.5
    )
    assert told.times_ns.tolist() == [0, SECOND]
    assert told.arrays[0][0].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("joints", "values", "line"),
    [
        ((), {}, "each joint once"),
        (("a", "a"), {}, "each joint once"),
        (("a",), {"constraints.goal_time": -1.0}, "goal_time must be at least"),
        (("a",), {"constraints.a.trajectory": float("nan")}, "a.trajectory must be at least"),
        (("a",), {"state_clock": "sundial"}, "one of wall, simulated"),
        (("a",), {"allow_partial_joints_goal": 1}, "must be true or false"),
    ],
)
def test_settings_that_are_none_are_refused(joints, values, line):
    with pytest.raises(SettingError, match=line):
        GroupSettings.from_parameters(joints, {}, values)


THERE = {"shoulder": [0.5, 1.0], "elbow": [0.1, 0.2]}


def message(positions, times, velocities=None, **fields):
    """Return what a goal's message looks like, without control_msgs."""
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
    within = asked("elbow", 0.1, -1.0)
    told = message(
        THERE,
        [0.25, 1.5],
        {"shoulder": [1.0, 0.0], "elbow": [0.2, 0.0]},
        path_tolerance=[within],
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
    assert request.path_tolerance == (within,)
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
