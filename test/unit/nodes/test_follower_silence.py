"""Goals over states and references that stay away, come apart, or are of another clock."""

import math

import pytest
from harness.groups import MS, SECOND, THERE, SimulatedGroup, at_rest, goal, moving, started

from hpid_ros.control.reference import Setpoint
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.nodes.parts.goals import GoalError, ResultCode


def test_no_goal_is_taken_before_there_are_states_and_after_they_have_stopped():
    group = SimulatedGroup()
    with pytest.raises(GoalError, match="no state of shoulder yet"):
        group.begin(moving())
    group.run(0.2)
    assert group.follower.note_timeout(0.6) is None
    with pytest.raises(GoalError, match=r"no new state for 0\.6 s"):
        group.begin(moving())
    group.run(0.01)
    group.begin(moving())


def test_states_that_stop_abort_the_goal_and_the_joints_hold_where_they_are_found_again():
    group = started()
    group.run(0.5)
    outcome = group.follower.note_timeout(0.7)
    assert outcome.result.code is ResultCode.INVALID_GOAL
    assert "no new state for 0.7 s" in outcome.result.text
    assert outcome.trajectory is None
    group.position = [-0.3, 0.2]  # somebody has moved the arm meanwhile
    group.velocity = [0.0, 0.0]
    group.stamp_ns += SECOND
    group.run(1.5)
    assert [loop.following.reference for loop in group.loops] == [
        (pytest.approx(-0.3, abs=0.01), 0.0),
        (pytest.approx(0.2, abs=0.01), 0.0),
    ]


def test_after_a_silence_no_joint_waits_for_one_whose_states_stay_away():
    group = started()
    group.run(0.3)
    assert group.follower.note_timeout(0.7).trajectory is None
    group.stamp_ns += SECOND
    group.seen = lambda parts: parts[:1]
    group.told.clear()
    assert group.run(2.0, until=lambda: group.told) == pytest.approx(0.5, abs=0.01)
    assert [each.names for each in group.told] == [("shoulder",)]
    group.run(0.5)
    group.seen = lambda parts: parts
    group.run(0.01)
    assert [each.names for each in group.told] == [("shoulder",), ("elbow",)]
    group.run(2.0)
    group.begin(moving())


def late(group):
    """Have a silence, and then states of the first joint alone, with stamps that go on."""
    group.run(0.3)
    group.follower.note_timeout(0.7)
    group.seen = lambda parts: parts[:1]
    group.run(0.01)
    group.told.clear()
    return group


def test_a_follower_that_alone_lost_the_states_moves_nothing_as_it_ends():
    group = started()
    group.run(0.3)
    group.follower.note_timeout(0.7)
    group.seen = lambda parts: []
    group.run(2.0)
    there = [*group.position]
    assert there == pytest.approx([1.0, -0.5], abs=0.01)
    group.note(group.follower.leave("the node ends"))
    for _ in range(100):
        group.run(0.01)
        assert group.position == pytest.approx(there, abs=1e-3)


def test_a_follower_that_ends_before_the_states_are_back_leaves_no_motion_behind():
    group = started()
    group.run(0.3)
    group.follower.note_timeout(0.7)
    there = [*group.position]
    group.note(group.follower.leave("the node ends"))
    assert group.follower.leave("once more").trajectory is None
    group.seen = lambda parts: []
    group.stamp_ns += SECOND
    group.run(2.0)
    assert group.position == pytest.approx(there, abs=0.01)


def test_a_goal_that_begins_before_all_joints_were_stopped_is_followed():
    group = late(started())
    group.begin(moving())
    group.seen = lambda parts: parts
    group.run(3.0, until=lambda: len(group.results) > 1)
    assert group.results[-1].code is ResultCode.SUCCESSFUL
    assert len(group.told) == 1


def test_joints_that_another_node_has_taken_meanwhile_are_not_stopped():
    group = late(started())
    group.note(group.follower.yield_joints({"elbow"}))
    group.seen = lambda parts: parts
    group.run(1.0)
    assert [each.names for each in group.told] == [("shoulder",)]


def test_joints_that_another_node_has_taken_are_not_to_be_stopped_later():
    group = started()
    group.run(0.3)
    outcome = group.follower.yield_joints({"shoulder", "elbow"})
    assert outcome.trajectory is None
    assert not group.follower.holds_later
    assert late(started()).follower.holds_later


def test_a_clock_that_went_back_to_states_that_are_none_ends_nothing():
    group = started()
    group.run(0.3)
    group.stamp_ns = 0
    group.seen = lambda parts: [each._replace(position=math.nan) for each in parts]
    group.run(0.1)
    group.seen = lambda parts: parts
    group.run(3.0)
    group.begin(moving())


def test_a_paused_simulation_aborts_nothing():
    group = started(state_clock="simulated")
    group.run(0.5)
    assert group.follower.note_timeout(60.0) is None
    with pytest.raises(GoalError, match="no new state for 60 s"):
        group.begin(moving())
    group.run(1.0, until=lambda: group.results)
    assert [each.code for each in group.results] == [ResultCode.SUCCESSFUL]


def test_a_clock_that_goes_back_aborts_the_goal_and_moves_nothing():
    group = started(start_ns=50 * SECOND)
    group.run(0.5)
    group.stamp_ns = 0
    group.position, group.velocity = [0.0, 0.0], [0.0, 0.0]
    group.run(3.0)
    (result,) = group.results
    assert result.code is ResultCode.INVALID_GOAL
    assert "clock of the states went back by 50.7 s" in result.text
    assert group.position == pytest.approx([0.0, 0.0], abs=1e-3)
    group.begin(moving())
    group.run(2.0, until=lambda: len(group.results) > 1)
    assert group.results[1].code is ResultCode.SUCCESSFUL
    # Of an idle group, too: its controllers would begin the last trajectory anew.
    group.stamp_ns = 0
    group.position, group.velocity = [0.0, 0.0], [0.0, 0.0]
    group.run(3.0)
    assert group.position == pytest.approx([0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("ahead", "state_clock"),
    [(2.0, "wall"), (3600.0, "wall"), (1e8, "wall"), (76.4, "simulated")],
)
def test_a_clock_that_jumps_ahead_aborts_the_goal_and_stops_the_joints_where_they_are(
    ahead, state_clock
):
    """By the new clock the goal is over: they were led to its end, faster than it was planned."""
    group = started(start_ns=50 * SECOND, state_clock=state_clock)
    group.run(0.5)
    there, speeds = [*group.position], [abs(each) for each in group.velocity]
    before = len(group.log[0])
    group.stamp_ns += round(ahead * SECOND)
    group.run(3.0)
    (result,) = group.results
    assert result.code is ResultCode.INVALID_GOAL
    line, _, jumped = result.text.removesuffix(" s").rpartition(" ")
    assert line == "the clock of the states jumped ahead by"
    assert float(jumped) == pytest.approx(ahead, abs=0.01)
    for joint, place in enumerate(there):
        _, _, _, position, _ = group.logged(joint)
        assert max(abs(position[before:] - place)) < 0.4 * speeds[joint] + 0.01
        assert group.loops[joint].following.reference == (
            pytest.approx(group.position[joint], abs=0.01),
            0.0,
        )
    group.begin(moving())
    group.run(2.0, until=lambda: len(group.results) > 1)
    assert group.results[1].code is ResultCode.SUCCESSFUL


def test_a_single_stamp_from_the_future_ends_no_goal():
    group = started(start_ns=50 * SECOND)
    for _ in range(3):  # and more than one
        group.run(0.2)
        wrong_ns = group.stamp_ns + 3600 * SECOND
        group.note(group.follower.take_state(wrong_ns, [JointPart(0, group.position[0], 0.0)]))
    group.run(2.0, until=lambda: group.results)
    assert [each.code for each in group.results] == [ResultCode.SUCCESSFUL]


@pytest.mark.parametrize(
    ("window", "is_refused"),
    [((1, 2), True), ((9000, 9010), True), ((49, 60), False), ((3000, 3001), False)],
)
def test_a_goal_goes_on_where_others_send_what_controllers_refuse(window, is_refused):
    group = started(start_ns=50 * SECOND)
    group.run(0.3)
    window_ns = window[0] * SECOND, window[1] * SECOND
    group.note(group.follower.yield_joints({"elbow"}, window_ns))
    group.run(2.0, until=lambda: group.results)
    wanted = ResultCode.SUCCESSFUL if is_refused else ResultCode.INVALID_GOAL
    assert [each.code for each in group.results] == [wanted]


def test_a_process_that_stood_still_has_seen_no_clock_jump():
    group = started(start_ns=50 * SECOND)
    group.run(0.3)
    group.seen = lambda parts: []
    group.run(3.0)
    group.follower.allow_late(3.0)
    del group.seen
    group.run(1.0, until=lambda: group.results)
    assert [each.code for each in group.results] == [ResultCode.SUCCESSFUL]


def test_a_joint_that_is_missing_from_the_states_aborts_the_goal():
    group = started()
    group.run(0.3)
    group.seen = lambda parts: parts[:1]
    assert group.run(2.0, until=lambda: group.results) == pytest.approx(0.5, abs=0.01)
    (result,) = group.results
    assert "elbow has had no state for 0.5" in result.text
    with pytest.raises(GoalError, match="elbow has had no state"):
        group.begin(moving())


def test_a_controller_that_tells_its_reference_no_more_aborts_the_goal():
    group = started()
    group.run(0.3)
    group.mute = {1}
    group.run(2.0, until=lambda: group.results)
    assert "the controller of elbow has published no reference for 0.5" in group.results[0].text
    with pytest.raises(GoalError, match="controller of elbow has published no reference"):
        group.begin(moving())
    group.mute = set()
    group.run(0.1)
    group.begin(moving())


def test_references_that_wait_while_newer_states_are_taken_are_not_missed():
    group = started()
    group.run(0.3)
    group.mute, group.is_behind = {0, 1}, True
    group.run(0.6)
    assert group.follower.misses
    for joint, loop in enumerate(group.loops):
        group.note(group.follower.take_reference(joint, group.stamp_ns, loop.following.position))
    group.mute, group.is_behind = set(), False
    group.run(3.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.SUCCESSFUL


def test_what_is_missed_has_its_time_to_come_where_the_process_stood_still_before_confirming():
    group = started()
    group.run(0.3)
    group.mute, group.is_behind = {0, 1}, True
    group.run(0.6)
    group.follower.allow_late(0.2)
    assert group.follower.misses
    assert group.follower.confirm() is None
    group.is_behind = False
    assert group.run(2.0, until=lambda: group.results) == pytest.approx(0.7, abs=0.01)


def test_a_follower_that_has_fallen_behind_calls_no_goal_reached_whose_controller_is_gone():
    group = started()
    group.run(0.3)
    group.mute = {1}
    group.seen = lambda parts: []
    group.run(1.0)
    assert not group.results
    del group.seen  # the next state is behind the goal's end, and the first that shows a silence
    group.run(1.0, until=lambda: group.results)
    (result,) = group.results
    assert result.code is ResultCode.INVALID_GOAL
    assert "the controller of elbow has published no reference for" in result.text


def test_controllers_that_never_tell_their_references_are_taken_at_their_word():
    group = SimulatedGroup()
    group.mute = {0, 1}
    group.run(0.2)
    group.begin(moving())
    group.run(2.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.SUCCESSFUL


@pytest.mark.parametrize("is_deaf", [True, False])
def test_a_controller_that_follows_something_else_aborts_the_goal(is_deaf):
    group = SimulatedGroup()
    group.deaf = {1} if is_deaf else set()
    group.run(0.2)
    long = {name: [0.0, path[-1]] for name, path in THERE.items()}
    group.begin(goal(long, [0.0, 4.0], at_rest(long)))
    if not is_deaf:
        group.run(1.0)
        group.loops[1].follow(Setpoint(0.3))
    group.run(5.0, until=lambda: group.results)
    (result,) = group.results
    assert result.code is ResultCode.INVALID_GOAL
    assert "the reference of elbow's controller is at" in result.text
    assert "follows something else" in result.text


def test_joints_may_have_states_of_their_own_at_other_rates_and_stamps():
    """As where a gripper tells its states on a topic of its own."""
    group = SimulatedGroup(**{"constraints.elbow.goal": 2e-3, "constraints.elbow.trajectory": 0.1})
    late = 300_000  # [ns]; its stamps are never those of the others

    def apart(parts):
        if group.stamp_ns % (20 * MS) == 0:
            group.note(group.follower.take_state(group.stamp_ns - late, parts[1:]))
        return parts[:1]

    group.seen = apart
    group.run(0.2)
    group.begin(moving())
    group.run(3.0, until=lambda: group.results)
    assert group.results == [(ResultCode.SUCCESSFUL, "goal reached")]
    assert group.position == pytest.approx([1.0, -0.5], abs=5e-3)
    group.begin(goal({name: [0.0] for name in THERE}, [2.0]))
    group.run(0.2)
    group.seen = lambda parts: parts[:1]  # the other topic falls silent
    group.run(1.0, until=lambda: len(group.results) > 1)
    assert group.results[1].code is ResultCode.INVALID_GOAL
    assert group.results[1].text.startswith("elbow has had no state for 0.5")


@pytest.mark.parametrize(
    ("is_excused", "dead", "code"),
    [
        (True, set(), ResultCode.SUCCESSFUL),
        (True, {1}, ResultCode.INVALID_GOAL),
        (False, set(), ResultCode.INVALID_GOAL),
    ],
)
def test_what_came_while_nobody_called_is_not_missed_but_what_stays_away_is(
    is_excused, dead, code
):
    group = SimulatedGroup()
    group.run(0.2)
    slow = {name: [0.0, path[-1]] for name, path in THERE.items()}
    group.begin(goal(slow, [0.0, 3.0], at_rest(slow)))
    group.run(0.5)
    before, before_ns = list(zip(group.position, group.velocity, strict=True)), group.stamp_ns
    group.seen, group.mute = lambda parts: [], {0, 1}
    group.run(0.7)
    if is_excused:
        group.follower.allow_late(0.7)
        old = [JointPart(joint, *at) for joint, at in enumerate(before)]
        group.note(group.follower.take_state(before_ns + MS, old))  # one that was on its way
    del group.seen
    group.run(0.1)  # a state comes before the references do
    group.mute = dead
    group.run(4.0, until=lambda: group.results)
    assert group.results[0].code is code


def test_the_excuse_of_one_that_stood_still_is_no_longer_than_what_is_missed_takes():
    """However patient it is with states: a controller that has died is still seen."""
    group = SimulatedGroup(state_timeout=3.0)
    group.run(0.2)
    far = {name: [0.0, path[-1]] for name, path in THERE.items()}
    group.begin(goal(far, [0.0, 5.0], at_rest(far)))
    group.run(0.5)
    group.follower.allow_late(0.7)
    group.mute = {1}
    since_ns = group.stamp_ns
    group.run(4.0, until=lambda: group.results)
    assert group.results[0].code is ResultCode.INVALID_GOAL
    assert group.stamp_ns - since_ns <= 1.2 * SECOND + 10 * MS
