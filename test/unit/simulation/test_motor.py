"""The motor and its bridge against their own closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.drives import Motor, Pwm

MOTOR = Motor(torque_constant=0.03, resistance=0.8, supply_voltage=24.0)
MOTORS = st.builds(
    Motor,
    st.floats(1e-3, 1.0),
    st.floats(0.05, 20.0),
    st.floats(1.0, 100.0),
    gear_efficiency=st.floats(0.2, 1.0),
    drive=st.sampled_from(["current", "voltage"]),
)
PARTS = st.floats(-1.0, 1.0)
PWMS = st.builds(Pwm, st.integers(1, 16), st.floats(0.0, 0.9))


@given(motor=MOTORS, part=PARTS, speed=PARTS)
def test_full_voltage_is_the_torque_speed_line(motor: Motor, part: float, speed: float):
    omega = speed * motor.no_load_speed
    line = motor.stall_torque * (1.0 - speed)
    assert motor.torque(1.0, omega) == pytest.approx(line, abs=1e-12 * motor.stall_torque)
    assert motor.torque(1.0, motor.no_load_speed) == pytest.approx(
        0.0, abs=1e-12 * motor.stall_torque
    )
    assert motor.torque(1.0, 0.0) == pytest.approx(motor.stall_torque)


@given(motor=MOTORS, part=PARTS, speed=st.floats(-2.0, 2.0))
def test_a_current_loop_gives_the_torque_asked_for_as_far_as_the_line_reaches(
    motor: Motor, part: float, speed: float
):
    motor = replace(motor, drive="current")
    wanted, omega = part * motor.stall_torque, speed * motor.no_load_speed
    given_torque = motor.torque(motor.duty(wanted, omega), omega)
    low, high = (motor.stall_torque * (end - speed) for end in (-1.0, 1.0))
    expected = min(max(wanted, low), high)
    assert given_torque == pytest.approx(expected, abs=1e-9 * motor.stall_torque)


@given(motor=MOTORS, part=PARTS, speed=PARTS)
def test_a_bare_bridge_brakes_with_the_back_emf(motor: Motor, part: float, speed: float):
    motor = replace(motor, drive="voltage")
    wanted, omega = part * motor.stall_torque, speed * motor.no_load_speed
    braking = motor.torque_constant**2 / motor.resistance * omega
    given_torque = motor.torque(motor.duty(wanted, omega), omega)
    assert given_torque == pytest.approx(wanted - braking, abs=1e-9 * motor.stall_torque)


@given(motor=MOTORS, part=PARTS, speed=PARTS)
def test_electrical_power_is_mechanical_power_and_heat(motor: Motor, part: float, speed: float):
    omega = speed * motor.no_load_speed
    torque = motor.torque(part, omega)
    current = torque / motor.torque_constant
    scale = motor.stall_torque * motor.no_load_speed
    assert part * motor.supply_voltage * current == pytest.approx(
        torque * omega + motor.resistance * current**2, abs=1e-9 * scale
    )


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
    assert speed == pytest.approx((1.0 - math.exp(-1.0)) * MOTOR.no_load_speed, rel=1e-3)


@given(pwm=PWMS, duty=st.floats(-2.0, 2.0))
def test_a_duty_is_the_nearest_step_outside_the_dead_band_and_nothing_inside(
    pwm: Pwm, duty: float
):
    held = min(max(duty, -1.0), 1.0)
    output = pwm.output(duty)
    if abs(held) < pwm.dead_band:
        assert output == 0.0
        return
    assert abs(output - held) <= pwm.resolution / 2.0 + 1e-12
    steps = output / pwm.resolution
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert pwm.output(-duty) == -output


def test_a_bridge_of_n_bits_has_both_ends_and_all_steps_between():
    pwm = Pwm(bits=3)
    outputs = {pwm.output(duty / 1000.0) for duty in range(-1000, 1001)}
    assert sorted(outputs) == pytest.approx([step / 7.0 for step in range(-7, 8)])


@pytest.mark.parametrize("rate", [250.0, 1000.0, 20_000.0, 333.0])
def test_a_register_is_taken_over_as_often_as_its_rate_says(rate: float):
    pwm = Pwm(bits=8, rate=rate)
    cycles = {pwm.cycle(microsecond * 1000) for microsecond in range(1_000_000)}
    assert len(cycles) == rate


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"torque_constant": 0.0}, "torque_constant must be .*, not 0.0"),
        ({"resistance": -1.0}, "resistance must be .*, not -1.0"),
        ({"supply_voltage": math.nan}, "supply_voltage must be .*, not nan"),
        ({"viscous_friction": -1e-9}, "viscous_friction must be at least 0, not -1e-09"),
        ({"coulomb_friction": math.inf}, "coulomb_friction must be .*, not inf"),
        ({"gear_efficiency": 0.0}, "gear_efficiency must be above 0 and at most 1, not 0.0"),
        ({"gear_efficiency": 1.1}, "gear_efficiency must be .*, not 1.1"),
        ({"drive": "torque"}, "unknown drive 'torque'; known: current, voltage"),
    ],
)
def test_impossible_motors_are_refused(changes: dict[str, object], says: str):
    with pytest.raises(SettingError, match=says):
        replace(MOTOR, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ((0,), "bits must be a whole number, at least 1 and at most 32, not 0"),
        ((8.0,), "bits must be a whole number"),
        ((33,), "at most 32, not 33"),
        ((8, 1.0), "dead_band must be at least 0 and below 1, not 1.0"),
        ((8, 0.0, -1.0), "rate must be at least 0"),
        ((8, 0.0, math.nan), "rate must be .* not nan"),
    ],
)
def test_impossible_bridges_are_refused(values: tuple[object, ...], says: str):
    with pytest.raises(SettingError, match=says):
        Pwm(*values)  # type: ignore[arg-type]
