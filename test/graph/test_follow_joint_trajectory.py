"""The action over real controllers of simulated joints, asked by a plain action client."""

import itertools
import math
import os
import signal
import time

import numpy as np
import pytest
from harness.goals import (
    ABORTED,
    ACTION,
    CANCELED,
    SUCCEEDED,
    Client,
    Joints,
    fill_trajectory,
    goal_of,
    needs_control_msgs,
)
from harness.graph import Told
from trajectory_msgs.msg import JointTrajectory

pytestmark = needs_control_msgs

THERE = {"shoulder": [0.4, 1.0], "elbow": [-0.2, -0.5]}
TIMES = [0.75, 1.5]
SLOPES = {"shoulder": [0.8, 0.0], "elbow": [-0.4, 0.0]}
SLOW = [3.0, 6.0]
QUARTER = {name: [0.25 * each for each in slopes] for name, slopes in SLOPES.items()}
INVALID_GOAL, INVALID_JOINTS = -1, -2


@pytest.fixture
def joints(harness):
    return Joints(harness)


def there():
    return goal_of(THERE, TIMES, SLOPES)


def slowly():
    return goal_of(THERE, SLOW, QUARTER)


LATE = 0.2  # of a motion's largest velocity: with so much fades what a late message moves


def require_smooth(joints, fastest, most, late=0.0):
    """Require that references neither jump nor accelerate more than they may.

    Where messages may be late, their velocity may change by what fades besides.
    """
    for rows in joints.references.values():
        for row, later in itertools.pairwise(rows):
            elapsed, distance, change = np.subtract(later, row)
            assert abs(distance) <= fastest * elapsed + 1e-9
            assert abs(change) <= most * elapsed + late + 1e-9


def come_to_rest(joints):
    """Run until all references rest."""
    joints.run(
        lambda: all(rows and rows[-1][2] == 0.0 for rows in joints.references.values()),
        within=30.0,
        what="the references to rest",
    )


def test_a_goal_is_reached_with_feedback_though_states_are_on_two_topics(harness):
    """Each controller of a process is told its topic by a remap, the action by a parameter."""
    apart = "/gripper/joint_states"
    joints = Joints(harness, apart={"elbow": apart})
    started = joints.start(
        state_topics=f"[joint_states, {apart}]",
        constraints__elbow__goal=0.01,
        constraints__shoulder__goal=0.01,
    )
    client = Client(joints)
    ready = f"ready for goals on /{ACTION}/follow_joint_trajectory: shoulder, elbow"
    assert started.action.log.read_text().count(ready) == 1
    swapped = {name: THERE[name] for name in ("elbow", "shoulder")}
    status = client.follow(goal_of(swapped, TIMES, SLOPES))
    assert status == (SUCCEEDED, 0, "goal reached")
    assert joints.position == pytest.approx({"shoulder": 1.0, "elbow": -0.5}, abs=0.02)
    assert len(client.feedback) > 2
    assert {tuple(each.joint_names) for each in client.feedback} == {("shoulder", "elbow")}
    assert client.feedback[-1].desired.positions[0] > 0.8
    assert len(client.feedback[-1].actual.positions) == 2
    require_smooth(joints, 1.5, 6.0)


ARM = """<robot name="arm"><link name="a"/><link name="b"/><link name="c"/>
<joint name="shoulder" type="revolute"><parent link="a"/><child link="b"/>
<limit lower="-2" upper="2" effort="50" velocity="5"/></joint>
<joint name="elbow" type="prismatic"><parent link="b"/><child link="c"/>
<limit lower="-0.4" upper="0.4" effort="50" velocity="5"/></joint></robot>"""


def test_goals_that_cannot_be_followed_say_why_and_move_nothing(joints, tmp_path):
    """The rules themselves are those of test_goal_checks; here the messages come to them."""
    from control_msgs.msg import JointTolerance

    harness = joints.harness
    (tmp_path / "arm.urdf").write_text(ARM)
    joints.start(robot_description=tmp_path / "arm.urdf")
    client = Client(joints)
    partial = goal_of({"elbow": [0.3]}, [0.5], {"elbow": [0.0]})
    bad = JointTolerance(name="elbow", position=-0.5)
    for goal, code, line in (
        (goal_of({"shoulder": [1.0], "wrist": [1.0]}, [1.0]), INVALID_JOINTS, "'wrist'"),
        (partial, INVALID_JOINTS, "lacks shoulder"),
        (goal_of({**THERE, "elbow": [0.0, math.nan]}, TIMES), INVALID_GOAL, "nan for 'elbow'"),
        (goal_of(THERE, TIMES, path_tolerance=[bad]), INVALID_GOAL, "tolerance of elbow"),
        (there(), INVALID_GOAL, "elbow to -0.5 m, its limits are -0.4 and 0.4 m"),
    ):
        status, actual, text = client.follow(goal)
        assert (status, actual) == (ABORTED, code), text
        assert line in text
    assert all(row[1:] == (0.0, 0.0) for row in joints.references["shoulder"])
    bad_set = {"constraints__elbow__goal": 0.001, "constraints__shoulder__goal": -1.0}
    for values, line in (
        (bad_set, "constraints.shoulder.goal"),
        ({"state_timeout": 0.3}, "read-only"),
    ):
        is_set, reason = harness.set_parameters(ACTION, **values)
        assert (is_set, line in reason) == (False, True)
    assert harness.set_parameters(ACTION, allow_partial_joints_goal=True)[0]
    assert client.follow(partial)[0] == SUCCEEDED
    assert joints.references["elbow"][-1][1] == 0.3
    assert {row[1] for row in joints.references["shoulder"]} == {0.0}


def test_a_goal_outlives_its_client(joints):
    told = Told(joints.harness, ACTION)
    joints.start()
    client = Client(joints)
    client.send(goal_of({"shoulder": [0.5], "elbow": [0.5]}, [1.0]))
    client.close()
    joints.run(lambda: told.says(goals_reached="1"), what="the goal to be reached")
    goal = pytest.approx({"shoulder": 0.5, "elbow": 0.5}, abs=0.01)
    joints.run(lambda: joints.position == goal, what="the joints to settle there")
    assert Client(joints).follow(there())[0] == SUCCEEDED


@pytest.mark.faults
def test_a_controller_that_dies_aborts_the_goal_and_the_others_stop(joints):
    processes = joints.start(composed=False)
    client = Client(joints)
    handle = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    joints.alive = {"shoulder"}
    joints.effort["elbow"] = 0.0
    joints.blocked = {"elbow"}
    os.kill(processes.elbow.process.pid, signal.SIGKILL)
    status, code, text = client.result(handle)
    assert (status, code) == (ABORTED, INVALID_GOAL)
    assert text.startswith("the controller of elbow has published no reference for ")
    joints.run(lambda: joints.references["shoulder"][-1][2] == 0.0, what="the shoulder to stop")
    assert joints.references["shoulder"][-1][1] < 0.9


@pytest.mark.faults
def test_a_server_that_is_ended_stops_the_joints_and_tells_its_client(joints):
    processes = joints.start()
    client = Client(joints)
    handle = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    os.kill(processes.action.process.pid, signal.SIGTERM)
    assert client.result(handle) == (ABORTED, INVALID_GOAL, "the node ends")
    joints.run(lambda: processes.action.process.poll() is not None, what="the process to end")
    assert processes.action.process.returncode == 0
    come_to_rest(joints)
    assert joints.references["shoulder"][-1][1] < 0.9
    require_smooth(joints, 1.5, 6.0)


@pytest.mark.faults
def test_a_server_that_stands_still_leaves_the_joints_on_their_way_to_rest(joints):
    told = Told(joints.harness, ACTION)
    processes = joints.start(constraints__elbow__goal=0.01)
    client = Client(joints)
    handle = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    os.kill(processes.action.process.pid, signal.SIGSTOP)
    awake = time.monotonic() + 1.0  # also where late states follow each other faster than time
    joints.run(
        lambda: joints.position["shoulder"] > 0.9 and time.monotonic() > awake,
        what="the joints to go on",
    )
    os.kill(processes.action.process.pid, signal.SIGCONT)
    assert client.result(handle) == (SUCCEEDED, 0, "goal reached")
    # A machine that stands still does this once more.
    joints.run(lambda: told.count("times stood still") > 0, what="the report")
    require_smooth(joints, 1.5, 6.0)


@pytest.mark.faults
def test_states_that_stop_abort_the_goal_and_joints_hold_where_they_are_found(joints):
    joints.start()
    client = Client(joints)
    handle = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    joints.is_paused = True
    status, code, text = client.result(handle)
    assert (status, code) == (ABORTED, INVALID_GOAL)
    assert text.startswith("there was no new state for ")
    status, _, text = client.follow(there())
    assert (status, "there has been no new state" in text) == (ABORTED, True)
    joints.is_paused = False
    come_to_rest(joints)
    assert joints.references["shoulder"][-1][1] < 0.9


@pytest.mark.faults
def test_a_joint_that_another_node_took_in_a_silence_is_not_stopped(joints):
    joints.start()
    other = joints.harness.node.create_publisher(JointTrajectory, "joint_trajectory", 10)
    client = Client(joints)
    handle = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    joints.is_paused = True
    assert client.result(handle)[0] == ABORTED
    message = JointTrajectory()
    fill_trajectory(message, {"elbow": [0.7]}, [1.0])
    other.publish(message)
    assert client.follow(there())[0] == ABORTED  # by now it has been heard
    joints.is_paused = False
    joints.run(lambda: joints.position["elbow"] > 0.69, what="the elbow to go there")
    assert joints.position["shoulder"] < 0.9


@pytest.mark.faults
def test_of_a_flood_of_goals_the_last_one_is_followed_and_each_has_its_result(joints):
    joints.start(constraints__shoulder__goal=0.01)
    client = Client(joints)
    goal = goal_of({"shoulder": [1.0], "elbow": [-0.5]}, [1.5], {"shoulder": [0], "elbow": [0]})
    sent = [client.send(goal) for _ in range(50)]
    joints.run(lambda: all(each.ended.done() for each in sent), what="all results")
    *others, last = [each.ended.result() for each in sent]
    assert (last.status, last.result.error_string) == (SUCCEEDED, "goal reached")
    replaced = {"replaced by a new goal", "replaced by a new goal before it began"}
    # Where the machine stands still between two goals for as long as one takes, that is reached.
    assert {each.result.error_string for each in others} <= {"goal reached", *replaced}
    assert joints.position == pytest.approx({"shoulder": 1.0, "elbow": -0.5}, abs=0.02)
    # Fifty plans, and a machine that stands still hands some of them over late.
    require_smooth(joints, 2.0, 10.0, late=LATE * 1.0)


def test_whatever_a_cancel_of_all_goals_says_it_cancels_ends(joints):
    from action_msgs.srv import CancelGoal

    process = joints.start().action.process
    client = Client(joints)
    name = f"{ACTION}/follow_joint_trajectory/_action/cancel_goal"
    canceller = joints.harness.node.create_client(CancelGoal, name)
    joints.run(canceller.service_is_ready, what="the service")
    sent = [client.send(slowly())]
    os.kill(process.pid, signal.SIGSTOP)  # so that all of this waits for it
    later = [client.ask(slowly()) for _ in range(2)]
    cancelled = canceller.call_async(CancelGoal.Request())
    os.kill(process.pid, signal.SIGCONT)
    sent += [client.answer(each) for each in later]
    joints.run(cancelled.done, what="the answer to the cancel")
    named = [bytes(each.goal_id.uuid) for each in cancelled.result().goals_canceling]
    assert named
    for handle in sent:
        if bytes(handle.goal_id.uuid) in named:
            assert client.result(handle)[0] in (CANCELED, ABORTED)
    come_to_rest(joints)
    assert joints.references["shoulder"][-1][1] < 0.9
    require_smooth(joints, 1.5, 6.0)


@pytest.mark.faults
def test_of_two_servers_of_the_same_joints_the_first_gives_way(joints):
    told = Told(joints.harness, ACTION)
    joints.start(state_timeout=10.0)
    started = joints.start_action("other", joints="[elbow, shoulder]", state_timeout=10.0)
    joints.run(lambda: "ready for goals" in started.log.read_text(), what="the other to be ready")
    joints.run(
        lambda: "/other may send trajectories, too" in told.newest().get("message", ""),
        what="the warning",
    )
    client, other = Client(joints), Client(joints, "other")
    first = client.send(slowly())
    joints.run(lambda: joints.position["shoulder"] > 0.1, what="the joints to move")
    back = {"shoulder": [0.0], "elbow": [0.3]}
    second = other.send(goal_of(back, [1.5], {"shoulder": [0.0], "elbow": [0.0]}))
    line = "another node has sent a trajectory for shoulder, elbow"
    assert client.result(first) == (ABORTED, INVALID_GOAL, line)
    assert other.result(second) == (SUCCEEDED, 0, "goal reached")
    assert joints.position == pytest.approx({"shoulder": 0.0, "elbow": 0.3}, abs=0.02)


def test_without_controllers_no_goal_is_followed(joints):
    told = Told(joints.harness, ACTION)
    joints.alive = set()
    joints.start_action()
    line = "no controller listens to joint_trajectory"
    joints.run(lambda: told.newest().get("message", "").endswith(line), what="the report")
    status, code, text = Client(joints).follow(there())
    assert (status, code, text) == (ABORTED, INVALID_GOAL, line)
