"""The barrier between control and physics."""

from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.simulation.lockstep import Barrier


def test_old_answers_and_foreign_joints_are_counted_and_change_nothing():
    barrier = Barrier(["a"])
    barrier.begin(5)
    assert not barrier.answer(4, ["a"], [9.0])
    assert not barrier.answer(5, ["z"], [9.0])
    assert (barrier.efforts, barrier.counts["a"].stale, barrier.foreign) == ([0.0], 1, 1)


def test_a_repeat_replaces_and_completes_only_once():
    barrier = Barrier(["a", "b"])
    barrier.begin(5)
    barrier.answer(5, ["a"], [1.0])
    assert not barrier.answer(5, ["a"], [3.0])
    assert barrier.answer(5, ["b"], [2.0])
    assert not barrier.answer(5, ["b"], [4.0])
    assert barrier.counts["a"].repeated == 1


def test_an_effort_that_is_not_finite_counts_as_an_answer_of_zero():
    barrier = Barrier(["a"])
    barrier.begin(5)
    assert barrier.answer(5, ["a"], [float("nan")])
    assert (barrier.finish(), barrier.counts["a"].invalid) == ([0.0], 1)


def test_a_silent_joint_gets_no_effort_is_not_waited_for_and_comes_back():
    barrier = Barrier(["a", "b"])
    barrier.begin(1)
    barrier.answer(1, ["b"], [2.0])
    assert barrier.time_out() == ("a",)
    assert barrier.finish() == [0.0, 2.0]
    barrier.begin(2)
    assert barrier.answer(2, ["b"], [2.0])  # complete without the silent one
    assert barrier.finish() == [0.0, 2.0]
    assert barrier.counts["a"].unanswered == 2
    barrier.begin(3)
    barrier.answer(3, ["a"], [1.0])
    assert barrier.silent == ()
    assert barrier.missing == ("b",)


@given(st.permutations(list("abcdefgh")), st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=8))
def test_efforts_do_not_depend_on_the_order_of_the_answers(order, values):
    barrier = Barrier("abcdefgh")
    efforts = dict(zip("abcdefgh", values, strict=True))
    barrier.begin(0)
    completed = [barrier.answer(0, [joint], [efforts[joint]]) for joint in order]
    assert completed == [False] * 7 + [True]
    assert barrier.finish() == values


def test_a_joint_whose_commands_carry_no_stamp_is_named_until_they_do():
    barrier = Barrier(["a", "b"])
    barrier.begin(5)
    barrier.answer(0, ["a"], [1.0])
    barrier.answer(4, ["b"], [1.0])  # late, and stamped
    assert barrier.unstamped == {"a"}
    barrier.answer(5, ["a"], [1.0])
    assert barrier.unstamped == set()
