"""MuJoCo's model of a robot, against Pinocchio and against what it stands for."""

import hashlib
import math
import platform
from dataclasses import replace
from importlib.metadata import version

import mujoco
import numpy as np
import pytest
from harness.engines import needs_bullet
from harness.worlds import JOINTS, URDF, bits_of_a_motion

from hpid_ros.base.errors import RobotDescriptionError, RunError
from hpid_ros.base.resources import find_resource
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.robot.kinematics import Kinematics
from hpid_ros.simulation.mujoco import build_mujoco_model
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

ROBOT = RobotDescription.load(URDF)
SETTINGS = WorldSettings(URDF, JOINTS, engine="mujoco")
OTHERS = ("pybullet_data/kuka_iiwa/model.urdf", "pybullet_data/franka_panda/panda.urdf")
BITS = "2a41e5a3bef9e6ab4f635c2cf661ff7660fd340381d622add5fc5fdc63d3add1"
"""Of mujoco 3.17.0, x86-64 with FMA."""
ROBOTS = (str(URDF), *(pytest.param(each, marks=needs_bullet) for each in OTHERS))


def pose(description, seed):
    generator = np.random.default_rng(seed)
    return {
        name: float(generator.uniform(max(joint.lower, -2.0), min(joint.upper, 2.0)))
        for name, joint in description.joints.items()
    }


def built(description):
    settings = WorldSettings(description.xml, tuple(description.joints), fixed_base=True)
    found = build_mujoco_model(settings, description)
    return found, mujoco.MjData(found.model)


@pytest.mark.parametrize("source", ROBOTS)
def test_mass_matrix_gravity_and_frames_are_pinocchios(source):
    description = RobotDescription.load(find_resource(source))
    found, data = built(description)
    model, joints = found.model, list(description.joints)
    rows = [found.velocities[joint] for joint in joints]
    dynamics = Dynamics(description)
    for seed in range(5):
        there = pose(description, seed)
        for joint, position in there.items():
            data.qpos[found.positions[joint]] = position
        mujoco.mj_forward(model, data)
        mass = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        mass = mass[np.ix_(rows, rows)]
        assert np.allclose(mass, dynamics.mass_matrix(joints, there), rtol=0.0, atol=1e-9)
        gravity = dynamics.gravity_torques(joints, there)
        expected = [gravity[joint] for joint in joints]
        assert np.allclose(data.qfrc_bias[rows], expected, rtol=0.0, atol=1e-8)
        tip = description.last_link
        chain = Kinematics(description, tip, None, there)
        expected = chain.pose([there[joint] for joint in chain.joints]).position
        assert np.allclose(data.xpos[found.links[tip]], expected, rtol=0.0, atol=1e-12)


def test_a_payload_weighs_in_the_model_what_it_weighs_in_the_engine():
    """Its moments count, too: most of what turns about the hand's own axis."""
    with World(replace(SETTINGS, fixed_base=True, payload_mass=2.0)) as world:
        model, data = world._physics.model, world._physics.data
        mujoco.mj_forward(model, data)
        mass = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        rows = world._physics._velocities
        expected = Dynamics(ROBOT, payload_mass=2.0).mass_matrix(JOINTS, {})
        assert np.allclose(mass[np.ix_(rows, rows)], expected, rtol=0.0, atol=1e-9)


WORLD = """<robot name="arm"><link name="world"/><link name="upper"><inertial><mass value="1"/>
<origin xyz="0 0 -0.5"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="world"/><child link="upper"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="10" velocity="3"/></joint>
<link name="tool"><inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0"/></inertial></link>
<joint name="flange" type="fixed"><parent link="upper"/><child link="tool"/></joint></robot>"""
BOX = '<collision><geometry><box size="{}"/></geometry></collision>'


def test_a_link_may_be_called_world_and_a_mere_frame_may_say_so_with_zeros():
    """As the URDF of the UR5 has both; MuJoCo has a body ``world`` itself, and none of no mass."""
    description = RobotDescription.load(WORLD)
    found, data = built(description)
    data.qpos[found.positions["shoulder"]] = math.pi / 2.0
    mujoco.mj_forward(found.model, data)
    assert data.qfrc_bias[found.velocities["shoulder"]] == pytest.approx(0.5 * 9.81, abs=0.01)
    assert found.links["world"] != 0 != found.links["upper"]


def test_the_robot_sinks_into_its_tyres_by_its_weight_over_their_stiffness():
    stiffness = 2.0 * 1e5 + 4.0 * 5e4  # of wheels and balls, in [N/m]
    for payload in (0.0, 2.0):
        with World(replace(SETTINGS, payload_mass=payload)) as world:
            mass = sum(world._physics.model.body_mass[list(world._physics._built.links.values())])
            height = world.base_pose().position[2]
        assert height == pytest.approx(-mass * 9.81 / stiffness, rel=1e-3)


def test_a_robot_without_friction_at_its_balls_slides_on_them():
    """Their contacts have no friction at all, although the ground has."""
    model = build_mujoco_model(replace(SETTINGS, fixed_base=False), ROBOT).model
    names = [model.pair(index).name for index in range(model.npair)]
    balls = [index for index, name in enumerate(names) if name.startswith("ball_")]
    assert len(balls) == 4
    assert set(model.pair_dim[balls]) == {1}
    wheels = [index for index, name in enumerate(names) if name.startswith("wheel_")]
    assert np.allclose(model.pair_friction[wheels][:, :2], 0.9)


@needs_bullet
def test_both_engines_make_the_same_motion():
    """A swing of the arm on the standing base, whose contacts both engines solve in their way."""
    ends = {}
    for engine in ("pybullet", "mujoco"):
        with World(replace(SETTINGS, engine=engine, physics_steps=4)) as world:
            for period in range(200):
                world.step([0.0, 0.0, 2.0, 6.0 * math.sin(0.01 * period), 2.0, 0.3, 0.2, 0.1])
            ends[engine] = np.array(world.true_positions())
    travel = np.abs(ends["pybullet"])
    assert travel[2:6].min() > 0.05
    assert np.abs(ends["pybullet"] - ends["mujoco"])[2:].max() < 0.01 * travel.max()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="other machines round otherwise")
def test_it_still_gives_the_bits_of_the_docs():
    """If another version does not, measure the tables of docs/models.md anew."""
    bits = " ".join(bits_of_a_motion("mujoco")).encode()
    assert hashlib.sha256(bits).hexdigest() == BITS, f"mujoco {version('mujoco')}"


def test_a_shape_that_it_does_not_know_is_one_clear_line():
    odd = ROBOT.xml.replace('<sphere radius="0.03"/>', '<torus radius="0.03"/>')
    with pytest.raises(RobotDescriptionError, match="has a collision shape 'torus'"):
        World(replace(SETTINGS, robot_description=odd))


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        ('ixx="0.1"', 'ixx="0.1k"', "upper.*no tensor"),
        ('"0 0 -0.5"', '"0 -0.5"', "incompatible function arguments"),
        ('name="tool">', 'name="tool"><contact><stiffness value="k"/></contact>', "'k'"),
        ('<link name="tool">', f'<link name="tool">{BOX.format("1 1")}', "incompatible"),
        ('<link name="tool">', f'<link name="tool">{BOX.format("x")}', "'x'"),
    ],
)
def test_a_malformed_number_is_one_clear_line(right, wrong, says):
    robot = WORLD.replace(right, wrong, 1)
    with pytest.raises(RobotDescriptionError, match=says):
        World(WorldSettings(robot, ("shoulder",), engine="mujoco"))


def test_an_unstable_simulation_ends_with_a_line_and_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with World(SETTINGS) as world:
        world.apply_wrench(ROBOT.last_link, (0.0, 0.0, 1e30), (0.0, 0.0, 0.0), 1_000_000)
        with pytest.raises(RunError, match="MuJoCo: Nan, Inf or huge value"):
            world.step([0.0] * len(JOINTS))
        world.reset()
        world.step([0.0] * len(JOINTS))
        assert world.time_ns == world.settings.control_period_ns
    assert not list(tmp_path.iterdir())
