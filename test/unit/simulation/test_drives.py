"""Drives, motors and bridges, alone and in the simulated robot, against what mechanics says."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from harness.places import URDF

from hpid_ros.base.errors import SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.drives import Drive, DriveSettings, Motor, Pwm
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

pytestmark = pytest.mark.slow

WHEEL = "wheel_left_joint"
PERIOD = 1e-3  # [s]
MOTOR = Motor(torque_constant=0.05, resistance=1.0, supply_voltage=24.0)

DESCRIPTION = RobotDescription.load(URDF)
JOINT = DESCRIPTION.joints[WHEEL]
INERTIA = Dynamics(DESCRIPTION).joint_inertias((WHEEL, "wheel_right_joint"), {})[WHEEL]


PENDULUM = """<robot name="pendulum" xmlns:drake="http://drake.mit.edu">
  <link name="post"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="bob"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
    <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous">
    <parent link="post"/><child link="bob"/><axis xyz="0 1 0"/></joint>
  <transmission name="gear"><joint name="hinge"/><actuator name="motor">
    <drake:rotor_inertia value="1e-5"/><drake:gear_ratio value="100"/></actuator></transmission>
</robot>"""


def on_stand(*drives: DriveSettings, joint: str = WHEEL, **changes: object) -> WorldSettings:
    """Return one joint of the robot on a stand."""
    return WorldSettings(URDF, (joint,), fixed_base=True, drives=drives, **changes)  # type: ignore[arg-type]


def spin(settings: WorldSettings, effort: float, periods: int) -> tuple[list[float], float]:
    """Return the speed after every period, and the torque of the last one."""
    with World(settings) as world:
        speeds = [0.0]
        for _ in range(periods):
            world.step([effort])
            speeds.append(world.true_velocities()[0])
        return speeds, world.applied_efforts()[0]


def test_a_motor_of_any_strength_gives_what_an_ideal_one_gives_below_its_line():
    strong = replace(MOTOR, supply_voltage=1e4)
    ideal, _ = spin(on_stand(), 1.0, 200)
    driven, torque = spin(on_stand(DriveSettings(strong)), 1.0, 200)
    assert driven == pytest.approx(ideal, rel=1e-9)
    assert torque == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("drive", ["current", "voltage"])
def test_a_loaded_motor_runs_up_to_where_its_line_meets_the_friction(drive: str):
    """On a bare bridge with the time constant of the whole inertia: the rotor weighs once."""
    motor = replace(MOTOR, drive=drive)
    ratio, k, r = JOINT.gear_ratio, motor.torque_constant, motor.resistance
    voltage = min(24.0, r * 4.0 / (k * ratio)) if drive == "voltage" else 24.0
    # N k (V - k N w) / R = friction + damping w
    slope = (k * ratio) ** 2 / r
    speed = (ratio * k * voltage / r - JOINT.friction) / (slope + JOINT.damping)
    speeds, torque = spin(on_stand(DriveSettings(motor), physics_steps=10), 4.0, 150)
    assert speeds[-1] == pytest.approx(speed, rel=1e-6)
    assert torque == pytest.approx(JOINT.friction + JOINT.damping * speed, rel=1e-5)
    if drive == "voltage":
        reached = np.interp((1.0 - math.exp(-1.0)) * speed, speeds, np.arange(151) * PERIOD)
        assert reached == pytest.approx(INERTIA / (slope + JOINT.damping), rel=0.02)


def test_friction_of_the_motor_counts_at_the_joint_by_the_gear():
    """Viscous by its square, Coulomb by itself; both brake as their closed form says."""
    motor = replace(
        MOTOR, viscous_friction=8e-6, coulomb_friction=2e-3, torque_constant=1e-6, drive="current"
    )
    with World(on_stand(DriveSettings(motor))) as world:
        damping = JOINT.damping + 8e-6 * JOINT.gear_ratio**2
        friction = JOINT.friction + 2e-3 * JOINT.gear_ratio
        world.apply_wrench("wheel_left_link", (0.0, 0.0, 0.0), (0.0, 4.0, 0.0), 30_000_000)
        for _ in range(30):
            world.step([0.0])
        speeds, start = [world.true_velocities()[0]], world.true_positions()[0]
        for _ in range(450):
            world.step([0.0])
            speeds.append(world.true_velocities()[0])
        travel = abs(world.true_positions()[0] - start)
    speeds = np.abs(speeds)
    work = friction * travel + damping * np.sum(speeds[1:] ** 2) * PERIOD
    assert work == pytest.approx(0.5 * INERTIA * speeds[0] ** 2, rel=0.02)
    stop = math.log1p(damping * speeds[0] / friction) * INERTIA / damping
    assert speeds[0] > 1.0
    assert sum(speeds > 1e-6) * PERIOD == pytest.approx(stop, rel=0.03)
    assert max(speeds[-50:]) < 1e-6
    assert all(late <= early + 1e-9 for early, late in pairwise(speeds))


def test_a_motor_holds_below_breakaway_without_a_limit_cycle():
    motor = replace(MOTOR, coulomb_friction=4e-3, gear_efficiency=0.7)
    breakaway = (JOINT.friction + 4e-3 * JOINT.gear_ratio) / 0.7
    moved = {}
    for part in (0.97, 1.03):
        speeds, _ = spin(on_stand(DriveSettings(motor)), part * breakaway, 500)
        moved[part] = max(map(abs, speeds))
    assert moved[0.97] < 1e-6
    assert moved[1.03] > 0.01


def test_a_gear_takes_its_part_of_the_torque_that_drives():
    lossy = DriveSettings(replace(MOTOR, gear_efficiency=0.8))
    ideal, _ = spin(on_stand(DriveSettings(MOTOR)), 0.8 * 2.0, 20)
    driven, torque = spin(on_stand(lossy), 2.0, 20)
    assert driven[-1] == pytest.approx(ideal[-1], rel=1e-3)
    assert torque == pytest.approx(2.0, rel=1e-9)  # what a current sensor would tell


def test_a_gear_helps_to_hold_a_load_that_drives_it():
    """The arm's weight L is held by motor torques from L eta to L / eta, friction aside."""
    motor = replace(MOTOR, gear_efficiency=0.6)
    load = 1.0 * 9.81 * 0.5

    def travel(torque: float) -> float:
        settings = WorldSettings(
            PENDULUM, ("hinge",), fixed_base=True, drives=(DriveSettings(motor),)
        )
        with World(settings) as world:
            for _ in range(300):
                world.step([-torque])  # the weight turns it forward
            return -world.true_positions()[0]

    assert travel(0.55 * load) < -1e-3  # sinks
    assert abs(travel(0.65 * load)) < 2e-4
    assert abs(travel(1.5 * load)) < 2e-4
    assert travel(1.8 * load) > 1e-3  # rises


def test_an_effort_acts_as_many_periods_late_as_was_said():
    efforts = [1.0, -2.0, 3.0, 0.5, 0.0, 4.0]
    for delay in (1, 2):
        with World(on_stand(DriveSettings(delay=delay))) as late, World(on_stand()) as prompt:
            for _ in range(delay):
                prompt.step([0.0])
            for effort in efforts:
                prompt.step([effort])
            for effort in [*efforts, *[0.0] * delay]:
                late.step([effort])
                if late.time_ns == 2_000_000 and delay == 1:
                    assert late.applied_efforts() == (1.0,)
            assert late.true_velocities() == prompt.true_velocities()


def test_a_bridge_without_a_motor_gives_steps_of_the_joints_limit():
    with World(on_stand(DriveSettings(pwm=Pwm(bits=4, dead_band=0.1)))) as world:
        step = JOINT.effort / 15.0
        world.step([0.09 * JOINT.effort])
        assert world.applied_efforts() == (0.0,)
        world.step([-0.33 * JOINT.effort])
        assert world.applied_efforts() == pytest.approx((-5 * step,))
        world.step([100.0])
        assert world.applied_efforts() == pytest.approx((JOINT.effort,))


def test_between_two_cycles_of_the_bridge_the_voltage_stands():
    settings = DriveSettings(pwm=Pwm(bits=16, rate=250.0))
    drive = Drive(settings, JOINT, 1e-3)
    given = []
    for period in range(8):
        drive.command(0.5 * (period + 1))
        given.append(drive.torque(period * 1_000_000, 0.0))
    assert given == pytest.approx([0.5] * 4 + [2.5] * 4, abs=JOINT.effort / 2**16)


def test_at_standstill_the_bridge_and_the_motor_err_by_half_a_step():
    pwm = Pwm(bits=8)
    drive = Drive(DriveSettings(MOTOR, pwm), JOINT, 1e-3)
    stall = JOINT.gear_ratio * MOTOR.torque(1.0, 0.0)
    for period, effort in enumerate(np.linspace(-6.0, 6.0, 101)):
        drive.command(float(effort))
        assert abs(drive.torque(period, 0.0) - effort) <= stall * 0.5 / (2**pwm.bits - 1) + 1e-9


@pytest.mark.parametrize(("periods", "delay"), [(0, 2), (1, 0), (37, 2)])
def test_a_reset_drive_is_a_fresh_one(periods: int, delay: int):
    everything = DriveSettings(
        replace(MOTOR, gear_efficiency=0.8, coulomb_friction=1e-3), Pwm(8, 0.02, 333.0), delay
    )

    def run(world: World) -> list[tuple[float, ...]]:
        readings = []
        for period in range(120):
            world.step([3.0 * math.sin(0.1 * period + 1.0)])
            readings.append(world.true_positions() + world.applied_efforts())
        return readings

    with World(on_stand(everything)) as fresh, World(on_stand(everything)) as used:
        for _ in range(periods):
            used.step([5.0])
        used.reset()
        assert run(used) == run(fresh)


def test_drives_that_do_not_fit_are_one_clear_line():
    with pytest.raises(SettingError, match="2 entries for 1 joints"):
        on_stand(DriveSettings(), DriveSettings())
    with pytest.raises(SettingError, match=r"delay must be .* not -1"):
        DriveSettings(delay=-1)
    fast = DriveSettings(replace(MOTOR, torque_constant=1.0))
    with pytest.raises(SettingError, match="'wheel_left_joint' has a mechanical time constant"):
        World(on_stand(fast))
    unlimited = replace(JOINT, effort=math.inf)
    with pytest.raises(SettingError, match="needs a motor or an effort limit"):
        Drive(DriveSettings(pwm=Pwm(8)), unlimited, 1e-3)
