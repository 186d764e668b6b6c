"""Stops: decelerations within limits, whoever else stops, and those of a goal that is followed."""

from dataclasses import replace

import numpy as np
import pytest
from harness.groups import MS, SECOND, SimulatedGroup, at_rest, goal, moving, started
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column
from hpid_ros.nodes.parts.goals import (
    LEAD_NS,
    Braking,
    JointFacts,
    ResultCode,
    coast_down,
    return_to,
    stop_together,
)

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


# --- of a goal that is followed


@settings(max_examples=10)
@given(st.floats(0.1, 0.9), st.floats(2.0, 20.0), st.integers(0, 9), st.integers(0, 20))
@example(at=0.25, most=20.0, seed=3, most_delay=15)
def test_a_cancelled_goal_decelerates_within_its_limit_and_holds(at, most, seed, most_delay):
    name = "max_deceleration_on_cancel"
    group = SimulatedGroup(
        seed=seed,
        most_delay=most_delay,
        **{f"constraints.shoulder.{name}": most, f"constraints.elbow.{name}": 0.5 * most},
    )
    group.run(0.2)
    group.begin(moving())
    group.run(at)
    now = group.stamp_ns / SECOND
    group.cancel()
    assert group.results == [(ResultCode.SUCCESSFUL, "cancelled: the joints stop and hold")]
    assert not group.follower.is_active
    group.run(0.05 + 1.6 / (0.5 * most) + 0.6 + 0.001 * most_delay)
    for joint, limit in enumerate((most, 0.5 * most)):
        stamps, reference, velocity, _, _ = group.logged(joint)
        after = stamps > now + 0.051
        # A controller that took the goal up late glides onto it still; that comes on top.
        glide = 0.025 * most_delay  # [rad/s^2]
        assert np.abs(np.diff(velocity[after])).max(initial=0.0) <= (limit + glide) * 1e-3
        assert velocity[-1] == 0.0
        assert np.abs(np.diff(reference)).max() < 2e-3
        assert np.ptp(reference[stamps > stamps[-1] - 0.3]) < 1e-12  # rounding


@settings(max_examples=10)
@given(st.floats(0.1, 0.9), st.floats(0.001, 0.2))
def test_a_stop_never_passes_a_position_limit(at, room):
    most = {"constraints.shoulder.max_deceleration_on_cancel": 0.5}
    group = SimulatedGroup(("shoulder",), **most)
    group.run(0.2)
    group.begin(goal({"shoulder": [0.0, 1.0]}, [0.0, 1.0], {"shoulder": [0.0, 0.0]}))
    group.run(at)
    upper = group.loops[0].following.position + room
    # No goal leads beyond a limit; this one does, once it is under way.
    group.follower.settings = replace(group.settings, facts=(JointFacts(upper=upper),))
    group.cancel()
    (told,) = group.told[1:]
    assert told.arrays[0].max() <= upper
    stop = told.column(0).start(group.stamp_ns, 0.0)
    path = [stop.sample(told.stamp_ns + k * MS).position for k in range(3000)]
    assert max(path) <= upper + 1e-12
    assert path[-1] == path[-2]


def test_controllers_take_the_stop_of_a_goal_that_led_to_the_end_of_the_numbers():
    group = SimulatedGroup(("shoulder",), **{"constraints.shoulder.goal": 0.1})
    group.run(0.2)
    group.begin(goal({"shoulder": [1e9]}, [1e-9]))
    group.run(0.2)
    group.cancel()
    _, told = group.told
    assert max(np.abs(each).max() for each in told.arrays[:2]) == 1e9  # beyond, it is refused


def test_leaving_ends_the_goal_and_stops():
    group = started()
    group.run(0.5)
    group.note(group.follower.leave("the node ends"))
    assert group.results == [(ResultCode.INVALID_GOAL, "the node ends")]
    group.run(1.5)
    assert [loop.following.velocity for loop in group.loops] == [0.0, 0.0]
    assert group.follower.leave("again") == (None, None)
    assert group.follower.cancel() == (None, None)


def test_a_goal_gives_way_to_another_trajectory_and_stops_only_the_joints_that_it_does_not_name():
    group = started(allow_partial_joints_goal=True)
    group.run(0.5)
    group.loops[1].follow(Setpoint(0.7))
    group.note(group.follower.yield_joints(["elbow", "of another robot"]))
    (result,) = group.results
    assert result == (ResultCode.INVALID_GOAL, "another node has sent a trajectory for elbow")
    assert group.told[-1].names == ("shoulder",)
    group.run(1.5)
    assert [loop.following.reference for loop in group.loops][1] == (0.7, 0.0)
    assert group.loops[0].following.velocity == 0.0
    assert abs(group.loops[0].following.position) < 0.9  # of 1.0
    group.begin(goal({"elbow": [0.7]}, [0.5], at_rest({"elbow": [0.7]})))
    group.run(2.0, until=lambda: len(group.results) > 1)
    assert group.results[-1].code is ResultCode.SUCCESSFUL


def test_of_two_trajectories_at_the_same_time_none_is_followed():
    group = started(allow_partial_joints_goal=True)
    group.run(0.09)
    group.loops[1].follow(Setpoint(0.7))  # this one heard the other last
    group.note(group.follower.yield_joints(["elbow"]))
    (result,) = group.results
    assert result.code is ResultCode.INVALID_GOAL
    assert result.text.endswith("for elbow at the same time: the joints stop")
    assert set(group.told[-1].names) == {"shoulder", "elbow"}
    group.run(20.0)  # as slowly as the stop was planned
    assert [loop.following.velocity for loop in group.loops] == [0.0, 0.0]
    ends = [loop.following.position for loop in group.loops]
    assert ends == pytest.approx([0.0, 0.0], abs=0.3)  # neither 1.0, where the goal led, nor 0.7


def test_trajectories_of_other_joints_and_without_a_goal_are_nobodys_business():
    group = started()
    assert group.follower.yield_joints(["of another robot"]) == (None, None)
    assert group.follower.is_active
    group.cancel()
    assert group.follower.yield_joints(["elbow"]) == (None, None)
