"""Streams of messages as samples: the same numbers as message by message, on one clock."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.live.streams import ControlClock, JointNumbers, JointSampler, joint_numbers
from hpid_ros.messages.joint_state import JointStateFields

MS = 1_000_000


def test_numbers_of_a_joint_are_taken_where_there_is_one_for_each_name():
    both = JointStateFields(7, "", ("a", "b", "a"), (1.0, 2.0, 3.0), (), (4.0, 5.0))
    found = joint_numbers([both, both._replace(names=("c",))], "a")
    assert found.stamps_ns.tolist() == [7]
    assert np.array_equal(found.values, [[1.0, math.nan, math.nan]], equal_nan=True)
    assert joint_numbers([], "a").values.shape == (0, 3)


def numbers(stamps_ms, value=1.0, effort=math.nan):
    count = len(stamps_ms)
    values = np.tile([value, math.nan, effort], (count, 1))
    return JointNumbers(np.array(stamps_ms, dtype=np.int64) * MS, values)


NONE = numbers([])


def taken(sampler, states, commands=NONE, bare=(), references=NONE):
    return sampler.take(states, commands, np.array(bare, dtype=float), references)


def test_time_begins_with_the_first_state_and_anew_when_stamps_go_back():
    sampler = JointSampler(ControlClock())
    before = taken(sampler, NONE, commands=numbers([5000], effort=1.0))
    assert before.states.shape == (0, 3)
    assert before.efforts.shape == (0, 2)  # whose time nobody knows
    first = taken(sampler, numbers([5000, 5001, 5001, 5002]))
    assert first.states[:, 0] == pytest.approx([0.0, 1e-3, 1e-3, 2e-3])
    assert not first.is_restarted
    commands = numbers([5003, 5004, 100, 101], effort=2.0)
    again = taken(sampler, numbers([5003, 5004, 100, 101, 102]), commands)
    assert again.is_restarted
    assert again.states[:, 0] == pytest.approx([0.0, 1e-3, 2e-3])
    assert again.efforts[:, 0] == pytest.approx([0.0, 1e-3])
    assert not taken(sampler, numbers([103])).is_restarted


@given(st.lists(st.integers(0, 50), min_size=1, max_size=40), st.data())
def test_no_time_goes_back_whatever_the_stamps_do_and_however_they_are_cut(stamps, data):
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stamps)), max_size=4)))
    sampler = JointSampler(ControlClock())
    times, restarts = [], 0
    for begin, end in zip([0, *cuts], [*cuts, len(stamps)], strict=True):
        samples = taken(sampler, numbers(stamps[begin:end]))
        if samples.is_restarted:
            times, restarts = [], restarts + 1
        times += samples.states[:, 0].tolist()
    assert times == sorted(times)
    assert times[0] == 0.0
    back = [k for k in range(1, len(stamps)) if stamps[k] < stamps[k - 1]]
    assert (restarts > 0) == bool(back)
    last = stamps[back[-1] :] if back else stamps
    assert times == pytest.approx([(each - last[0]) * 1e-3 for each in last])


def test_joints_of_one_robot_have_one_clock_though_two_publishers_tell_them():
    clock = ControlClock()
    left, right = JointSampler(clock), JointSampler(clock)
    taken(left, numbers([1000, 1001]))
    assert taken(right, numbers([1002])).states[0, 0] == pytest.approx(2e-3)
    assert taken(left, numbers([10])).is_restarted
    late = taken(right, numbers([1003]))  # has not gone back yet
    assert (late.is_restarted, late.states[0, 0]) == (False, pytest.approx(3e-3))
    joined = taken(right, numbers([12]))
    assert (joined.is_restarted, joined.states[0, 0]) == (True, pytest.approx(2e-3))
    assert taken(left, numbers([13])).states[0, 0] == pytest.approx(3e-3)


def test_efforts_are_the_measured_ones_until_a_command_is_told():
    sampler = JointSampler(ControlClock())
    measured = taken(sampler, numbers([0, 1], effort=3.0))
    assert measured.efforts.tolist() == [[0.0, 3.0], [1e-3, 3.0]]
    told = taken(sampler, numbers([2], effort=3.0), numbers([2], effort=4.0))
    assert told.efforts.tolist() == [[2e-3, 4.0]]
    assert taken(sampler, numbers([3], effort=3.0)).efforts.shape == (0, 2)
    bare = taken(sampler, numbers([4, 5, 6]), bare=[7.0, 8.0])
    assert bare.efforts.tolist() == [[5e-3, 7.0], [6e-3, 8.0]]
    ahead = taken(sampler, numbers([7]), bare=[1.0, 9.0])
    assert ahead.efforts.tolist() == [[7e-3, 1.0], [7e-3, 9.0]]
