"""A relay is as strong and goes as far as shares of a joint's limits allow."""

import math
from dataclasses import replace

import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.motion.excitation import JointBounds, RelayWish, planned_relay

ELBOW = JointBounds("elbow", "/elbow_controller", 0.5, 2.0, -1.0, 1.0, 9.0, (-10.0, 8.0), 0.1)


def test_a_relay_takes_shares_of_what_is_left():
    planned = planned_relay(ELBOW, 0.1, 0.002, RelayWish(share=0.25))
    assert planned.request.amplitude == pytest.approx(0.25 * 6.0)
    assert planned.amplitude == pytest.approx(0.05)
    assert planned.request.deviation == pytest.approx(0.2)
    rate = 2.0 * math.pi / planned.period
    assert 4.0 * 1.5 / (math.pi * 0.1 * rate**2) == pytest.approx(planned.amplitude)
    # The harmonic balance: the lead's phase is what the hysteresis takes.
    leading = planned.amplitude * math.hypot(1.0, 0.1 * rate)
    assert math.asin(planned.request.hysteresis / leading) == pytest.approx(math.atan(0.1 * rate))


def test_a_slow_joint_moves_less_and_one_near_its_stop_too():
    slow = planned_relay(replace(ELBOW, velocity=1.0), 0.1, 0.002, RelayWish())
    assert slow.velocity == pytest.approx(0.3)
    assert slow.amplitude < 0.05
    near = planned_relay(replace(ELBOW, position=0.95), 0.1, 0.002, RelayWish())
    assert near.request.deviation == pytest.approx(0.8 * 0.05)
    assert near.amplitude == pytest.approx(0.2 * 0.05)


@pytest.mark.parametrize(
    ("changes", "wish", "line"),
    [
        ({"efforts": (-math.inf, math.inf)}, RelayWish(), "give --effort"),
        ({}, RelayWish(effort=7.0), "a relay of 7 does not fit between elbow's load of 2"),
        ({"position": 1.0}, RelayWish(), "elbow is at a limit"),
        ({"inertia": 1e-5}, RelayWish(), "fewer than 16 samples"),
        ({}, RelayWish(share=1.0), "the share of the effort"),
        ({}, RelayWish(effort=math.nan), "the effort must be positive"),
        ({}, RelayWish(amplitude=0.0), "the amplitude must be positive"),
        ({}, RelayWish(cycles=1), "5 to 50 cycles, not 1"),
    ],
)
def test_a_relay_without_room_is_refused(changes, wish, line):
    with pytest.raises(SettingError, match=line):
        planned_relay(replace(ELBOW, **changes), 0.1, 0.002, wish)
