"""Inertias, gravity, and the efforts that links and rotors need."""

import math
import re

import numpy as np
import pytest
from harness.places import URDF

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import (
    MOST_COMPUTED,
    Dynamics,
    InverseDynamics,
    build_model,
    data_of,
)

MASS, LENGTH, ROTOR_INERTIA, GEAR_RATIO = 0.7, 0.4, 3e-6, 80.0


def pendulum() -> RobotDescription:
    """Return two point-like masses on rods, about y, hanging up along z; the first is geared."""

    def link(name: str, mass: float, height: float) -> str:
        return f"""<link name="{name}"><inertial><origin xyz="0 0 {height}"/>
            <mass value="{mass}"/>
            <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/>
            </inertial></link>"""

    def joint(name: str, parent: str, child: str, height: float) -> str:
        return f"""<joint name="{name}" type="continuous"><parent link="{parent}"/>
            <child link="{child}"/><origin xyz="0 0 {height}"/><axis xyz="0 1 0"/></joint>"""

    return RobotDescription.load(
        '<robot name="p" xmlns:drake="http://drake.mit.edu">'
        + link("base", 1.0, 0.0)
        + link("one", MASS, LENGTH)
        + link("two", MASS, LENGTH)
        + joint("a", "base", "one", 0.0)
        + joint("b", "one", "two", LENGTH)
        + f"""<transmission name="t"><joint name="a"/><actuator name="m">
            <drake:rotor_inertia value="{ROTOR_INERTIA}"/>
            <drake:gear_ratio value="{GEAR_RATIO}"/></actuator></transmission></robot>"""
    )


@pytest.mark.parametrize("bend", [0.0, 0.6, 2.0])
def test_effective_inertia_is_that_of_the_double_pendulum(bend: float):
    unit = MASS * LENGTH**2
    reflected = ROTOR_INERTIA * GEAR_RATIO**2
    m11 = unit * (3.0 + 2.0 * math.cos(bend)) + reflected
    m12, m22 = unit * (1.0 + math.cos(bend)), unit
    found = Dynamics(pendulum()).joint_inertias(["a", "b"], {"a": 0.3, "b": bend})
    assert found["a"] == pytest.approx(m11 - m12**2 / m22, rel=1e-6)
    assert found["b"] == pytest.approx(m22 - m12**2 / m11, rel=1e-6)


def test_gravity_torque_is_that_of_the_double_pendulum():
    torques = Dynamics(pendulum()).gravity_torques(["b", "a"], {"a": 0.5, "b": 0.4})
    weight = MASS * 9.81 * LENGTH
    assert list(torques) == ["b", "a"]
    assert torques["b"] == pytest.approx(-weight * math.sin(0.9))
    assert torques["a"] == pytest.approx(-weight * (2.0 * math.sin(0.5) + math.sin(0.9)))


def test_a_free_base_yields_and_lightens_what_a_motor_feels():
    description = RobotDescription.load(URDF)
    fixed = Dynamics(description).joint_inertias(description.joints, {"arm_joint_3": 1.0})
    free = Dynamics(description, fixed_base=False).joint_inertias(
        description.joints, {"arm_joint_3": 1.0}
    )
    assert all(free[name] <= fixed[name] for name in fixed)
    assert free["arm_joint_2"] < 0.9 * fixed["arm_joint_2"]


def test_the_range_holds_the_nominal_pose_and_is_the_same_for_the_same_seed():
    dynamics = Dynamics(RobotDescription.load(URDF))
    names = ["arm_joint_2", "wheel_left_joint"]
    nominal = {"arm_joint_3": 1.8}
    first = dynamics.inertia_range(names, samples=40, seed=3, nominal=nominal)
    assert first == dynamics.inertia_range(names, samples=40, seed=3, nominal=nominal)
    assert first != dynamics.inertia_range(names, samples=40, seed=4, nominal=nominal)
    shoulder = first["arm_joint_2"]
    assert shoulder.minimum < shoulder.nominal < shoulder.maximum
    assert shoulder.nominal == dynamics.joint_inertias(names, nominal)["arm_joint_2"]
    wheel = first["wheel_left_joint"]
    assert wheel.minimum == pytest.approx(wheel.maximum)


def test_bad_requests_are_named():
    dynamics = Dynamics(RobotDescription.load(URDF))
    with pytest.raises(RobotDescriptionError, match="did you mean 'arm_joint_3'"):
        dynamics.joint_inertias(["arm_jont_3"], {})
    with pytest.raises(RobotDescriptionError, match="unknown joint 'elbow'"):
        dynamics.joint_inertias(["arm_joint_3"], {"elbow": 1.0})
    with pytest.raises(SettingError, match="not finite"):
        dynamics.joint_inertias(["arm_joint_3"], {"arm_joint_3": math.nan})
    with pytest.raises(SettingError, match="samples 0"):
        dynamics.inertia_range(["arm_joint_3"], samples=0, seed=0)


def test_a_robot_that_pinocchio_cannot_build_is_one_clear_line():
    misplaced = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute">
        <parent link="a"/><child link="b"/><origin xyz="0 zero 0"/></joint></robot>"""
    with pytest.raises(RobotDescriptionError, match="Pinocchio") as caught:
        Dynamics(RobotDescription.load(misplaced))
    assert "\n" not in str(caught.value)


def test_joints_without_limits_have_the_dynamics_of_those_with():
    """Pinocchio's parser refuses them; a limit is nothing that the dynamics know."""
    text = URDF.read_text()
    bare = re.sub(r'(<limit[^>]*?) effort="[^"]*"', r"\1", text)
    bare = re.sub(r'(<limit[^>]*?) velocity="[^"]*"', r"\1", bare)
    assert bare.count("effort=") < text.count("effort=")
    whole, without = (RobotDescription.load(each) for each in (text, bare))
    assert math.isinf(without.joints["arm_joint_3"].effort)
    pose = {"arm_joint_2": 0.4, "arm_joint_3": -0.7}
    names = list(whole.joints)
    assert Dynamics(without).joint_inertias(names, pose) == Dynamics(whole).joint_inertias(
        names, pose
    )


RATIO = 50.0
JOINTS = ("a", "b", "c")
AXES = ("0 0 1", "0 1 0", "0.6 0 0.8")
REFLECTED = np.array([0.5, 0.3, 0.2])  # [kg m^2]


def arm(has_rotor_bodies, ratio=RATIO):
    """Return three joints; their rotors are bodies of their own or only known by their gears."""
    links = ['<link name="l0"/>']
    for k, name in enumerate(JOINTS):
        rotor = REFLECTED[k] / RATIO**2
        origin = f'<origin xyz="0.1 0 0.3" rpy="0.3 {0.2 * k} 0"/>'
        links.append(
            f'<link name="l{k + 1}"><inertial><origin xyz="0.1 0.02 0.1"/><mass value="1"/>'
            '<inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{name}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'{origin}<axis xyz="{AXES[k]}"/><limit lower="-3" upper="3" effort="9" velocity="9"/>'
            "</joint>"
            f'<transmission name="t{k}"><joint name="{name}"/><actuator name="m{k}">'
            f'<drake:gear_ratio value="{ratio}"/><drake:rotor_inertia value="0"/></actuator>'
            "</transmission>"
        )
        if has_rotor_bodies:
            i = " ".join(f'i{e}{e}="{rotor}"' for e in "xyz")  # a ball, whatever its axis
            links.append(
                f'<link name="r{k}"><inertial><mass value="1e-9"/>'
                f'<inertia {i} ixy="0" ixz="0" iyz="0"/></inertial></link>'
                f'<joint name="rotor_{name}" type="continuous"><parent link="l{k}"/>'
                f'<child link="r{k}"/>{origin}<axis xyz="{AXES[k]}"/></joint>'
            )
    text = "".join(links)
    return f'<robot name="arm" xmlns:drake="http://drake.mit.edu">{text}</robot>'


@pytest.mark.parametrize("ratio", [RATIO, -RATIO])
def test_rotors_that_spin_need_what_bodies_of_their_own_would(ratio):
    draw = np.random.default_rng(1).standard_normal
    motion = draw((3, len(JOINTS), 20))
    body = InverseDynamics(RobotDescription.load(arm(False, ratio)), JOINTS)
    found = body.spin(*motion, REFLECTED)
    rotors = [f"rotor_{name}" for name in JOINTS]
    whole = InverseDynamics(RobotDescription.load(arm(True)), [*JOINTS, *rotors])
    efforts = whole.efforts(*np.concatenate([motion, ratio * motion], axis=1))
    bodies = efforts[:3] + ratio * efforts[3:]
    expected = bodies - body.efforts(*motion) - REFLECTED[:, None] * motion[2]
    # The rotors' own inertia in links that turn is there, too: 1 / RATIO of this.
    assert found == pytest.approx(expected, abs=3.0 / RATIO * np.abs(expected).max())
    assert np.abs(found).max() > 20 * np.abs(found - expected).max()
    assert np.abs(expected[0]).max() > 5e-3  # which no rotor of its own spins on


def test_a_joint_on_the_ground_with_nothing_behind_it_has_no_such_effort():
    body = InverseDynamics(RobotDescription.load(arm(False)), JOINTS[:1])
    assert not body.spin(*np.ones((3, 1, 5)), np.ones(1)).any()


def test_dynamics_of_more_joints_than_memory_has_room_for_are_refused_in_a_line():
    count = MOST_COMPUTED + 1
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="l{k}">{body}</inertial></link>' for k in range(count))
    joints = "".join(
        f'<joint name="j{k}" type="continuous"><parent link="r"/><child link="l{k}"/></joint>'
        for k in range(count)
    )
    many = RobotDescription.load(f'<robot name="many"><link name="r"/>{links}{joints}</robot>')
    with pytest.raises(RobotDescriptionError, match=f"has {count} moving joints, and dynamics"):
        Dynamics(many)
    held = build_model(many, locked=["j0"])  # as many as are not held
    assert data_of(held) is not None
