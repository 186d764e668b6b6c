"""Samples of a joint: no peak is lost, errors are known, windows compare, old clocks end."""

import math

import numpy as np
import pytest
from harness.simulated_graph import loop_settings
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_ros.live.controllers import Samples
from hpid_ros.live.history import LONGEST, JointHistory, RisingCount, Track, extremes
from hpid_ros.metrics.indices import itae, total_variation

NONE = np.empty((0, 3))


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
    kept = rows[rows[:, 0] >= rows[-1, 0] - LONGEST]
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
