"""Encoders that begin again after each turn, and the shorter way round."""

import math

import pytest
from harness.loops import loops_with
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.control import Gains
from hpid_ros.control.reference import Setpoint, whole_turns
from hpid_ros.control.velocity import Unwrapper
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS
TURN = Column("j", (Knot(0, 0.0, 3.0), Knot(20 * SECOND, 60.0, 3.0)), stamp_ns=1)

settings, loop_on = loops_with(joint="j", gains=Gains(100.0, 50.0, 20.0), law="pid")


@given(
    st.floats(-3.0, 3.0),
    st.lists(st.floats(-3.0, 3.0), max_size=60),
    st.sampled_from([0.0, math.pi]),
)
def test_increments_add_up_to_where_the_joint_really_is(first, steps, low):
    """Of an encoder within (-pi, pi], and of one within [0, 2 pi)."""
    unwrapper = Unwrapper(math.tau)
    place = first
    wrapped = (place + low) % math.tau - low
    offset = place - unwrapper.update(wrapped)
    assert offset == pytest.approx(math.tau * round(offset / math.tau), abs=1e-9)
    for step in steps:
        place += step
        wrapped = (place + low) % math.tau - low
        assert unwrapper.update(wrapped) + offset == pytest.approx(place, abs=1e-9)


@given(st.lists(st.floats(-60.0, 60.0), min_size=1, max_size=30))
def test_an_encoder_that_counts_its_turns_is_left_alone(places):
    unwrapper = Unwrapper(math.tau)
    unwrapper.update(20.0)
    for place in places:
        place = math.copysign(abs(place) + 7.0, place)
        assert unwrapper.update(place) == place


@pytest.mark.parametrize("has_wrapped", [False, True])
def test_what_was_not_seen_is_no_turn_unless_the_encoder_has_wrapped_before(has_wrapped):
    unwrapper = Unwrapper(math.tau)
    unwrapper.update(3.1)
    if has_wrapped:
        assert unwrapper.update(-3.1) == pytest.approx(math.tau - 3.1)
    unwrapper.interrupt()
    assert unwrapper.update(-2.5) == pytest.approx(math.tau * has_wrapped - 2.5)
    unwrapper.reset()
    assert unwrapper.update(-3.0) == -3.0


@pytest.mark.parametrize("low", [math.pi, 0.0])
@pytest.mark.parametrize(
    "source", ["measured", "filtered", "homogeneous_differentiator", "observer"]
)
def test_a_wheel_goes_round_without_a_kick(source, low):
    loop, twin = (
        loop_on(TURN, encoder_wrap=wrap, velocity_source=source, inertia=1.0)
        for wrap in (math.tau, 0.0)
    )
    for k in range(5000):
        place, speed = 3e-3 * k + 0.05 * math.sin(0.01 * k), 3.0 + 0.5 * math.cos(0.01 * k)
        wrapped = (place + low) % math.tau - low
        effort = twin.step(k * MS, place, speed)
        assert loop.step(k * MS, wrapped, speed) == pytest.approx(effort, abs=1e-6)
    assert loop.counts.jumps == loop.counts.takeovers == 0
    assert loop.following.position > 14.0


@pytest.mark.parametrize("wanted", [6.0, 3.0, -4.0, 20.0])
@pytest.mark.parametrize(
    ("wrap", "parameters", "takes_shorter_way"),
    [
        (0.0, {}, False),
        (-1.0, {}, False),
        (0.0, {"multi_turn": True}, False),
        (math.tau, {"multi_turn": True}, False),
        (math.tau, {"position_max": 30.0}, False),
        (math.tau, {}, True),
        (0.0, {"angle_wraparound": True}, True),
        (math.tau, {"angle_wraparound": True}, True),
    ],
)
def test_the_shorter_way_round_is_taken_where_the_encoder_wraps_or_it_is_asked_for(
    wanted, wrap, parameters, takes_shorter_way
):
    loop = loop_on(encoder_wrap=wrap, **parameters)
    loop.step(0, 0.0, 0.0)
    loop.follow(Setpoint(wanted))
    loop.step(MS, 0.0, 0.0)
    nearest = math.remainder(wanted, math.tau) if takes_shorter_way else wanted
    assert loop.following.position == pytest.approx(nearest, abs=1e-12)


@given(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_no_more_than_half_a_turn_is_left_and_half_a_turn_keeps_its_side(here, told):
    away = here - told
    left = away - whole_turns(away, math.tau)
    assert abs(left) <= math.pi * (1.0 + 1e-8)
    assert abs(left) == pytest.approx(abs(math.remainder(away, math.tau)), abs=1e-7)
    for halves in (-3, -1, 1, 3):
        there = here + halves * math.pi
        left = here - there - whole_turns(here - there, math.tau)
        assert left == pytest.approx(math.copysign(math.pi, -halves), abs=1e-6)


def travelled(changes, at=1500):
    """Return efforts of a wheel that turns, while its parameters are changed on the way."""
    loop, efforts = loop_on(TURN, encoder_wrap=math.tau), []
    for k in range(2500):
        if k == at:
            loop.retune(settings(**{"encoder_wrap": math.tau, **changes}))
        place = 3e-3 * k + 0.05 * math.sin(0.01 * k)
        if k >= at and changes.get("encoder_wrap") == 0.0:
            seen = place - math.tau * round(3e-3 * at / math.tau)
        else:
            seen = math.remainder(place, math.tau)
        efforts.append(loop.step(k * MS, seen, 3.0 + 0.5 * math.cos(0.01 * k)))
    return efforts, loop.counts


@pytest.mark.parametrize(
    "changes",
    [
        {"multi_turn": True},
        {"angle_wraparound": True},
        {"position_min": -1e3},
        {"encoder_wrap": math.tau * (1.0 + 1e-9)},
        {"encoder_wrap": 0.0},  # the driver, too, counts from there on
    ],
)
def test_what_becomes_of_turns_changes_on_the_way_without_a_kick(changes):
    plain, _ = travelled({})
    efforts, counts = travelled(changes)
    assert efforts == pytest.approx(plain, abs=1e-4)
    assert counts.jumps == counts.takeovers == 0


@pytest.mark.parametrize("multi_turn", [False, True])
def test_a_controller_that_is_started_again_joins_a_motion_in_the_turn_that_it_is_in(multi_turn):
    loop = loop_on(TURN, encoder_wrap=math.tau, multi_turn=multi_turn)
    errors = []
    for k in range(7000, 9000):  # its reference is at 21 rad by now
        loop.step(k * MS, math.remainder(3e-3 * k, math.tau), 3.0)
        errors.append(abs(loop.error))
    assert errors[0] == 0.0
    assert max(errors) < 0.45  # the glide begins at rest
    assert max(errors[600:]) < 1e-8  # of a stamp of 1 ns
    loop.follow(Setpoint(0.0))
    loop.step(9000 * MS, math.remainder(27.0, math.tau), 3.0)
    turns = 3 if multi_turn else 4
    assert abs(loop.error) == pytest.approx(27.0 - turns * math.tau)


def test_a_trajectory_is_taken_whole_turns_away_and_runs_on_as_it_is():
    loop = loop_on(angle_wraparound=True)
    loop.step(0, 12.0, 0.0)
    loop.follow(Column("j", (Knot(SECOND, 0.5, 0.0), Knot(3 * SECOND, 9.5, 0.0))))
    before = 12.0
    for k in range(1, 3100):
        loop.step(k * MS, before, 0.0)
        assert abs(loop.following.position - before) < 0.01  # no step anywhere, at no turn
        before = loop.following.position
    assert before == pytest.approx(9.5 + 2 * math.tau)
    loop.step(9 * SECOND, 0.1, 0.0)  # after a gap, the nearest turn again
    for k in range(1, 1500):
        loop.step(9 * SECOND + k * MS, 0.1, 0.0)
    assert loop.following.position == pytest.approx(9.5 - math.tau, abs=1e-9)


@pytest.mark.parametrize("source", ["filtered", "observer"])
def test_a_damping_stop_is_that_of_an_encoder_that_counts(source):
    """The joint turns twice before it and once in it."""
    values = {"velocity_source": source, "inertia": 1.0, "law": "pid", "multi_turn": True}
    wrapping, counting = loop_on(encoder_wrap=math.tau, **values), loop_on(**values)

    def places():
        for k in range(1, 2000):
            place = 12.0 * k * 1e-3
            yield k * MS, place, math.remainder(place, math.tau)

    states = places()
    for _ in range(1200):
        stamp_ns, place, wrapped = next(states)
        wrapping.step(stamp_ns, wrapped)
        counting.step(stamp_ns, place)
    ours, theirs = wrapping.damping_stop(0.6), counting.damping_stop(0.6)
    efforts = []
    for stamp_ns, place, wrapped in states:
        efforts.append(theirs.step(stamp_ns, place))
        assert ours.step(stamp_ns, wrapped) == pytest.approx(efforts[-1], abs=1e-6)
    assert efforts[0] == pytest.approx(-20.0 * 12.0, rel=0.1)
    assert efforts[-1] == 0.0


def test_a_damping_stop_gives_nothing_where_no_joint_can_have_come():
    loop, twin = (loop_on(velocity_source="filtered", velocity_max=20.0) for _ in range(2))
    for k in range(100):
        for each in (loop, twin):
            each.step(k * MS, 2.0 * k * 1e-3)
    stop, steady = loop.damping_stop(0.5), twin.damping_stop(0.5)
    for k in range(100, 110):
        assert stop.step(k * MS, 2.0 * k * 1e-3) == steady.step(k * MS, 2.0 * k * 1e-3) < 0.0
    assert stop.step(110 * MS, 0.22 + 1.0) == 0.0
    assert stop.step(111 * MS, 0.222) == pytest.approx(steady.step(111 * MS, 0.222))


@pytest.mark.parametrize("glitch", [0.0, 0.05, 1.0, -2.9])
@pytest.mark.parametrize("first", [3.1365, 3.0897, 2.0])  # it wraps after a glitch, or never
def test_a_position_that_is_refused_is_no_turn(first, glitch):
    """The loop, and what damps the joint in its place, go on as if it had not been there."""
    loop, clean = (loop_on(encoder_wrap=math.tau, velocity_max=2.0) for _ in range(2))

    def both(ours, theirs):
        for k in range(1, 40):
            place = math.remainder(first + 1.2e-3 * (begun + k), math.tau)
            effort = ours.step((begun + k) * MS, glitch if k == 4 else place, 1.2)
            if k == 4:
                continue
            wanted = theirs.step((begun + k) * MS, place, 1.2)
            assert effort == pytest.approx(wanted, rel=1e-3)

    begun = 0
    both(loop, clean)
    assert loop.counts.jumps == 1
    assert not loop.counts.takeovers
    begun = 39
    both(loop.damping_stop(0.5), clean.damping_stop(0.5))


@pytest.mark.parametrize("there", [math.pi, -1.0, 0.0])
def test_an_encoder_that_was_set_to_zero_is_believed_with_its_second_state(there):
    """Also half a turn away, where noise decides which way round it is."""
    loop = loop_on(encoder_wrap=math.tau, velocity_max=2.0)
    for k in range(5):
        loop.step(k * MS, 3.0, 0.0)
    place = math.remainder(3.0 + there, math.tau) if there else 0.1
    for k, noise in enumerate((1e-4, -1e-4, 1e-4)):
        loop.step((5 + k) * MS, place - noise, 0.0)
    assert (loop.counts.jumps, loop.counts.takeovers) == (1, 1)


def test_what_is_set_after_a_stamp_from_the_future_holds_when_it_is_forgotten():
    loop = loop_on(Setpoint(0.0), law="pid")
    for stamp_ns in (0, MS, 3600 * SECOND):
        loop.step(stamp_ns, 0.0, 0.0)
    loop.retune(settings(angle_wraparound=True))
    loop.step(2 * MS, 0.0, 0.0)
    loop.follow(Setpoint(6.0))
    loop.step(3 * MS, 0.0, 0.0)
    assert loop.following.position == pytest.approx(6.0 - math.tau)
