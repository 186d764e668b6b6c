"""Samples of a joint, from streams of messages: on one clock, no peak lost, errors known."""

import math

import numpy as np
import pytest
from harness.simulated_graph import loop_settings
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_bench.live.history import LONGEST_HISTORY, JointHistory, RisingCount, Track, extremes
from hpid_bench.live.known_controllers import Samples
from hpid_bench.live.streams import ControlClock, JointNumbers, JointSampler, joint_numbers
from hpid_ros.messages.joint_state import JointStateFields
from hpid_ros.metrics.indices import itae, total_variation

MS = 1_000_000
DECOUPLING = {"compensation": "decoupling", "gains.p": 80.0, "gains.i": 100.0, "gains.d": 8.0}


def samples(begin, end, position=lambda t: 0.0 * t, effort=lambda t: 0.0 * t, reference=0.0):
    t = np.arange(round(begin * 1000), round(end * 1000)) / 1000
    told = t[::50]
    return Samples(
        np.column_stack([t, position(t), np.gradient(position(t), 1e-3)]),
        np.column_stack([t, effort(t)]),
        np.column_stack([told, np.full_like(told, reference), np.zeros_like(told)]),
    )


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60), st.integers(min_value=2, max_value=8)
)
def test_few_samples_have_the_extremes_of_all_in_the_order_of_time(values, most):
    times = np.arange(len(values), dtype=float)
    flat = extremes(times, np.array(values), most)
    kept_times, kept = flat[::2], flat[1::2]
    assert kept_times == sorted(set(kept_times))
    assert len(kept) <= max(most, 4)
    assert (min(kept), max(kept)) == (min(values), max(values))
    assert all(values[int(at)] == value for at, value in zip(kept_times, kept, strict=True))


@given(st.lists(st.integers(1, 700), min_size=1, max_size=30))
def test_a_track_keeps_the_newest_rows_whatever_the_pieces(sizes):
    track, rows = Track(2), np.column_stack([np.arange(sum(sizes)) * 0.05, np.arange(sum(sizes))])
    first = 0
    for size in sizes:
        track.append(rows[first : first + size])
        first += size
    kept = rows[rows[:, 0] >= rows[-1, 0] - LONGEST_HISTORY]
    assert np.array_equal(track.rows, kept)


def test_a_peak_of_one_sample_is_drawn():
    history = JointHistory(loop_settings("elbow"))
    history.append(samples(0, 1, effort=lambda t: np.where(t == 0.437, 31.0, 1.0)))
    assert 31.0 in history.drawn()["effort"][1::2]
    assert history.drawn()["effort"] == []  # nothing is drawn twice


def test_in_pieces_or_at_once_the_numbers_are_the_same():
    whole, pieces = (JointHistory(loop_settings("elbow")) for _ in range(2))
    course = {"position": lambda t: 0.1 * np.sin(3 * t), "effort": lambda t: np.cos(5 * t)}
    whole.append(samples(0, 3, **course))
    rows = whole._errors.rows  # of a reference at 0, up to the newest one
    assert rows[:, 1] == pytest.approx(-0.1 * np.sin(3 * rows[:, 0]))
    assert rows[-1, 0] == pytest.approx(2.95)
    for begin in np.arange(0, 3, 0.1):
        pieces.append(samples(begin, begin + 0.1, **course))
    assert pieces.indices(2.0) == pytest.approx(whole.indices(2.0), rel=1e-9)


def test_indices_are_those_of_the_metrics():
    history = JointHistory(loop_settings("elbow"))
    history.append(samples(0, 4.001, lambda t: 0.1 * np.sin(3 * t), lambda t: np.cos(5 * t)))
    assert all(math.isnan(each) for each in JointHistory(loop_settings("elbow")).indices(5.0))
    found = history.indices(1.9999)  # stamps are no decimals
    t = np.arange(2001, 4001) / 1000
    assert found.ivc_rate == pytest.approx(total_variation(np.cos(5 * t)) / 1.999)
    assert found.itae_rate == pytest.approx(
        itae(t - 2.001, -0.1 * np.sin(3 * t)) / (0.5 * 1.999**2)
    )
    assert found.error == pytest.approx(np.max(np.abs(0.1 * np.sin(3 * t))))


def test_a_clock_that_goes_back_begins_anew():
    history = JointHistory(loop_settings("elbow"))
    history.append(samples(5, 6))
    again = samples(0, 0.2)
    history.append(Samples(again.states, again.efforts, again.references, is_restarted=True))
    assert history.now == pytest.approx(0.199)
    assert min(history.drawn()["position"][::2]) == 0.0


def test_an_encoder_that_begins_anew_has_the_error_of_the_shorter_way():
    history = JointHistory(loop_settings("wheel", encoder_wrap=math.tau))
    history.append(samples(0, 1, position=lambda t: 0.0 * t + 3.1, reference=-3.1))
    assert history.indices(1.0).error == pytest.approx(math.tau - 6.2)


def test_norm_and_multiplier_are_those_of_the_law():
    settings = loop_settings("elbow", **{"norm.floor": 0.0})
    history = JointHistory(settings)
    history.append(samples(0, 1, position=lambda t: 0.0 * t, reference=3.0 / settings.gains.p))
    drawn = history.drawn()
    for name in ("norm", "multiplier"):
        assert set(np.round(drawn[name][1::2], 6)) == {1.0}
    linear = JointHistory(loop_settings("elbow", law="pid"))
    linear.append(samples(0, 1, reference=0.1))
    assert linear.drawn()["norm"] == []


def test_decoupling_whose_inertia_its_model_has_is_drawn_without_a_norm():
    history = JointHistory(loop_settings("elbow", inertia=0.0, **DECOUPLING))
    history.append(samples(0, 1, reference=0.1))
    assert history.drawn()["norm"] == []
    assert history.indices(1.0).error == 0.1


def test_a_count_rises_for_as_long_as_it_has_grown_lately():
    count = RisingCount(10.0)
    told = [(5, 0.0), (5, 1.0), (6, 2.0), (6, 12.0), (6, 12.1), (0, 13.0), (2, 14.0)]
    rises = [count.tell(*each) for each in told]
    assert rises == [False, False, True, True, False, False, True]


@given(
    st.lists(
        st.tuples(st.lists(st.floats(0, 9), max_size=9), st.lists(st.floats(0, 99), max_size=9)),
        min_size=1,
        max_size=6,
    ),
    st.floats(allow_nan=False, allow_infinity=False),
)
@example([([0.0], [2.5, 0.5]), ([], [0.0])], 1.0)
@example([([0.0, 0.1, 0.2], [0.0, 0.1])], 1e300)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_no_number_and_no_reference_that_is_late_ends_what_is_drawn(pieces, position):
    history = JointHistory(loop_settings("elbow", mu=0.2))
    for number, (states, references) in enumerate(pieces):
        times = np.sort(states) + 10.0 * number
        told = np.array(references)  # in any order, of any time
        history.append(
            Samples(
                np.column_stack([times, np.full_like(times, position), 0.0 * times]),
                np.empty((0, 2)),
                np.column_stack([told, 0.0 * told, 0.0 * told]),
            )
        )
        drawn = history.drawn()
        assert all(np.isfinite(each).all() for each in drawn.values())
    history.indices(5.0)


# --- from streams of messages


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


NO_NUMBERS = numbers([])


def taken(sampler, states, commands=NO_NUMBERS, bare=(), references=NO_NUMBERS):
    return sampler.take(states, commands, np.array(bare, dtype=float), references)


def test_time_begins_with_the_first_state_and_anew_when_stamps_go_back():
    sampler = JointSampler(ControlClock())
    before = taken(sampler, NO_NUMBERS, commands=numbers([5000], effort=1.0))
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


def test_a_joint_that_is_for_a_while_at_its_effort_limit_is_saturated():
    history = JointHistory(loop_settings("elbow"))  # within 50 N m
    assert not history.is_saturated
    history.append(samples(0, 1, effort=lambda t: np.where(t < 0.9, 50.0, 3.0)))
    assert not history.is_saturated
    history.append(samples(1, 2, effort=lambda t: 0.0 * t - 50.0))
    assert history.is_saturated


def test_a_joint_is_as_far_from_its_reference_as_it_was_at_least_for_a_while():
    history = JointHistory(loop_settings("elbow"))
    assert math.isnan(history.distance)
    history.append(samples(0, 2, lambda t: np.where(t < 1.7, 0.3, 0.1), reference=0.5))
    assert history.distance == pytest.approx(0.2)
    history.append(samples(2, 3, lambda t: 0.0 * t + 0.1, reference=0.5))
    assert history.distance == pytest.approx(0.4)
    later = samples(3, 6)
    history.append(Samples(later.states, later.efforts, later.references[:0]))
    assert math.isnan(history.distance)  # its controller publishes none any more
