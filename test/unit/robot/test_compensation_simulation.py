"""Compensated loops on the simulated robot: gravity is held, and joints do not feel each other."""

import re

import numpy as np
import pytest
from harness.worlds import HOME, JOINTS, URDF

from hpid_ros.base.errors import SettingError
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.robot.compensation import (
    Compensator,
    DecouplingShare,
    RobotDynamics,
    RobotStates,
    compensators,
)
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import JointSpace
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

pytestmark = pytest.mark.slow

ROBOT = URDF.read_text()
SMOOTH = re.sub(r'friction="[0-9.]+"', 'friction="0"', ROBOT)  # no Coulomb friction
UNIT = {"gains.p": 300.0, "gains.i": 1000.0, "gains.d": 30.0}  # three poles at -10 rad/s
ROLLING = {"model.left_wheel": "wheel_left_joint", "model.right_wheel": "wheel_right_joint"}


def settings(joint, **values):
    filtered = {"velocity_source": "filtered", "velocity_filter_time_constant": 0.0}
    return LoopSettings.from_parameters({"joint": joint, "law": "pid", **filtered, **values})


def run(robot, loops, steps, seconds, fixed_base=True, start=HOME, models=None):
    """Return how far all joints are from their start, in [rad], shape (samples, joints)."""
    world_settings = WorldSettings(
        robot_description=robot,
        joints=JOINTS,
        initial_positions=start,
        fixed_base=fixed_base,
        physics_steps=8,
    )
    started = [JointLoop(each) for each in loops]
    for loop in started:
        joint = loop.settings.joint
        loop.follow(Setpoint(start.get(joint, 0.0) + steps.get(joint, 0.0)))
    with World(world_settings) as world:
        models = models or compensators(loops, robot)
        recording = record_run(world, started, round(1000 * seconds), models)
    return recording.positions - np.array([start.get(joint, 0.0) for joint in JOINTS])


def step_of_a_unit_double_integrator(size, seconds, **values):
    loop = JointLoop(settings("unit", **UNIT, inertia=1.0, **values))
    loop.follow(Setpoint(size))
    position = velocity = 0.0
    positions = []
    for k in range(round(1000 * seconds) + 1):
        positions.append(position)
        acceleration = loop.step(k * 1_000_000, position)
        position += 1e-3 * velocity + 0.5e-6 * acceleration
        velocity += 1e-3 * acceleration
    return np.array(positions)


def test_every_decoupled_arm_joint_steps_like_a_unit_double_integrator_on_the_rolling_base():
    """With filtered velocities, and wheels that spin the robot: 3 mrad of 0.2 rad."""
    values = {**UNIT, **ROLLING, "velocity_filter_time_constant": 0.005}
    loops = [settings(joint, **values, compensation="decoupling") for joint in JOINTS]
    found = run(SMOOTH, loops, dict.fromkeys(JOINTS, 0.2), 0.3, fixed_base=False)
    expected = step_of_a_unit_double_integrator(0.2, 0.3, velocity_filter_time_constant=0.005)
    assert np.max(np.abs(found - expected[:, None])[:, 2:]) < 3e-3


def test_gravity_compensation_alone_holds_the_arm():
    """Without any gain and without friction it drifts by less than 1 mrad in 0.6 s."""
    held = run(SMOOTH, [settings(joint, compensation="gravity") for joint in JOINTS], {}, 0.6)
    assert np.max(np.abs(held)) < 1e-3
    falling = run(SMOOTH, [settings(joint) for joint in JOINTS], {}, 0.5)
    assert np.max(np.abs(falling)) > 0.3


# Without rotors' inertia the arm's joints feel each other so much that their last efforts would
# drive each other up, in this pose: the largest eigenvalue of D^-1 B is 2.6.
DIRECT_DRIVE = re.sub(r'rotor_inertia value="[^"]*"', 'rotor_inertia value="0"', SMOOTH)
COUPLED = dict(zip(JOINTS[2:], (-1.32, -1.38, -0.34, 0.75, -0.41, 2.38), strict=True))


def direct_drive(time_constant):
    values = {**UNIT, "model.effort_filter_time_constant": time_constant}
    return [settings(joint, **values, compensation="decoupling") for joint in JOINTS]


def unfiltered_models(loops):
    """Return what is refused: the models of strongly coupled joints, without a filter."""
    space = JointSpace(RobotDescription.load(DIRECT_DRIVE))
    states = RobotStates(loops[0], space.joints, True)
    dynamics = RobotDynamics(space)
    return [Compensator(DecouplingShare(dynamics, each.joint), states) for each in loops]


def test_strongly_coupled_joints_are_refused_without_a_filter_and_settle_with_one():
    with pytest.raises(SettingError, match=r"would not settle.*by a factor of up to 1"):
        compensators(direct_drive(0.0), DIRECT_DRIVE)
    with pytest.raises(SettingError, match=r"must exceed 0\.00033"):
        compensators(direct_drive(0.0003), DIRECT_DRIVE)
    steps = dict.fromkeys(JOINTS, 0.05)
    expected = step_of_a_unit_double_integrator(0.05, 1.0)[:, None]
    chosen = direct_drive(-1.0)
    settled = run(DIRECT_DRIVE, chosen, steps, 1.0, start=COUPLED)
    assert np.max(np.abs(settled - expected)[-1]) < 1e-3
    assert np.max(np.abs(settled)) < 0.2
    models = unfiltered_models(chosen)
    diverged = run(DIRECT_DRIVE, chosen, steps, 0.5, start=COUPLED, models=models)
    assert np.max(np.abs(diverged)) > 0.4
