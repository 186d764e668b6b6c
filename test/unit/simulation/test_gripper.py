"""Bricks in the simulation: what is taken, what is missed, what is lost, and that it repeats."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from harness.places import URDF

from hpid_ros.base.errors import SettingError
from hpid_ros.robot.description import LinkPose, RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.robot.kinematics import Kinematics
from hpid_ros.simulation.mujoco import MujocoPhysics
from hpid_ros.simulation.settings import (
    Brick,
    GripCommand,
    GripperSettings,
    Support,
    Workplace,
    WorldSettings,
)
from hpid_ros.simulation.world import World

ROBOT = RobotDescription.load(URDF)
ARM = Kinematics(ROBOT, "payload")
DOWN = np.diag([-1.0, 1.0, -1.0])
HAND = (0.42, 0.0, 0.35)
AT_BRICK = ARM.solve(LinkPose(np.array(HAND), DOWN), [0.0, -0.5, 1.8, 0.0, 1.2, 0.0])
TABLE = Support("table", (0.2, 0.3, 0.31), (0.45, 0.0, 0.155))
BRICK = Brick("brick", (0.06, 0.06, 0.08), HAND, friction=0.6, mass=0.5)
HOLDING = 30.0  # [N]
GRIPPER = GripperSettings(grip_force=50.0, friction=HOLDING / 100.0)
PLACE = Workplace((BRICK,), (TABLE,), GRIPPER)
SETTINGS = WorldSettings(
    URDF,
    ARM.joints,
    fixed_base=True,
    physics_steps=1,
    initial_positions=dict(zip(ARM.joints, AT_BRICK.tolist(), strict=True)),
    workplace=PLACE,
)
STIFF = np.array([400.0, 1200.0, 600.0, 75.0, 75.0, 20.0])
DAMPED = np.array([8.0, 25.0, 12.0, 1.5, 1.5, 0.4])
WEIGHTS = Dynamics(ROBOT)


def efforts(world: World, raised: float) -> list[float]:
    """Return efforts that hold the arm, with its shoulder raised by an angle in [rad]."""
    wanted = AT_BRICK - [0.0, raised, 0.0, 0.0, 0.0, 0.0]
    here, speed = np.array(world.true_positions()), np.array(world.true_velocities())
    weights = WEIGHTS.gravity_torques(ARM.joints, dict(zip(ARM.joints, here, strict=True)))
    held = np.array([weights[joint] for joint in ARM.joints])
    return (STIFF * (wanted - here) - DAMPED * speed + held).tolist()


def lift(world: World, periods: int = 400, raised: float = 0.25) -> list[tuple[float, ...]]:
    """Raise the arm and return where joints and bricks were in every period."""
    track = []
    for period in range(periods):
        world.step(efforts(world, raised * min(1.0, period / 300.0)))
        bricks = [value for pose in world.gripper.poses() for value in (*pose[0], *pose[1])]
        track.append((*world.true_positions(), *bricks))
    return track


def outcomes(world: World) -> list[tuple[str, str]]:
    return [(event.outcome, event.brick) for event in world.gripper.events]


def workplace(brick: Brick = BRICK, **gripper: float) -> WorldSettings:
    changed = replace(PLACE, bricks=(brick,), gripper=replace(GRIPPER, **gripper))
    return replace(SETTINGS, workplace=changed)


def test_a_brick_between_the_fingers_is_taken_and_goes_where_the_hand_goes():
    with World(SETTINGS) as world:
        event = world.gripper.move(True, world.time_ns)
        assert event.outcome == "grasped"
        assert event.distance < 1e-4
        assert world.gripper.held == BRICK
        lift(world)
        (brick,), hand = world.gripper.poses(), world.link_pose("payload")
        assert brick.position[2] > HAND[2] + 0.05
        assert math.dist(brick.position, hand.position) < 2e-4
        assert world.gripper.move(True, world.time_ns) is None
        assert world.gripper.move(False, world.time_ns).outcome == "released"
        assert world.gripper.move(False, world.time_ns) is None
        lift(world, 100, raised=0.25)
        (fallen,) = world.gripper.poses()
        assert fallen.position[2] < brick.position[2] - 0.03


@pytest.mark.parametrize(
    ("brick", "reason"),
    [
        (replace(BRICK, position=(0.42, 0.02, 0.35)), r"0\.02 m away, at most 0\.015 m"),
        (replace(BRICK, yaw=math.pi / 2 - 0.2), r"turned by 0\.2 rad"),
        (replace(BRICK, size=(0.06, 0.1, 0.08)), r"0\.1 m wide, at most 0\.078 m"),
        (replace(BRICK, size=(0.1, 0.06, 0.08), yaw=math.pi / 2), r"0\.1 m wide"),
    ],
)
def test_a_brick_that_does_not_fit_is_missed_with_the_reason(brick, reason):
    with World(workplace(brick)) as world:
        event = world.gripper.move(True, 0)
        assert event.outcome == "missed"
        assert re.match(reason, event.reason)
        assert world.gripper.held is None
        lift(world, 20)
        (left,) = world.gripper.poses()
        assert left.position == pytest.approx(brick.position, abs=2e-3)


@pytest.mark.parametrize("yaw", [0.1, -math.pi / 2 + 0.1])
def test_a_box_may_be_taken_in_any_quarter_turn(yaw):
    with World(workplace(replace(BRICK, yaw=yaw))) as world:
        assert world.gripper.move(True, 0).outcome == "grasped"


def test_of_several_bricks_the_nearest_is_taken():
    far = replace(BRICK, name="far", position=(0.42, 0.09, 0.35))
    place = replace(PLACE, bricks=(far, BRICK))
    with World(replace(SETTINGS, workplace=place)) as world:
        assert world.gripper.move(True, 0).brick == "brick"


def pull_at(world, brick, force):
    """Pull at the one brick's centre in the next step, in whatever engine."""
    physics = world._physics
    if isinstance(physics, MujocoPhysics):
        (body,) = physics._built.bricks
        physics.data.xfrc_applied[body, :3] = force
        physics._is_pushed = True
        return
    import pybullet

    pybullet.applyExternalForce(
        physics._bricks[0],
        -1,
        force,
        brick.position,
        pybullet.WORLD_FRAME,
        physicsClientId=physics.client.number,
    )


def test_a_brick_is_lost_when_it_is_pulled_with_more_than_friction_holds():
    """A slowly growing force on the held brick, with its weight."""
    pull = (0.0, 1.0, 0.0)
    with World(SETTINGS) as world:
        world.gripper.move(True, 0)
        lift(world)
        force, weight = 0.0, np.array([0.0, 0.0, -BRICK.mass * 9.81])
        while world.gripper.held is not None:
            force += 0.02
            assert force < 2.0 * HOLDING, "it holds more than it should"
            (brick,) = world.gripper.poses()
            pull_at(world, brick, [force * axis for axis in pull])
            world.step(efforts(world, 0.25))
        event = world.gripper.events[-1]
        assert (event.outcome, event.brick) == ("lost", "brick")
        assert np.linalg.norm(weight + force * np.array(pull)) == pytest.approx(HOLDING, rel=0.02)
        assert event.force == pytest.approx(HOLDING, rel=0.02)
        assert "the grip holds 30 N" in event.reason


def test_a_held_brick_weighs_on_the_arm():
    """The shoulder sags as its stiffness and the brick's moment say."""
    with World(SETTINGS) as world, World(workplace(replace(BRICK, mass=1.5))) as loaded:
        for each in (world, loaded):
            each.gripper.move(True, 0)
            lift(each, 450)
        sag = loaded.true_positions()[1] - world.true_positions()[1]
        moment = (1.5 - 0.5) * 9.81 * loaded.link_pose("payload").position[0]
        friction = ROBOT.joints["arm_joint_2"].friction
        assert sag == pytest.approx(moment / STIFF[1], abs=2.0 * friction / STIFF[1])


SCHEDULE = (GripCommand(0.15, False), GripCommand(0.02, True))


def test_a_schedule_does_what_a_person_at_the_same_time_would_do():
    with World(replace(SETTINGS, workplace=replace(PLACE, grips=SCHEDULE))) as scheduled:
        by_schedule = lift(scheduled, 200)
        told = outcomes(scheduled)
    with World(SETTINGS) as world:
        by_hand = []
        for period in range(200):
            if period in (20, 150):
                world.gripper.move(period == 20, world.time_ns)
            world.step(efforts(world, 0.25 * min(1.0, period / 300.0)))
            (brick,) = world.gripper.poses()
            by_hand.append((*world.true_positions(), *brick[0], *brick[1]))
        assert outcomes(world) == told == [("grasped", "brick"), ("released", "brick")]
    assert by_schedule == by_hand


def test_a_reset_repeats_everything_to_the_last_bit():
    with World(replace(SETTINGS, workplace=replace(PLACE, grips=SCHEDULE))) as world:
        once = lift(world, 200)
        events = list(world.gripper.events)
        world.reset()
        assert world.gripper.events == []
        lift(world, 100)
        assert world.gripper.held is not None
        world.reset()
        assert lift(world, 200) == once
        assert world.gripper.events == events


@pytest.mark.parametrize("position", [(0.42, 0.0, 0.45), (0.42, 0.0, 0.32), (2.0, 0.0, 0.5)])
def test_a_brick_that_would_fall_or_be_pushed_out_is_refused(position):
    with pytest.raises(SettingError, match="brick 'brick' does not stay at"):
        World(workplace(replace(BRICK, position=position)))
