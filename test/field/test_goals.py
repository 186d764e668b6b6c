"""What people reported of FollowJointTrajectory, sent to the controllers of two joints."""

import math
from functools import partial

import numpy as np
import pytest
from harness.goals import (
    ABORTED,
    ACTION,
    CANCELED,
    SUCCEEDED,
    Client,
    Joints,
    goal_of,
    needs_control_msgs,
)
from harness.graph import change, state

pytestmark = needs_control_msgs

SHORT = 0.3  # [s] of a goal
TRIES = 5  # of what a machine that stands still spoils
SUCCESSFUL, INVALID_GOAL, INVALID_JOINTS, PATH_VIOLATED = 0, -1, -2, -4
NAMES = ("shoulder", "elbow")


class Arm:
    """Two joints with their controllers and an action server, all in motion since the start."""

    def __init__(self, harness):
        self.harness, self.joints = harness, Joints(harness)
        self.joints.start(allow_partial_joints_goal=True)
        self.client = Client(self.joints)

    def to(self, shoulder, elbow, seconds=SHORT, **other):
        """Return a goal that ends at rest."""
        rest = {joint: [0.0] for joint in NAMES}
        return goal_of({"shoulder": [shoulder], "elbow": [elbow]}, [seconds], rest, **other)

    def reference(self, joint="shoulder"):
        """Return position and velocity of the newest reference."""
        return self.joints.references[joint][-1][1:]

    def references_since(self, count, joint="shoulder"):
        return np.array(self.joints.references[joint][count:]).reshape(-1, 3)

    def rest(self):
        self.joints.run(
            lambda: all(self.reference(joint)[1] == 0.0 for joint in NAMES), what="rest"
        )


@pytest.fixture(scope="module")
def arm(module_harness):
    return Arm(module_harness)


def with_one_point(joints=NAMES, **values):
    """Return what makes a goal of one point: 0.1 rad for each joint, unless told otherwise."""

    def goal():
        goal = goal_of({joint: [0.1] for joint in NAMES}, [SHORT])
        goal.trajectory.joint_names = list(joints)
        for name, numbers in values.items():
            setattr(goal.trajectory.points[0], name, numbers)
        return goal

    return goal


def at(*times):
    """Return what makes a goal whose points are at these times."""
    places = [0.1 * k for k in range(len(times))]
    return partial(goal_of, dict.fromkeys(NAMES, places), times)


UNFOLLOWABLE = [
    (partial(goal_of, {}, []), INVALID_JOINTS, "each of its joints once"),
    (at(), INVALID_GOAL, "point"),
    (at(0.0, 0.0, 0.0), INVALID_GOAL, "time"),
    (at(0.3, 0.2, 0.4), INVALID_GOAL, "time"),
    (at(0.3, 0.6, 0.6), INVALID_GOAL, "time"),
    (with_one_point(positions=[], velocities=[0.1, 0.1]), INVALID_GOAL, "positions"),
    (with_one_point(velocities=[0.1]), INVALID_GOAL, "velocit"),
    (with_one_point(positions=[0.1, math.nan]), INVALID_GOAL, "nan"),
    (with_one_point(positions=[0.1, math.inf]), INVALID_GOAL, "inf"),
    (with_one_point(["shoulder", "Elbow"]), INVALID_JOINTS, "'Elbow'"),
    (with_one_point(["shoulder", "shoulder"]), INVALID_JOINTS, "once"),
]


def test_goals_that_nobody_can_follow_end_with_their_reason_while_another_is_followed(arm):
    """No client waits for ever, and the goal under way is not dropped for them."""
    under_way = arm.client.send(arm.to(0.3, -0.3, 1.0))
    arm.joints.run(lambda: arm.reference()[0] > 0.001, what="the shoulder to move")
    for goal, code, line in UNFOLLOWABLE:
        status, found, text = arm.client.follow(goal())
        assert (status, found, line in text, "\n" in text) == (ABORTED, code, True, False), text
    assert arm.client.result(under_way) == (SUCCEEDED, SUCCESSFUL, "goal reached")
    arm.joints.run(lambda: arm.reference() == (0.3, 0.0), what="the reference to end there")


def test_a_goal_at_the_present_place_without_velocities_is_reached_at_once(arm):
    """What a planner gives when the arm is there already: one point at time 0."""
    arm.rest()
    here, there = (arm.reference(joint)[0] for joint in NAMES)
    goal = goal_of({"shoulder": [here], "elbow": [there]}, [0.0])
    count = len(arm.joints.references["shoulder"])
    assert arm.client.follow(goal)[0] == SUCCEEDED
    rows = arm.references_since(count)
    assert rows[:, 1] == pytest.approx(np.full(len(rows), here), abs=1e-9)
    assert arm.reference() == (here, 0.0)


def test_where_a_goal_ends_the_joints_rest_and_nothing_moves_them_any_more(arm):
    assert arm.client.follow(arm.to(0.0, -0.2, 0.5))[0] == SUCCEEDED
    arm.joints.run(lambda: arm.reference() == (0.0, 0.0), what="the reference to end there")
    count = len(arm.joints.references["shoulder"])
    arm.joints.run(
        lambda: (
            abs(arm.joints.velocity["shoulder"]) < 2e-3
            and abs(arm.joints.position["shoulder"]) < 2e-3
        ),
        what="the shoulder to rest at its goal",
    )
    assert not arm.references_since(count)[:, 1:].any()


@pytest.mark.parametrize("seconds", [0.1, 0.8])
def test_a_goal_has_ended_before_its_planner_gives_up(arm, seconds):
    """MoveIt waits for 1.2 times what it planned, and half a second."""
    for _ in range(TRIES):
        target = -0.1 if arm.reference()[0] > -0.05 else 0.0
        begun = arm.joints.now
        assert arm.client.follow(arm.to(target, 0.0, seconds))[0] == SUCCEEDED
        took = arm.joints.now - begun
        if took < 1.2 * seconds + 0.5:
            break
    assert seconds - 0.01 <= took < 1.2 * seconds + 0.5


def test_a_cancel_stops_from_the_reference_without_a_step_back_and_the_joint_is_held(arm):
    """One that were to stop from where the joint is would step back by its lag."""
    arm.client.follow(arm.to(0.0, 0.0))
    handle = arm.client.send(arm.to(2.0, 0.0, 2.0))
    arm.joints.run(lambda: arm.reference()[0] > 0.5, what="the shoulder to move")
    lag = arm.reference()[0] - arm.joints.position["shoulder"]
    count, fastest = len(arm.joints.references["shoulder"]), arm.reference()[1]
    cancelled = handle.cancel_goal_async()
    arm.joints.run(cancelled.done, what="the cancel")
    assert arm.client.result(handle)[0] == CANCELED
    arm.rest()
    steps = np.diff(arm.references_since(count)[:, 1])
    assert steps.min() > -1e-9
    assert lag > 5 * abs(steps.min())
    assert steps.max() < 1.5 * fastest * 0.005 + 1e-3
    stopped = arm.reference()[0]
    assert 0.5 < stopped < 1.6
    arm.joints.run_for(0.4)
    assert arm.reference() == (stopped, 0.0)
    assert arm.joints.position["shoulder"] == pytest.approx(stopped, abs=0.02)
    arm.client.follow(arm.to(0.0, 0.0, 0.5))


def test_a_cancel_that_comes_too_late_or_twice_ends_nothing(arm):
    for _ in range(3):
        handle = arm.client.send(arm.to(0.0, 0.0, 0.1))
        assert arm.client.result(handle)[0] == SUCCEEDED
        cancels = [handle.cancel_goal_async() for _ in range(2)]
        arm.joints.run(lambda cancels=cancels: all(each.done() for each in cancels))
        assert [list(each.result().goals_canceling) for each in cancels] == [[], []]
    handle = arm.client.send(arm.to(0.5, 0.0, 2.0))
    cancels = [handle.cancel_goal_async() for _ in range(3)]
    assert arm.client.result(handle)[0] == CANCELED
    arm.joints.run(lambda: all(each.done() for each in cancels))
    assert arm.client.follow(arm.to(0.0, 0.0))[0] == SUCCEEDED


def test_tolerances_of_a_goal_are_its_own_and_the_next_one_has_the_defaults_again(arm):
    from control_msgs.msg import JointTolerance

    tight = JointTolerance(name="shoulder", position=1e-5)
    for _ in range(2):
        status, code, text = arm.client.follow(arm.to(0.4, 0.0, path_tolerance=[tight]))
        assert (status, code) == (ABORTED, PATH_VIOLATED)
        assert "shoulder" in text
        arm.rest()
        held = arm.joints.position["shoulder"]
        arm.joints.run_for(0.3)
        assert arm.joints.position["shoulder"] == pytest.approx(held, abs=0.05)
        assert arm.client.follow(arm.to(0.0, 0.0))[0] == SUCCEEDED


def test_a_tolerance_that_is_set_meanwhile_holds_for_the_next_goal(arm):
    handle = arm.client.send(arm.to(0.4, 0.0, 0.6))
    arm.joints.run(lambda: arm.reference()[0] > 0.02, what="the shoulder to move")
    tight = {"constraints__shoulder__trajectory": 1e-5}
    assert arm.harness.set_parameters(ACTION, **tight) == (True, "")
    assert arm.client.result(handle)[0] == SUCCEEDED
    assert arm.client.follow(arm.to(0.0, 0.0))[1] == PATH_VIOLATED
    none = {"constraints__shoulder__trajectory": 0.0}
    assert arm.harness.set_parameters(ACTION, **none) == (True, "")
    assert arm.client.follow(arm.to(0.0, 0.0))[0] == SUCCEEDED


def test_joints_that_a_goal_does_not_name_stay_where_they_are(arm):
    arm.client.follow(arm.to(0.2, -0.1))
    count = len(arm.joints.references["elbow"])
    goal = goal_of({"shoulder": [0.0]}, [SHORT], {"shoulder": [0.0]})
    assert arm.client.follow(goal)[0] == SUCCEEDED
    elbow = arm.references_since(count, "elbow")
    assert np.isfinite(elbow).all()
    assert elbow[:, 1] == pytest.approx(np.full(len(elbow), -0.1), abs=1e-9)


def test_a_controller_that_is_deactivated_aborts_the_goal_and_the_others_stop(arm):
    handle = arm.client.send(arm.to(1.0, 1.0, 3.0))
    arm.joints.run(lambda: arm.reference("elbow")[0] > 0.1, what="the joints to move")
    arm.joints.alive = {"shoulder"}
    assert change(arm.harness, "deactivate", "elbow_controller")
    status, code, text = arm.client.result(handle)
    assert (status, code) == (ABORTED, INVALID_GOAL)
    assert "the controller of elbow" in text
    arm.joints.run(lambda: arm.reference()[1] == 0.0, what="the shoulder to stop")
    assert arm.reference()[0] < 0.9
    assert change(arm.harness, "activate", "elbow_controller")
    assert state(arm.harness, "elbow_controller") == "active"
    arm.joints.alive = set(NAMES)
    stood = arm.joints.position["elbow"]
    arm.joints.run_for(0.3)
    assert arm.joints.position["elbow"] == pytest.approx(stood, abs=0.05)
    assert arm.client.follow(arm.to(0.0, 0.0, 0.6))[0] == SUCCEEDED
