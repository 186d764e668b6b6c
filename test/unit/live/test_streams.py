"""Streams of messages as samples: the same numbers as message by message, on one clock."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.live.streams import (
    ControlClock,
    Heard,
    JointNumbers,
    JointSampler,
    MessageColumns,
    bare_numbers,
    joint_numbers,
)
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.messages.reports import MultiArrayTemplate

MS = 1_000_000
JOINT_STATE = "sensor_msgs/msg/JointState"
KINDS = [
    JointStateTemplate(["a", "b"], position=True, velocity=True, effort=True),
    JointStateTemplate(["a", "b"], position=True),
    JointStateTemplate(["b", "a"], position=True),  # as long as the one before
    JointStateTemplate(["a"], "/sender", effort=True),
    JointStateTemplate(["b"], "/sender", effort=True),
    JointStateTemplate(["c", "dd"], position=True),
]
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def messages(draw):
    kind = draw(st.sampled_from(KINDS))
    lengths = dict(zip(("position", "velocity", "effort"), kind.layout.lengths, strict=True))
    numbers = {k: draw(st.lists(NUMBERS, min_size=n, max_size=n)) for k, n in lengths.items() if n}
    return kind.encode(draw(st.integers(0, 2**31 - 1)) * MS, **numbers)


@given(st.lists(messages() | st.binary(max_size=80), max_size=60), st.integers(0, 60))
def test_many_messages_at_once_are_what_each_is_alone(raws, cut):
    columns = MessageColumns(JOINT_STATE)
    for part in (raws[:cut], raws[cut:]):  # the second time layouts are known
        parts = columns.read(part)
        for joint in ("a", "b"):
            found = joint_numbers(parts, joint)
            alone = [each for each in map(_read, part) if each is not None and joint in each.names]
            assert found.stamps_ns.tolist() == [each.stamp_ns for each in alone]
            for field in ("position", "velocity", "effort"):
                expected = [_number(each, field, joint) for each in alone]
                assert np.array_equal(getattr(found, field), expected, equal_nan=True)


def _read(raw):
    try:
        return decode_joint_state(raw)
    except ValueError:
        return None


def _number(fields, field, joint):
    numbers = getattr(fields, field)
    return numbers[fields.names.index(joint)] if len(numbers) == len(fields.names) else math.nan


def test_a_flood_of_layouts_holds_nobody_up():
    columns = MessageColumns(JOINT_STATE)
    templates = [JointStateTemplate([f"j{k:04}"], position=True) for k in range(2000)]
    raws = [each.encode(k, position=[k]) for k, each in enumerate(templates)]
    for _ in range(3):
        assert len(columns.read(raws)) < 300


def test_numbers_without_names_are_those_of_their_joint():
    template = MultiArrayTemplate(1)
    raws = [template.encode(0, effort=[k]) for k in range(5)]
    parts = MessageColumns("std_msgs/msg/Float64MultiArray").read([*raws, b"none"])
    assert bare_numbers(parts).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def numbers(stamps_ms, value=1.0, effort=math.nan):
    count = len(stamps_ms)
    return JointNumbers(
        np.array(stamps_ms, dtype=np.int64) * MS,
        *(np.full(count, each) for each in (value, math.nan, effort)),
    )


NONE = numbers([])


def heard(states, commands=NONE, bare=(), references=NONE):
    return Heard(states, commands, np.array(bare, dtype=float), references)


def test_time_begins_with_the_first_state_and_anew_when_stamps_go_back():
    sampler = JointSampler(ControlClock())
    before = sampler.take(heard(NONE, commands=numbers([5000], effort=1.0)))
    assert before.states.shape == (0, 3)
    assert before.efforts.shape == (0, 2)  # whose time nobody knows
    first = sampler.take(heard(numbers([5000, 5001, 5001, 5002])))
    assert first.states[:, 0] == pytest.approx([0.0, 1e-3, 1e-3, 2e-3])
    assert not first.is_restarted
    commands = numbers([5003, 5004, 100, 101], effort=2.0)
    again = sampler.take(heard(numbers([5003, 5004, 100, 101, 102]), commands))
    assert again.is_restarted
    assert again.states[:, 0] == pytest.approx([0.0, 1e-3, 2e-3])
    assert again.efforts[:, 0] == pytest.approx([0.0, 1e-3])
    assert not sampler.take(heard(numbers([103]))).is_restarted


@given(st.lists(st.integers(0, 50), min_size=1, max_size=40), st.data())
def test_no_time_goes_back_whatever_the_stamps_do_and_however_they_are_cut(stamps, data):
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stamps)), max_size=4)))
    sampler = JointSampler(ControlClock())
    times, restarts = [], 0
    for begin, end in zip([0, *cuts], [*cuts, len(stamps)], strict=True):
        samples = sampler.take(heard(numbers(stamps[begin:end])))
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
    left.take(heard(numbers([1000, 1001])))
    assert right.take(heard(numbers([1002]))).states[0, 0] == pytest.approx(2e-3)
    assert left.take(heard(numbers([10]))).is_restarted
    late = right.take(heard(numbers([1003])))  # has not gone back yet
    assert (late.is_restarted, late.states[0, 0]) == (False, pytest.approx(3e-3))
    joined = right.take(heard(numbers([12])))
    assert (joined.is_restarted, joined.states[0, 0]) == (True, pytest.approx(2e-3))
    assert left.take(heard(numbers([13]))).states[0, 0] == pytest.approx(3e-3)


def test_efforts_are_the_measured_ones_until_a_command_is_told():
    sampler = JointSampler(ControlClock())
    measured = sampler.take(heard(numbers([0, 1], effort=3.0)))
    assert measured.efforts.tolist() == [[0.0, 3.0], [1e-3, 3.0]]
    told = sampler.take(heard(numbers([2], effort=3.0), numbers([2], effort=4.0)))
    assert told.efforts.tolist() == [[2e-3, 4.0]]
    assert sampler.take(heard(numbers([3], effort=3.0))).efforts.shape == (0, 2)
    bare = sampler.take(heard(numbers([4, 5, 6]), bare=[7.0, 8.0]))
    assert bare.efforts.tolist() == [[5e-3, 7.0], [6e-3, 8.0]]
    ahead = sampler.take(heard(numbers([7]), bare=[1.0, 9.0]))
    assert ahead.efforts.tolist() == [[7e-3, 1.0], [7e-3, 9.0]]
