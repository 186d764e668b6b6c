"""Stops: constant decelerations within limits, whoever else stops at the same time."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_ros.motion import Column
from hpid_ros.nodes.parts.goals import LEAD_NS, Braking, coast_down, return_to, stop_together

MS = 1_000_000
SECOND = 1_000_000_000
LEAD = LEAD_NS / SECOND
SPEEDS = st.floats(-3.0, 3.0, allow_subnormal=False)
DECELERATIONS = st.floats(0.5, 30.0)


def path(knots):
    """Return positions, velocities and accelerations, each millisecond at first."""
    reference = Column("elbow", knots, 1).start(1, knots[0].position)
    end_ns = knots[-1].time_ns
    later = np.linspace(LEAD_NS + MS, max(end_ns, LEAD_NS) + 10 * MS, 100).astype(int)
    times = [*range(0, LEAD_NS + MS, MS), *sorted({*later.tolist(), end_ns})]
    return np.array([reference.sample(1 + time) for time in times]).T


def coasting(position, velocity, braking, acceleration=0.0):
    """Return the stop of a reference that would have gone on with an acceleration."""
    later = (
        position + velocity * LEAD + 0.5 * acceleration * LEAD**2,
        velocity + acceleration * LEAD,
    )
    return coast_down(position, velocity, later, braking)


@given(st.floats(-3.0, 3.0), SPEEDS, DECELERATIONS, st.floats(-5.0, 5.0))
def test_a_stop_goes_on_as_the_reference_did_and_then_decelerates_within_its_limit(
    position, velocity, deceleration, acceleration
):
    knots = coasting(position, velocity, Braking(deceleration, 0.5), acceleration)
    positions, velocities, accelerations = path(knots)
    k = np.arange(round(LEAD * 1000))
    before = position + velocity * k * 1e-3 + 0.5 * acceleration * (k * 1e-3) ** 2
    assert positions[k] == pytest.approx(before, abs=1e-9)
    assert np.abs(accelerations[len(k) :]).max() <= deceleration * (1.0 + 1e-9)
    at_lead = velocity + acceleration * LEAD
    distance = 0.5 * at_lead**2 / (0.9 * deceleration)
    assert abs(positions[-1] - positions[len(k)]) == pytest.approx(
        distance, abs=abs(at_lead) * 1e-3
    )
    assert velocities[-1] == 0.0
    assert np.all(np.sign(np.diff(positions[len(k) :])) * np.sign(at_lead) >= 0.0)


@given(SPEEDS, st.floats(0.1, 5.0))
def test_without_a_deceleration_a_stop_takes_its_time(velocity, duration):
    knots = coasting(0.0, velocity, Braking(0.0, duration))
    if velocity:
        assert knots[-1].time_ns - LEAD_NS == pytest.approx(duration * SECOND, abs=MS)
        assert knots[-1].position == pytest.approx(
            velocity * (LEAD + 0.5 * duration), abs=abs(velocity) * 1e-3 + 1e-12
        )


@given(st.floats(0.0, 0.5), SPEEDS, DECELERATIONS, st.floats(-5.0, 5.0))
def test_no_stop_passes_a_position_limit(room, velocity, deceleration, acceleration):
    upper, lower = room, -0.25
    braking = Braking(deceleration, 0.5, lower, upper)
    positions, velocities, _ = path(coasting(0.0, velocity, braking, acceleration))
    k = np.arange(round(LEAD * 1000) + 1) * 1e-3
    old = velocity * k + 0.5 * acceleration * k**2
    # Where the reference itself goes beyond it and comes back, no stop was asked for in between.
    slack = max(old.max() - upper, lower - old.min(), 0.0) if lower <= old[-1] <= upper else 0.0
    assert positions.max() <= upper + slack + 1e-9
    assert positions.min() >= lower - slack - 1e-9
    assert velocities[-1] == 0.0


@given(st.floats(0.0, 1.0), SPEEDS, DECELERATIONS)
@example(beyond=0.125, velocity=-2.5, deceleration=1.0)
def test_a_joint_beyond_a_limit_is_told_to_be_at_it(beyond, velocity, deceleration):
    knots = coasting(1.0 + beyond, velocity, Braking(deceleration, 0.5, upper=1.0))
    assert path(knots)[0].max() <= 1.0 + 1e-12


@given(st.floats(-1.0, 1.0), SPEEDS, DECELERATIONS)
def test_a_reference_returns_to_a_blocked_joint_within_its_acceleration(off, velocity, most):
    knots = return_to(0.5 + off, 0.5, velocity, Braking(most, 0.5))
    positions, velocities, accelerations = path(knots)
    assert np.abs(accelerations).max() <= most * (1.0 + 1e-9)
    assert (positions[0], velocities[0]) == (0.5, velocity)
    assert (positions[-1], velocities[-1]) == (0.5 + off, 0.0)


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), SPEEDS, DECELERATIONS), min_size=1, max_size=5))
def test_stopping_together_changes_nobodys_stop(joints):
    alone = [coasting(p, v, Braking(a, 0.5)) for p, v, a in joints]
    names = [f"joint_{k}" for k in range(len(joints))]
    now_ns = 7 * SECOND
    told = stop_together(names, alone, now_ns)
    assert told.names == tuple(names)
    assert np.all(np.diff(told.times_ns) > 0)
    assert told.column(0).is_under_way(now_ns)
    for joint, knots in enumerate(alone):
        together = told.column(joint).start(now_ns, 0.0)
        meant = Column("elbow", knots, told.stamp_ns).start(now_ns, 0.0)
        for time in range(0, 4000, 37):
            stamp_ns = told.stamp_ns + time * MS
            assert together.sample(stamp_ns)[:2] == pytest.approx(
                meant.sample(stamp_ns)[:2], abs=1e-8
            )
