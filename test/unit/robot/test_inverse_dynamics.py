"""Efforts that links and rotors need."""

import numpy as np
import pytest

from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import InverseDynamics

RATIO = 50.0
JOINTS = ("a", "b", "c")
AXES = ("0 0 1", "0 1 0", "0.6 0 0.8")
REFLECTED = np.array([0.5, 0.3, 0.2])  # [kg m^2]


def arm(has_rotor_bodies):
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
            f'<drake:gear_ratio value="{RATIO}"/><drake:rotor_inertia value="0"/></actuator>'
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


def test_rotors_that_spin_need_what_bodies_of_their_own_would():
    draw = np.random.default_rng(1).standard_normal
    motion = draw((3, len(JOINTS), 20))
    body = InverseDynamics(RobotDescription.load(arm(False)), JOINTS)
    found = body.spin(*motion, REFLECTED)
    rotors = [f"rotor_{name}" for name in JOINTS]
    whole = InverseDynamics(RobotDescription.load(arm(True)), [*JOINTS, *rotors])
    efforts = whole.efforts(*np.concatenate([motion, RATIO * motion], axis=1))
    bodies = efforts[:3] + RATIO * efforts[3:]
    expected = bodies - body.efforts(*motion) - REFLECTED[:, None] * motion[2]
    # The rotors' own inertia in links that turn is there, too: 1 / RATIO of this.
    assert found == pytest.approx(expected, abs=3.0 / RATIO * np.abs(expected).max())
    assert np.abs(found).max() > 20 * np.abs(found - expected).max()
    assert np.abs(expected[0]).max() > 5e-3  # which no rotor of its own spins on


def test_a_joint_on_the_ground_with_nothing_behind_it_has_no_such_effort():
    body = InverseDynamics(RobotDescription.load(arm(False)), JOINTS[:1])
    assert not body.spin(*np.ones((3, 1, 5)), np.ones(1)).any()
