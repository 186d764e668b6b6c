"""Sampling by joint_trajectory_controller's rules, and the generators."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.motion import (
    Column,
    JointTrajectory,
    Knot,
    TrajectoryPoint,
    minimum_jerk,
    sine,
    step,
)

SECOND = 1_000_000_000
VALUES = st.floats(-10.0, 10.0)
DURATIONS = st.integers(SECOND // 100, 20 * SECOND)


def jtc_interpolate(a, b, duration, t):
    """joint_trajectory_controller's formulas, written out from its documentation by degree.

    The boundary conditions are solved as a linear system, so that nothing is shared with the
    closed forms under test.
    """
    degree = 1 + 2 * (a.velocity is not None and b.velocity is not None)
    if degree == 3 and a.acceleration is not None and b.acceleration is not None:
        degree = 5

    def row(time, derivative):
        return [
            math.perm(power, derivative) * time ** (power - derivative)
            if power >= derivative
            else 0.0
            for power in range(degree + 1)
        ]

    rows, values = [], []
    for knot, time in ((a, 0.0), (b, duration)):
        given_values = (knot.position, knot.velocity, knot.acceleration)
        for derivative in range((degree + 1) // 2):
            rows.append(row(time, derivative))
            values.append(given_values[derivative])
    coefficients = np.linalg.solve(np.array(rows), np.array(values))
    return [float(np.dot(row(t, derivative), coefficients)) for derivative in range(3)]


@given(
    st.tuples(VALUES, VALUES, VALUES),
    st.tuples(VALUES, VALUES, VALUES),
    st.integers(SECOND // 10, 5 * SECOND),
    st.floats(0.0, 0.999),
    st.sampled_from([1, 3, 5]),
    st.sampled_from([1, 3, 5]),
)
def test_segment_degree_is_what_both_ends_allow(start, end, duration_ns, share, first, last):
    def knot(time_ns, values, degree):
        return Knot(time_ns, *(values[k] if k <= degree // 2 else None for k in range(3)))

    a, b = knot(0, start, first), knot(duration_ns, end, last)
    reference = Column("j", (a, b)).start(7 * SECOND, 0.0)
    t_ns = int(share * duration_ns)
    expected = jtc_interpolate(a, b, duration_ns * 1e-9, t_ns * 1e-9)
    scale = 1.0 + max(abs(value) for value in expected)
    sample = reference.sample(7 * SECOND + t_ns)
    assert np.allclose(sample, expected, rtol=0.0, atol=1e-8 * scale)


def test_before_the_first_knot_the_reference_runs_from_where_it_stood():
    column = Column("j", (Knot(2 * SECOND, 1.0, 0.0),), stamp_ns=10 * SECOND)
    reference = column.start(9 * SECOND, position=-1.0, velocity=0.5)
    assert reference.sample(9 * SECOND)[:2] == (-1.0, 0.5)
    middle = jtc_interpolate(Knot(0, -1.0, 0.5), Knot(0, 1.0, 0.0), 3.0, 1.5)
    assert np.allclose(reference.sample(10 * SECOND + SECOND // 2), middle)
    assert reference.sample(12 * SECOND).position == 1.0


def test_without_velocities_the_approach_is_linear():
    reference = Column("j", (Knot(SECOND, 3.0),)).start(SECOND, position=1.0)
    assert reference.sample(SECOND + SECOND // 2) == (2.0, 2.0, 0.0)


def test_stamp_zero_starts_now_and_a_past_stamp_joins_in_the_middle():
    knots = (Knot(0, 0.0), Knot(10 * SECOND, 10.0))
    now = Column("j", knots).start(5 * SECOND, position=9.0)
    past = Column("j", knots, stamp_ns=2 * SECOND).start(5 * SECOND, position=9.0)
    assert now.sample(5 * SECOND).position == 0.0
    assert past.sample(5 * SECOND).position == pytest.approx(3.0)


@given(st.lists(st.tuples(DURATIONS, VALUES, VALUES, VALUES), min_size=1, max_size=6), st.data())
def test_sampling_passes_every_knot_and_then_holds(steps, data):
    time_ns, knots = 0, []
    for duration, *values in steps:
        time_ns += duration
        knots.append(Knot(time_ns, *values))
    reference = Column("j", tuple(knots)).start(SECOND, 0.0)
    for knot in data.draw(st.permutations(knots)):  # in any order
        assert reference.sample(SECOND + knot.time_ns).position == knot.position
    assert reference.sample(SECOND + time_ns + 1) == (knots[-1].position, 0.0, 0.0)
    assert reference.sample(SECOND + time_ns + 10**15).position == knots[-1].position


@pytest.mark.parametrize(
    ("joints", "points", "message"),
    [
        ((), (TrajectoryPoint(0, ()),), "each of its joints once"),
        (("a", "a"), (TrajectoryPoint(0, (0.0, 0.0)),), "each of its joints once"),
        (("a",), (), "at least one point"),
        (("a",), (TrajectoryPoint(0, ()),), "must have 1 positions, not 0"),
        (("a",), (TrajectoryPoint(0, (math.nan,)),), "must be finite, not nan for 'a'"),
        (("a",), (TrajectoryPoint(0, (0.0,), (1.0, 2.0)),), "0 or 1 velocities, not 2"),
        (("a",), (TrajectoryPoint(-1, (0.0,)),), "times must increase"),
        (("a",), (TrajectoryPoint(5, (0.0,)), TrajectoryPoint(5, (0.0,))), "times must increase"),
    ],
)
def test_malformed_trajectories_are_refused_in_one_line(joints, points, message):
    with pytest.raises(TrajectoryError, match=message) as refusal:
        JointTrajectory(joints, points)
    assert "\n" not in str(refusal.value)


def test_a_column_that_is_not_there_names_the_nearest():
    trajectory = JointTrajectory(("elbow", "wrist"), (TrajectoryPoint(0, (0.0, 1.0)),))
    with pytest.raises(TrajectoryError, match="did you mean 'elbow'"):
        trajectory.column("elbw")


def test_minimum_jerk_is_the_known_polynomial():
    reference = minimum_jerk([0.0, 2.0], {"j": [1.0, 3.0]}).column("j").start(0, 0.0)
    for share in np.linspace(0.0, 0.999, 50):
        expected = 1.0 + 2.0 * (10 * share**3 - 15 * share**4 + 6 * share**5)
        assert reference.sample(round(share * 2 * SECOND)).position == pytest.approx(expected)


def test_step_holds_and_jumps_within_a_nanosecond():
    reference = step([0.0, 1.0], {"j": [0.5, -0.5]}).column("j").start(0, 0.0)
    assert reference.sample(SECOND - 1).position == 0.5
    assert reference.sample(SECOND).position == -0.5
    assert reference.sample(SECOND // 2) == (0.5, 0.0, 0.0)


def test_sine_is_a_sine_in_position_velocity_and_acceleration():
    signal = {"amplitude": 0.7, "period": 1.3, "offset": 0.2, "phase": 0.4}
    slow = {"amplitude": 0.1, "period": 4.0}
    reference = sine(3.0, {"j": signal, "k": slow}).column("j").start(0, 0.0)
    w = 2 * math.pi / 1.3
    for t_ns in range(0, 3 * SECOND, 17_000_001):
        t = t_ns * 1e-9
        sample = reference.sample(t_ns)
        assert sample.position == pytest.approx(0.2 + 0.7 * math.sin(w * t + 0.4), abs=1e-8)
        assert sample.velocity == pytest.approx(0.7 * w * math.cos(w * t + 0.4), abs=1e-5)
        assert sample.acceleration == pytest.approx(-0.7 * w**2 * math.sin(w * t + 0.4), abs=5e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: minimum_jerk([0.0, 1.0], {"j": [0.0]}), "each of the 2 times, not 1"),
        (lambda: minimum_jerk([0.0, 0.0], {"j": [0.0, 1.0]}), "times must increase"),
        (lambda: sine(0.0, {"j": {"amplitude": 1.0, "period": 1.0}}), "positive finite time"),
        (lambda: sine(1.0, {"j": {"amplitude": 1.0}}), "lacks period"),
        (lambda: sine(1.0, {"j": {"amplitude": 1.0, "period": 0.0}}), "must be positive"),
        (lambda: step([math.nan], {"j": [0.0]}), "must be finite"),
    ],
)
def test_generators_refuse_numbers_that_make_no_trajectory(make, message):
    with pytest.raises(TrajectoryError, match=message):
        make()
