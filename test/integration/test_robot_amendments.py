"""What a file lays over a robot that is known better than its URDF says."""

from pathlib import Path

import numpy as np
import pytest
from harness.engines import needs_bullet
from harness.foreign_robots import EXPERIMENTS, IIWA, PANDA, pose, robot, short, slider

from hpid_ros.base.errors import ExperimentError
from hpid_ros.base.files import package_folder, share_folder
from hpid_ros.experiment.description import load_experiment
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


@needs_bullet
def test_amendments_reach_everyone_who_reads_the_robot():
    better = JointAmendment(4.54e-5, 160.0, 0.1, 0.2, 40.0, 2.3)
    joints = {"lbr_iiwa_joint_7": better, "lbr_iiwa_joint_1": JointAmendment(friction=3.0)}
    arm = amended(robot(IIWA), joints, {}, {})
    last = arm.joints["lbr_iiwa_joint_7"]
    assert (last.rotor_inertia, last.gear_ratio, last.damping) == (4.54e-5, 160.0, 0.1)
    assert (last.friction, last.effort, last.velocity) == (0.2, 40.0, 2.3)
    assert (last.lower, last.upper) == (-3.05432619099, 3.05432619099)
    first = arm.joints["lbr_iiwa_joint_1"]
    assert (first.friction, first.damping, first.effort) == (3.0, 0.5, 300.0)
    reflected = 4.54e-5 * 160.0**2
    plain, better = (
        Dynamics(each).mass_matrix(["lbr_iiwa_joint_7"], {}) for each in (robot(IIWA), arm)
    )
    assert better[0, 0] - plain[0, 0] == pytest.approx(reflected, rel=1e-12)


def test_an_amendment_of_a_transmission_that_is_there_changes_it_alone():
    own = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
    better = amended(own, {"arm_joint_2": JointAmendment(rotor_inertia=1e-3)}, {}, {})
    assert better.joints["arm_joint_2"].rotor_inertia == 1e-3
    assert better.joints["arm_joint_2"].gear_ratio == own.joints["arm_joint_2"].gear_ratio
    assert better.joints["arm_joint_1"] == own.joints["arm_joint_1"]


@pytest.mark.parametrize(
    ("name", "tip"),
    [
        pytest.param(IIWA, "lbr_iiwa_link_7", id="iiwa", marks=needs_bullet),
        pytest.param(PANDA, "panda_leftfinger", id="panda", marks=needs_bullet),
        pytest.param(None, "d", id="slider"),
    ],
)
def test_a_held_joint_stands_where_it_would_stand_if_it_moved_there(name: str | None, tip: str):
    free = robot(name) if name else RobotDescription.load(slider())
    there = pose(free, seed=3)
    held = {joint: there[joint] for joint in list(free.joints)[2::2]}
    stiff = amended(free, {}, {}, held)
    moving = tuple(joint for joint in free.joints if joint not in held)
    assert tuple(stiff.joints) == moving
    where = []
    for description in (free, stiff):
        positions = {joint: there[joint] for joint in description.joints}
        settings = WorldSettings(
            description.xml, moving, initial_positions=positions, fixed_base=True
        )
        with World(settings) as world:
            place = world.link_pose(tip)
            where.append([*place.position, *np.abs(place.orientation)])
    assert where[0] == pytest.approx(where[1], abs=1e-9)
    masses = [
        Dynamics(each).mass_matrix(moving, {joint: there[joint] for joint in each.joints})
        for each in (free, stiff)
    ]
    assert np.allclose(*masses, rtol=0.0, atol=1e-12)


@needs_bullet
def test_an_amended_robot_means_the_same_on_every_machine():
    experiment = load_experiment(EXPERIMENTS / "panda.yaml")
    text = str(experiment.world.robot_description)
    assert "package://pybullet_data/franka_panda/meshes/collision/link0.obj" in text
    assert str(package_folder("pybullet_data")) not in text
    assert "panda_finger_joint1" not in RobotDescription.load(text).joints


@needs_bullet
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"held": {"panda_finger": 0.02}}, "robot: unknown joint 'panda_finger'; did you mean"),
        ({"held": {"panda_finger_joint1": 0.3}}, r"not within its limits \[0.0, 0.04\]"),
        ({"joints": {"panda_joint1": {"gear_ratio": 0}}}, "gear_ratio must not be 0"),
        ({"joints": {"panda_joint1": {"friction": -1}}}, "friction must be at least 0, not -1"),
        ({"joints": {"panda_joint1": {"effort": 0}}}, "effort must be above 0, not 0"),
        ({"joints": {"panda_joint9": {"effort": 1}}}, "unknown joint 'panda_joint9'"),
        ({"links": {"panda_link9": {"mass": 0}}}, "unknown link 'panda_link9'"),
        ({"links": {"panda_link1": {"mass": 1}}}, "robot.links.panda_link1: inertia is missing"),
        (
            {"links": {"panda_link1": {"mass": 1, "inertia": {"ixx": 3, "iyy": 1, "izz": 1}}}},
            "no body has the principal moments 1, 1, 3",
        ),
        (
            {"links": {"panda_link1": {"mass": 0, "inertia": {"ixx": 3, "iyy": 1, "izz": 1}}}},
            "robot.links.panda_link1: inertia must be left out where mass is 0",
        ),
        ({"held": {"panda_joint1": 0.0}}, "unknown joint 'panda_joint1'"),  # it is driven
        ({"description": "package://no_such/a.urdf"}, "no ament or Python package no_such"),
    ],
)
def test_an_impossible_amendment_is_one_line(tmp_path: Path, changes: dict, says: str):
    path = short("panda", tmp_path, **changes)
    with pytest.raises(ExperimentError, match=says) as refusal:
        load_experiment(path)
    assert "\n" not in str(refusal.value)
