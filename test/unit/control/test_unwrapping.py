"""Encoders that begin anew after each turn, and the shorter way round."""

import math

import pytest
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import Gains, JointLoop
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.velocity import Unwrapper
from hpid_ros.trajectory import Column, Knot

MS = 1_000_000
SECOND = 1000 * MS


def settings(**changes):
    values = {"joint": "j", "gains": Gains(100.0, 50.0, 20.0), "law": "pid"}
    return loop_settings(**{**values, **changes})


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


def test_what_was_not_seen_is_no_turn_unless_the_encoder_has_wrapped_before():
    for has_wrapped in (False, True):
        unwrapper = Unwrapper(math.tau)
        unwrapper.update(3.1)
        if has_wrapped:
            assert unwrapper.update(-3.1) == pytest.approx(math.tau - 3.1)
        unwrapper.interrupt()
        assert unwrapper.update(-2.5) == pytest.approx(math.tau * has_wrapped - 2.5)
        unwrapper.reset()
        assert unwrapper.update(-3.0) == -3.0


@pytest.mark.parametrize("low", [math.pi, 0.0])
@pytest.mark.parametrize("source", ["measured", "filtered", "homogeneous_differentiator"])
def test_a_wheel_goes_round_without_a_kick(source, low):
    loop = JointLoop(settings(encoder_wrap=math.tau, velocity_source=source))
    twin = JointLoop(settings(encoder_wrap=0.0, velocity_source=source))
    knots = (Knot(0, 1.0, 3.0), Knot(10 * SECOND, 31.0, 3.0))
    for each in (loop, twin):
        each.follow(Column("j", knots, stamp_ns=1))
    for k in range(10_000):
        place = 1.0 + 3e-3 * k + 0.05 * math.sin(0.01 * k)
        wrapped = (place + low) % math.tau - low
        speed = 3.0 + 0.5 * math.cos(0.01 * k)
        effort = twin.step(k * MS, place, speed)
        assert loop.step(k * MS, wrapped, speed) == pytest.approx(effort, abs=1e-6)
    assert loop.counts.jumps == loop.counts.takeovers == 0
    assert loop.reference[0] > 30.0


def test_without_it_a_turn_is_a_jump_and_not_a_full_effort():
    loop = JointLoop(settings(encoder_wrap=0.0))
    loop.follow(Setpoint(3.3))
    for k in range(200):
        before = loop.step(k * MS, 2.9 + 1e-3 * k, 1.0)
    efforts = [loop.step((200 + k) * MS, 3.1 + 1e-3 * k - math.tau, 1.0) for k in range(20)]
    assert loop.counts.jumps == 1
    assert max(abs(effort - before) for effort in efforts) < 1.1 * 20.0  # the derivative term


@pytest.mark.parametrize(("told", "leads"), [(6.0, 6.0 - math.tau), (3.0, 3.0), (-4.0, 2.283)])
def test_the_shorter_way_round_is_taken_where_it_is_asked_for(told, leads):
    for wraparound in (False, True):
        loop = JointLoop(settings(angle_wraparound=wraparound))
        loop.step(0, 0.0, 0.0)
        loop.follow(Setpoint(told))
        loop.step(MS, 0.0, 0.0)
        assert loop.reference[0] == pytest.approx(leads if wraparound else told, abs=1e-3)


def test_a_trajectory_is_taken_whole_turns_away_and_runs_on_as_it_is():
    loop = JointLoop(settings(angle_wraparound=True))
    loop.step(0, 12.0, 0.0)
    knots = (Knot(SECOND, 0.5, 0.0), Knot(3 * SECOND, 9.5, 0.0))
    loop.follow(Column("j", knots))
    before = 12.0
    for k in range(1, 3100):
        loop.step(k * MS, before, 0.0)
        assert abs(loop.reference[0] - before) < 0.01  # no step anywhere, at no turn
        before = loop.reference[0]
    assert before == pytest.approx(9.5 + 2 * math.tau)
    loop.step(9 * SECOND, 0.1, 0.0)  # after a gap, the nearest turn again
    for k in range(1, 600):
        loop.step(9 * SECOND + k * MS, 0.1, 0.0)
    assert loop.reference[0] == pytest.approx(9.5 - math.tau, abs=1e-9)


def test_the_shorter_way_is_not_for_joints_with_stops():
    with pytest.raises(SettingError, match="may lead through a stop"):
        settings(angle_wraparound=True, position_max=2.0)
