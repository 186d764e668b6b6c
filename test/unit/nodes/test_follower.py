"""The course of goals over loops that get their messages late: reached, ended, stopped."""

from types import SimpleNamespace

import numpy as np
import pytest
from harness.groups import MS, SECOND, THERE, TIMES, SimulatedGroup, at_rest, goal, moving, started

from hpid_ros.control.reference import Setpoint
from hpid_ros.nodes.parts.goals import GoalError, JointFacts, ResultCode


@pytest.mark.parametrize("most_delay", [0, 5, 40])
def test_a_goal_is_reached_and_the_reference_follows_it_from_one_instant(most_delay):
    group = started(most_delay=most_delay, **{"constraints.elbow.goal": 1e-3})
    group.run(3.0, until=lambda: group.results)
    assert group.results == [(ResultCode.SUCCESSFUL, "goal reached")]
    assert group.position == pytest.approx([1.0, -0.5], abs=2e-3)
    (told,) = group.told
    for joint in range(2):
        stamps, reference, _, _, _ = group.logged(joint)
        meant = told.column(joint).start(told.stamp_ns, 0.0)
        late = stamps > (told.stamp_ns + 0.6 * SECOND) / SECOND
        wanted = [meant.sample(round(stamp * SECOND)).position for stamp in stamps[late]]
        assert reference[late] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_feedback_tells_what_controllers_follow_and_how_far_joints_are_from_the_first_moment_on(
    seed,
):
    group = SimulatedGroup(seed=seed)
    group.run(0.2)
    assert group.follower.feedback() is None
    group.begin(moving())
    for _ in range(1000):
        feedback = group.follower.feedback()
        assert feedback.stamp_ns == group.stamp_ns
        desired = [each[0] for each in feedback.desired]
        assert desired == pytest.approx(
            [loop.following.position for loop in group.loops], abs=4e-3
        )
        for desired, actual, error in zip(
            feedback.desired, feedback.actual, feedback.error, strict=True
        ):
            assert error == (desired[0] - actual[0], desired[1] - actual[1])
        group.step()
    assert feedback.since_start_ns == pytest.approx(SECOND, abs=2 * MS)


def test_a_joint_that_is_blocked_aborts_and_holds_where_it_is_with_little_effort():
    group = started(**{"constraints.elbow.trajectory": 0.1, "constraints.stop_duration": 0.3})
    group.run(0.3)
    group.blocked = {1}
    group.run(2.0, until=lambda: group.results)
    (result,) = group.results
    assert result.code is ResultCode.PATH_TOLERANCE_VIOLATED
    assert result.text.startswith("elbow is 0.1")
    assert "its tolerance is 0.1 rad" in result.text
    assert "of 1 s" in result.text
    before = abs(group.logged(1)[4][-1])
    group.run(1.0)
    stuck = group.position[1]
    assert group.loops[1].following.reference == (pytest.approx(stuck, abs=1e-9), 0.0)
    # Its integral stays what it was; the proportional effort against the block is gone.
    assert abs(group.logged(1)[4][-1]) < before
    assert abs(group.loops[1].law.terms.p) < 1e-6
    # The other one has stopped where it was going, and holds.
    assert group.loops[0].following.reference == (pytest.approx(group.position[0], abs=2e-3), 0.0)
    assert 0.2 < group.position[0] < 1.0


def test_a_goal_that_is_not_reached_in_time_is_aborted_and_one_without_a_time_waits():
    group = started(**{"constraints.shoulder.goal": 0.01})
    group.blocked = {0}
    group.run(5.0)
    assert group.results == []
    group.follower.cancel()
    group = SimulatedGroup(**{"constraints.shoulder.goal": 0.01, "constraints.goal_time": 0.5})
    group.run(0.2)
    group.begin(moving())
    group.blocked = {0}
    assert group.run(5.0, until=lambda: group.results) == pytest.approx(1.5, abs=0.01)
    (result,) = group.results
    assert result.code is ResultCode.GOAL_TOLERANCE_VIOLATED
    assert "shoulder is 1 rad from its reference" in result.text


def test_a_joint_that_still_moves_has_not_arrived():
    rolling = SimulatedGroup(**{"constraints.stopped_velocity_tolerance": 1e-9})
    rolling.run(0.2)
    rolling.begin(moving())
    rolling.run(1.2, until=lambda: rolling.results)
    assert rolling.results == []


def test_a_new_goal_replaces_the_old_one_without_a_jump():
    group = started(**{"constraints.shoulder.goal": 2e-3, "constraints.elbow.goal": 2e-3})
    group.run(0.5)
    back = {"shoulder": [0.2], "elbow": [0.1]}
    group.begin(goal(back, [1.0], at_rest(back)))
    assert group.results == [(ResultCode.INVALID_GOAL, "replaced by a new goal")]
    group.run(2.0, until=lambda: len(group.results) > 1)
    assert group.results[1].code is ResultCode.SUCCESSFUL
    assert group.position == pytest.approx([0.2, 0.1], abs=2e-3)
    for joint in range(2):
        _, reference, velocity, _, effort = group.logged(joint)
        assert np.abs(np.diff(reference)).max() < 2.5e-3
        assert np.abs(np.diff(velocity)).max() < 0.03
        assert np.abs(np.diff(effort)).max() < 1.0


def test_joints_that_a_goal_does_not_name_rest_and_never_swing_back():
    group = SimulatedGroup(allow_partial_joints_goal=True)
    group.run(0.2)
    group.begin(moving())
    group.run(0.5)
    only = {"elbow": [0.0]}
    begun = group.begin(goal(only, [10.0], at_rest(only)))
    assert begun.trajectory.names == ("shoulder", "elbow")
    before = group.loops[0].following.reference
    group.run(1.0)
    path = group.logged(0)[1]
    assert np.all(np.diff(path) >= 0.0)
    assert path[-1] == pytest.approx(before[0] + 0.25 * before[1], abs=5e-3)
    assert group.loops[0].following.velocity == 0.0


def test_a_goal_for_some_joints_leaves_the_others_where_their_references_stand():
    group = SimulatedGroup(allow_partial_joints_goal=True)
    group.loops[0].follow(Setpoint(0.7))  # told by somebody else before
    group.run(2.0)
    only = {"elbow": [0.5]}
    group.begin(goal(only, [1.0], at_rest(only)))
    group.run(2.0)
    assert group.results[0].code is ResultCode.SUCCESSFUL
    assert group.loops[0].following.reference == (0.7, 0.0)


def test_a_goal_with_a_stamp_begins_then_and_one_that_is_under_way_is_joined():
    group = SimulatedGroup(start_ns=100 * SECOND)
    group.run(0.2)
    group.begin(moving(stamp_ns=101 * SECOND))
    group.run(0.7)
    assert [loop.following.position for loop in group.loops] == [0.0, 0.0]
    group.run(3.0, until=lambda: group.results)
    assert group.stamp_ns == pytest.approx(102 * SECOND, abs=0.05 * SECOND)
    assert group.results[0].code is ResultCode.SUCCESSFUL
    joining = SimulatedGroup(start_ns=100 * SECOND)
    joining.run(0.2)
    joining.begin(moving(stamp_ns=round(99.7 * SECOND)))
    joining.run(3.0, until=lambda: joining.results)
    assert 100.7 * SECOND < joining.stamp_ns < 101.8 * SECOND  # no faster than it was planned
    for joint in range(2):
        assert np.abs(np.diff(joining.logged(joint)[1])).max() < 4e-3


def test_goals_of_another_clock_are_refused():
    group = SimulatedGroup(start_ns=100 * SECOND)
    group.run(0.2)
    with pytest.raises(GoalError, match=r"ended at 51\.000 s, in the past.*say 100\.200 s") as old:
        group.begin(moving(stamp_ns=50 * SECOND))
    assert old.value.code is ResultCode.OLD_HEADER_TIMESTAMP
    with pytest.raises(GoalError, match="must start within 3600 s"):
        group.begin(moving(stamp_ns=1_700_000_000 * SECOND))
    assert not group.follower.is_active


def within(position):
    return SimpleNamespace(name="elbow", position=position, velocity=0.0, acceleration=0.0)


def test_a_tolerance_of_the_goal_replaces_the_default_and_minus_one_removes_it():
    default = {"constraints.elbow.trajectory": 0.05, "constraints.elbow.goal": 0.05}
    for asked, code in (
        ({}, ResultCode.PATH_TOLERANCE_VIOLATED),
        ({"path_tolerance": (within(-1.0),)}, None),
        (
            {"path_tolerance": (within(2.0),), "goal_time_tolerance": 0.2},
            ResultCode.GOAL_TOLERANCE_VIOLATED,
        ),
    ):
        group = SimulatedGroup(**default)
        group.run(0.2)
        group.begin(moving(**asked))
        group.blocked = {1}
        group.run(3.0, until=lambda: group.results)  # noqa: B023
        assert [each.code for each in group.results] == ([] if code is None else [code])


def test_an_endless_joint_is_where_it_should_be_whole_turns_away():
    facts = {"shoulder": JointFacts(is_endless=True), "elbow": JointFacts()}
    group = SimulatedGroup(facts=facts, **{"constraints.shoulder.trajectory": 0.1})
    group.seen = lambda parts: [
        part._replace(position=(part.position + np.pi) % (2 * np.pi) - np.pi)
        if part.joint == 0
        else part
        for part in parts
    ]
    group.run(0.2)
    far = {"shoulder": [0.0, 7.0], "elbow": [0.0, 0.1]}
    group.begin(goal(far, [0.0, 5.0], at_rest(far)))
    group.run(6.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.SUCCESSFUL
    assert group.position[0] == pytest.approx(7.0, abs=2e-3)


def wheel(at, multi_turn=False, **values):
    """Return a group of which one joint is a wheel whose encoder begins anew after a turn."""
    facts = {"shoulder": JointFacts(is_endless=True, takes_shorter_way=not multi_turn)}
    group = SimulatedGroup(facts=facts, wraps={"shoulder": {"multi_turn": multi_turn}}, **values)
    group.position[0] = at
    group.run(0.2)
    return group


def path(*positions):
    there = {"shoulder": positions, "elbow": np.linspace(0.0, 0.2, len(positions))}
    return goal(there, np.arange(1, len(positions) + 1) * 0.7, at_rest(there))


@pytest.mark.parametrize(
    ("at", "positions", "multi_turn", "ends"),
    [
        (3.1, [-3.1], False, 2 * np.pi - 3.1),  # 0.08 rad through pi
        (3.1, [-3.1], True, -3.1),  # 6.2 rad back
        (0.0, [7.0], False, 7.0 - 2 * np.pi),
        (0.0, [7.0], True, 7.0),
        (3.1, [-3.1, 3.1], False, 2 * np.pi + 3.1),  # its points keep their differences
        (3.1, [-3.1, -8.0], False, 2 * np.pi - 8.0),
    ],
)
def test_a_goal_leads_a_wheel_the_shorter_way_to_its_first_point_unless_turns_are_meant(
    at, positions, multi_turn, ends
):
    limits = {"constraints.shoulder.trajectory": 0.5, "constraints.shoulder.goal": 2e-3}
    group = wheel(at, multi_turn, **limits)
    group.begin(path(*positions))
    group.run(5.0, until=lambda: group.results)
    assert group.results == [(ResultCode.SUCCESSFUL, "goal reached")]
    assert group.position[0] == pytest.approx(ends, abs=5e-3)
    _, reference, _, position, _ = group.logged(0)
    assert max(np.abs(np.diff(reference))) < 0.03
    way = [at, *(np.array(positions) + ends - positions[-1])]
    assert min(position) > min(way) - 0.5
    assert max(position) < max(way) + 0.5


@pytest.mark.parametrize("multi_turn", [False, True])
def test_a_wheel_that_is_turns_away_stops_where_it_is_and_starts_from_there(multi_turn):
    group = wheel(0.0, multi_turn, **{"constraints.shoulder.goal": 2e-3})
    group.begin(path(5.0, 10.0, 15.0, 20.0))
    group.run(1.9)
    lost = group.position[0]
    group.note(
        group.follower.note_timeout(1.0)
    )  # states were away: it is told to hold where it is
    group.run(2.0)
    assert group.results[0].code is ResultCode.INVALID_GOAL
    held = group.position[0]
    assert lost > 7.0
    assert held == pytest.approx(lost, abs=3.0)  # and not whole turns back
    assert group.velocity[0] == pytest.approx(0.0, abs=0.01)
    group.begin(path(held + 0.5 if multi_turn else held + 0.5 - 4 * np.pi))
    group.run(3.0, until=lambda: len(group.results) > 1)
    assert group.results[1].code is ResultCode.SUCCESSFUL
    assert group.position[0] == pytest.approx(held + 0.5, abs=5e-3)


def test_a_goal_beyond_a_limit_is_refused_and_the_one_before_it_goes_on():
    facts = {"shoulder": JointFacts(lower=-0.5, upper=1.0), "elbow": JointFacts(-0.6, unit="m")}
    group = SimulatedGroup(facts=facts)
    group.run(0.2)
    group.begin(moving())
    group.run(0.3)
    for joint, places, line in (
        ("shoulder", [0.2, 1.1, 0.3], "point 1 leads shoulder to 1.1 rad, its limits"),
        ("elbow", [0.2, 0.1, -0.7], "point 2 leads elbow to -0.7 m, its limits are -0.6 and inf"),
    ):
        there = {**THERE, joint: places}
        with pytest.raises(GoalError, match=f"^{line}") as refused:
            group.begin(goal(there, TIMES, at_rest(there)))
        assert refused.value.code is ResultCode.INVALID_GOAL
    group.run(3.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.SUCCESSFUL


def test_a_joint_beyond_a_limit_may_be_led_back():
    group = SimulatedGroup(facts={"shoulder": JointFacts(upper=1.0), "elbow": JointFacts()})
    group.position[0] = 1.2
    group.run(0.2)
    back = {"shoulder": [1.2, 1.1, 0.9], "elbow": [0.0, 0.0, 0.0]}
    group.begin(goal(back, TIMES, at_rest(back)))
    further = {**back, "shoulder": [1.2, 1.3, 0.9]}
    with pytest.raises(GoalError, match=r"point 1 leads shoulder to 1\.3 rad"):
        group.begin(goal(further, TIMES, at_rest(further)))
    group.run(3.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.SUCCESSFUL
