"""Robots of PyBullet's data, and how tests name, load and shorten them."""

from pathlib import Path

import numpy as np
import yaml

from hpid_ros.base.files import find_resource, share_folder
from hpid_ros.robot.description import RobotDescription

EXPERIMENTS = share_folder() / "config" / "experiments"
IIWA = "package://pybullet_data/kuka_iiwa/model.urdf"
PANDA = "package://pybullet_data/franka_panda/panda.urdf"


def robot(name: str) -> RobotDescription:
    return RobotDescription.load(find_resource(name))


def pose(description: RobotDescription, seed: int) -> dict[str, float]:
    chance = np.random.default_rng(seed)
    return {
        name: float(chance.uniform(joint.lower, joint.upper))
        for name, joint in description.joints.items()
    }


def short(name: str, tmp_path: Path, duration: float = 0.2, **robot_changes: object) -> Path:
    document = yaml.safe_load((EXPERIMENTS / f"{name}.yaml").read_text())
    document["duration"] = duration
    document["robot"] |= robot_changes
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def slider() -> str:
    """Return two hinges and, held askew on the second one, a slide."""
    inertial = """<inertial><mass value="0.5"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.015"/></inertial>"""
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in "abcd")
    joints = "".join(
        f"""<joint name="{pair}" type="{kind}"><parent link="{pair[0]}"/><child link="{pair[1]}"/>
        <origin xyz="0.1 0.2 0.3" rpy="{rpy}"/><axis xyz="{axis}"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
        for pair, kind, rpy, axis in (
            ("ab", "revolute", "0 0 0", "0 1 0"),
            ("bc", "revolute", "0.2 0 0", "1 0 0"),
            ("cd", "prismatic", "0.3 -0.5 1.1", "0.6 0 0.8"),
        )
    )
    return f'<robot name="slider">{links}{joints}</robot>'


def box(mesh: str) -> str:
    return f"""<robot name="box"><link name="body"><inertial><mass value="1"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
      <collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>
      <link name="speck"/><joint name="hinge" type="continuous"><parent link="body"/>
      <child link="speck"/></joint></robot>"""
