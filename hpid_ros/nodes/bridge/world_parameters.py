"""The bridge's parameters as settings of a simulated world."""

from __future__ import annotations

import os
import sys

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.bridge import realism as realism_parameters
from hpid_ros.nodes.bridge.realism import along
from hpid_ros.nodes.bridge.reports import base_parameters
from hpid_ros.nodes.bridge.workplace import workplace
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings


def world_settings(node: Node) -> WorldSettings:
    """Declare the parameters of a world and return what they say.

    Args:
        node: The bridge.

    Raises:
        SettingError: A value is out of range.
        RobotDescriptionError: The robot cannot be read or lacks a joint.
    """
    source = str(
        read_only(
            node,
            "robot_description",
            "urdf/mobile_manipulator.urdf",
            "URDF of the robot: its XML text, a path, or a path in this package's share folder",
        )
    )
    if not source.strip():
        raise SettingError("robot_description must be a URDF or name one, it is empty")
    if not source.lstrip().startswith("<"):
        source = str(find_resource(source))
    joints = read_only(
        node, "joints", Parameter.Type.STRING_ARRAY, "Driven joints; all moving ones if left out"
    )
    joints = tuple(joints or RobotDescription.load(source).joints)
    rate = float(read_only(node, "control_rate", 1000.0, "States per simulated second [Hz]"))
    if not 0.1 <= rate <= 1e5:
        raise SettingError(f"control_rate must lie in [0.1, 100000] Hz, not {rate}")
    positions = along(
        joints,
        "initial_positions",
        read_only(
            node,
            "initial_positions",
            Parameter.Type.DOUBLE_ARRAY,
            "Position of each driven joint at the start [rad]; zero if left out",
        ),
    )
    counts = along(
        joints,
        "encoder_counts",
        read_only(
            node,
            "encoder_counts",
            Parameter.Type.INTEGER_ARRAY,
            "Encoder counts per revolution of each driven joint; 0 or left out measures exactly",
        ),
    )
    return WorldSettings(
        robot_description=source,
        joints=joints,
        control_period_ns=round(NANOSECONDS / rate),
        physics_steps=int(
            read_only(node, "physics_steps", 4, "Physics steps in one control period")
        ),
        initial_positions=dict(zip(joints, positions, strict=True)) if positions else {},
        encoder_counts=counts or 0,
        seed=int(
            read_only(node, "seed", 0, "Of where each encoder's counts begin, of noise, of homing")
        ),
        fixed_base=bool(
            read_only(node, "fixed_base", False, "Hold the robot's root, without a ground")
        ),
        payload_mass=float(read_only(node, "payload_mass", 0.0, "Mass in the gripper [kg]")),
        gui=_gui(node),
        drives=realism_parameters.drives(node, joints),
        position_noise=realism_parameters.position_noise(node, joints),
        homing=realism_parameters.homing(node, joints),
        velocity=realism_parameters.velocity(node),
        base=base_parameters(node, RobotDescription.load(source)),
        disturbances=realism_parameters.disturbances(node),
        workplace=workplace(node),
    )


def _gui(node: Node) -> bool:
    wanted = bool(read_only(node, "gui", False, "Show PyBullet's window"))
    # Without a display Bullet would end the process without a word.
    if wanted and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise SettingError("gui needs a display, and the variable DISPLAY names none")
    return wanted
