"""Motor, bridge, encoder and homing run, each by itself, against its own closed form."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.drives import Motor, Pwm
from hpid_ros.simulation.settings import Encoder, GripCommand, GripperSettings, Homing

MOTOR = Motor(torque_constant=0.03, resistance=0.8, supply_voltage=24.0)
PWMS = st.builds(Pwm, st.integers(1, 16), st.floats(0.0, 0.9))
PERIOD = 1e-3  # [s]
POSITIONS = st.floats(-10.0, 10.0)
PARTS = st.floats(-1.0, 1.0)
MOTORS = st.builds(
    Motor,
    st.floats(1e-3, 1.0),
    st.floats(0.05, 20.0),
    st.floats(1.0, 100.0),
    gear_efficiency=st.floats(0.2, 1.0),
    drive=st.sampled_from(["current", "voltage"]),
)
FAR = st.floats(-1e3, 1e3)
ENCODERS = st.builds(Encoder, st.integers(1, 1_000_000), st.floats(-0.5, 0.5))
ROUNDING = 1e-12  # [rad], of the arithmetic itself at 1e3 rad


def stall_torque(motor: Motor) -> float:
    return motor.torque_constant * motor.supply_voltage / motor.resistance


def no_load_speed(motor: Motor) -> float:
    return motor.supply_voltage / motor.torque_constant


@given(motor=MOTORS, part=PARTS, speed=st.floats(-2.0, 2.0))
def test_a_current_loop_gives_the_torque_asked_for_as_far_as_the_line_reaches(
    motor: Motor, part: float, speed: float
):
    motor = replace(motor, drive="current")
    wanted, omega = part * stall_torque(motor), speed * no_load_speed(motor)
    given_torque = motor.torque(motor.duty(wanted, omega), omega)
    low, high = (stall_torque(motor) * (end - speed) for end in (-1.0, 1.0))
    expected = min(max(wanted, low), high)
    assert given_torque == pytest.approx(expected, abs=1e-9 * stall_torque(motor))


@given(motor=MOTORS, part=PARTS, speed=PARTS)
def test_a_bare_bridge_brakes_with_the_back_emf(motor: Motor, part: float, speed: float):
    motor = replace(motor, drive="voltage")
    wanted, omega = part * stall_torque(motor), speed * no_load_speed(motor)
    braking = motor.torque_constant**2 / motor.resistance * omega
    given_torque = motor.torque(motor.duty(wanted, omega), omega)
    assert given_torque == pytest.approx(wanted - braking, abs=1e-9 * stall_torque(motor))


@given(motor=MOTORS, torque=st.floats(0.01, 10.0), speed=st.floats(0.01, 10.0))
def test_a_gear_loses_its_part_in_both_directions_of_power(
    motor: Motor, torque: float, speed: float
):
    assert torque - motor.gear_loss(torque, speed) == pytest.approx(motor.gear_efficiency * torque)
    # Driven by its load, friction helps to hold it.
    assert torque + motor.gear_loss(torque, -speed) == pytest.approx(
        torque / motor.gear_efficiency
    )
    assert motor.gear_loss(-torque, -speed) == motor.gear_loss(torque, speed) >= 0.0


def test_the_mechanical_time_constant_is_that_of_the_run_up():
    inertia, step = 1e-5, 1e-6
    speed = 0.0
    for _ in range(round(MOTOR.time_constant(inertia) / step)):
        speed += step * MOTOR.torque(1.0, speed) / inertia
    assert speed == pytest.approx((1.0 - math.exp(-1.0)) * no_load_speed(MOTOR), rel=1e-3)


@given(pwm=PWMS, duty=st.floats(-2.0, 2.0))
def test_a_duty_is_the_nearest_step_outside_the_dead_band_and_nothing_inside(
    pwm: Pwm, duty: float
):
    held = min(max(duty, -1.0), 1.0)
    output = pwm.output(duty)
    if abs(held) < pwm.dead_band:
        assert output == 0.0
        return
    most = 2**pwm.bits - 1
    steps = output * most
    assert abs(output - held) <= 0.5 / most + 1e-12
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert pwm.output(-duty) == -output


@pytest.mark.parametrize("rate", [250.0, 1000.0, 20_000.0, 333.0])
def test_a_register_is_taken_over_as_often_as_its_rate_says(rate: float):
    pwm = Pwm(bits=8, rate=rate)
    cycles = {pwm.cycle(time_ns) for time_ns in range(0, 1_000_000_000, 10_000)}
    assert len(cycles) == rate


@pytest.mark.parametrize(
    ("make", "changes", "word"),
    [
        (Motor, {**vars(MOTOR), "torque_constant": 0.0}, "torque_constant"),
        (Motor, {**vars(MOTOR), "gear_efficiency": 1.1}, "gear_efficiency"),
        (Motor, {**vars(MOTOR), "drive": "torque"}, "one of current, voltage"),
        (Pwm, {"bits": 33}, "at most 32"),
        (Pwm, {"bits": 8, "dead_band": 1.0}, "below 1"),
        (Homing, {"speed": 0.0}, "speed must be at least 1e-06"),
        (GripperSettings, {"angle_tolerance": 1.0}, "angle_tolerance"),
        (GripCommand, {"time": -1e-9, "is_closed": True}, "time"),
        *((Encoder, {"counts": counts}, "whole number") for counts in (-1, 4096.0, True, "9")),
    ],
)
def test_impossible_settings_are_refused(make, changes, word):
    with pytest.raises(SettingError, match=word):
        make(**changes)


@given(position=FAR, other=FAR, encoder=ENCODERS)
def test_a_reading_is_the_nearest_count_and_keeps_the_order(
    position: float, other: float, encoder: Encoder
):
    read = encoder.read
    assert abs(read(position) - position) <= math.pi / encoder.counts + ROUNDING
    count = (read(position) - read(0.0)) / math.tau * encoder.counts
    assert count == pytest.approx(round(count), abs=1e-6)
    middle = Encoder(encoder.counts)
    assert middle.read(middle.read(position)) == middle.read(position)
    low, high = sorted((position, other))
    assert read(low) <= read(high)
    assert Encoder(0).read(position) == position  # an ideal sensor


def test_the_phase_moves_where_a_count_ends():
    third = math.tau / 4096 / 3.0
    assert Encoder(4096).read(third) == Encoder(4096).read(-third)
    assert Encoder(4096, 0.25).read(third) != Encoder(4096, 0.25).read(-third)


@given(homing=st.builds(Homing, st.just(1.0), POSITIONS, st.floats(0.0, 0.1)), position=POSITIONS)
def test_a_switch_is_told_apart_by_where_it_came_from_in_its_hysteresis_alone(
    homing: Homing, position: float
):
    beyond = abs(position - homing.position) - homing.hysteresis / 2.0
    if beyond < -1e-9:
        assert homing.is_on(position, was_on=True)
        assert not homing.is_on(position, was_on=False)
    elif beyond > 1e-9:
        is_on = position > homing.position
        assert homing.is_on(position, was_on=True) == homing.is_on(position, was_on=False) == is_on


@given(
    homing=st.builds(Homing, st.floats(1e-3, 5.0), POSITIONS, st.floats(0.0, 0.05)),
    start=POSITIONS,
    encoder=st.builds(Encoder, st.integers(0, 100_000), st.floats(-0.5, 0.5)),
    seed=st.integers(0, 1000),
)
def test_the_error_of_a_homing_run_stays_within_its_bound(
    homing: Homing, start: float, encoder: Encoder, seed: int
):
    error = homing.error(start, PERIOD, encoder, random.Random(seed))
    half = 0.5 * (homing.hysteresis + encoder.resolution)
    assert abs(error) <= half + homing.speed * PERIOD + 1e-9
    # Seen late: beyond the switch in the direction of the run, so read as too little of it.
    if encoder.counts == 0:
        direction = -1.0 if start > homing.position else 1.0
        assert -direction * error >= homing.hysteresis / 2.0 - 1e-9


def test_homing_errors_are_spread_over_the_way_of_one_period():
    homing, ideal = Homing(speed=1.0, position=0.5), Encoder()
    errors = [homing.error(0.0, PERIOD, ideal, random.Random(seed)) for seed in range(400)]
    assert -1e-3 <= min(errors) < -0.95e-3
    assert -0.05e-3 < max(errors) <= 0.0
    assert np.mean(errors) == pytest.approx(-0.5e-3, abs=0.05e-3)
