"""Whoever sends a command: limits hold, and a second commander of a joint is found out."""

import pytest

from hpid_ros.nodes.parts.bridge_commanders import HeldCommands
from hpid_ros.simulation.lockstep import Barrier

MS = 1_000_000
LIMITS = {"a": 2.0}


def barrier():
    return Barrier(["a"], LIMITS)


def held():
    return HeldCommands(["a"], 100 * MS, LIMITS)


@pytest.mark.parametrize("make", [barrier, held])
def test_commands_are_held_to_the_limit_of_the_joint(make):
    commands = make()
    commands.begin(MS)
    for effort, acts in ((5.0, 2.0), (-5.0, -2.0), (1.5, 1.5)):
        commands.answer(MS, ["a"], [effort])
        assert commands.finish() == [acts]
    assert commands.counts["a"].excessive == 2


@pytest.mark.parametrize("make", [barrier, held])
def test_answers_to_one_state_that_differ_are_a_conflict(make):
    commands = make()
    commands.begin(MS)
    commands.answer(MS, ["a"], [1.0])
    commands.answer(MS, ["a"], [1.0])  # asked again
    assert commands.counts["a"].conflicting == 0
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1
    commands.answer(MS, ["a"], [0.0])  # the controller leaves
    assert commands.counts["a"].conflicting == 1


@pytest.mark.parametrize("make", [barrier, held])
def test_an_answer_to_the_state_before_that_differs_is_a_conflict(make):
    commands = make()
    for stamp_ns in (MS, 2 * MS):
        commands.begin(stamp_ns)
        commands.answer(stamp_ns, ["a"], [1.0])
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1


def test_a_command_without_a_stamp_beside_a_controller_is_a_conflict():
    commands = held()
    commands.begin(5 * MS)
    commands.answer(5 * MS, ["a"], [1.0])
    commands.answer(0, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 1


def test_commands_without_stamps_and_a_clock_that_went_back_are_none():
    commands = held()
    commands.begin(5 * MS)
    for effort in (1.0, 1.5, -1.0):
        commands.answer(0, ["a"], [effort])
    commands.answer(5 * MS, ["a"], [1.0])
    commands.begin(0)
    commands.answer(MS, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 0


def held_after(*acts):
    """Return the commands of joint a after some acts: times of states, or answers in [ms]."""
    held = HeldCommands(["a"], 100 * MS)
    for act in acts:
        if isinstance(act, int):
            held.begin(act * MS)
        else:
            stamp, effort = act
            held.answer(stamp * MS, ["a"], [effort])
    return held.finish(), held.counts["a"]


@pytest.mark.parametrize(
    ("acts", "effort", "counts"),
    [
        ((5, (2, 1.5), 6), 1.5, {"stale": 1}),  # late, and stands until the next
        ((5, (2, 1.5), 6, (3, -2.0)), -2.0, {"stale": 2}),
        ((0, (0, 1.5), 100), 1.5, {}),
        ((0, (0, 1.5), 101), 0.0, {"unanswered": 1}),  # too old
        ((50, (50, 1.5), 0), 0.0, {}),  # a clock that goes back
        ((0, (0, float("nan"))), 0.0, {"invalid": 1}),
    ],
)
def test_which_command_a_paced_robot_acts_on(acts, effort, counts):
    found, counted = held_after(*acts)
    assert found == [effort]
    for name, number in counts.items():
        assert getattr(counted, name) == number


def silent_then_late(times):
    """Return a barrier that gave its joint up and heard answers to states that were over."""
    commands = Barrier(["a", "b"])
    commands.begin(0)
    commands.answer(0, ["b"], [1.0])
    commands.time_out()
    for k in range(1, times + 1):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        commands.answer(k - 1, ["a"], [1.0])
    return commands


def test_a_controller_that_answers_too_late_is_waited_for_again():
    """Nobody waits for a silent joint: without this it would have to win a race to come back."""
    commands = silent_then_late(1)
    commands.begin(10)
    assert commands.missing == ("a", "b")
    commands.answer(10, ["a"], [2.0])
    commands.answer(10, ["b"], [1.0])
    assert (commands.silent, commands.finish()) == ((), [2.0, 1.0])


def test_one_that_is_always_too_late_is_believed_ever_more_rarely():
    commands = silent_then_late(1)
    waited = 0
    for k in range(10, 1010):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        if commands.missing:
            waited += 1
            commands.time_out()
        commands.answer(k - 1, ["a"], [1.0])
    assert 5 < waited < 12


def test_commands_of_foreign_joints_are_counted():
    held = HeldCommands(["a", "b"], 100 * MS)
    held.begin(0)
    held.answer(0, ["a", "c"], [1.0, 1.0])
    assert (held.foreign, held.silent) == (1, ("b",))
