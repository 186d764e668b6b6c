"""Joint controllers and their merger before a ros2_control that is running already.

ros2 launch hpid_ros ros2_control.launch.py params_file:=FILE [composed:=false] [namespace:=NAME]

FILE is as config/ros2_control/joint_controllers.yaml. Composed is one process; otherwise every
controller and the merger have one each.
"""

import os

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import controller_name, node_sections
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.nodes.core.launching import failures
from hpid_ros.nodes.core.process import LAUNCH


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", description="controllers and merger: a file"),
            DeclareLaunchArgument(
                "composed",
                default_value="true",
                choices=["true", "false"],
                description="all nodes in one process",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="of all nodes"),
            OpaqueFunction(function=nodes),
        ]
    )


def joints_of(file):
    """Return the joints that the section of joint_controllers names."""
    sections = node_sections(load_yaml(file, SettingError))
    for name, values in sections.items():
        if name.rpartition("/")[2] == "joint_controllers" and values.get("joints"):
            return list(values["joints"])
    raise RuntimeError(f"{file} has no section joint_controllers with the parameter joints")


def nodes(context):
    value = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("params_file", "composed", "namespace")
    }
    file, namespace = value["params_file"], value["namespace"].strip("/")
    first = [SetEnvironmentVariable(LAUNCH, str(os.getpid())), *failures()]
    if value["composed"] == "true":
        # Without a name: a name would be given to every node of the process.
        arguments = ["--params-file", file, "-p", "merge:=true"]
        composed = Node(
            package="hpid_ros",
            executable="joint_controllers",
            namespace=namespace,
            ros_arguments=arguments,
            on_exit=Shutdown(),
        )
        return [*first, composed]
    controllers = [
        Node(
            package="hpid_ros",
            executable="joint_controller",
            namespace=namespace,
            name=controller_name(joint),
            parameters=[file],
        )
        for joint in joints_of(file)
    ]
    merger = Node(
        package="hpid_ros",
        executable="joint_command_merger",
        namespace=namespace,
        parameters=[file],
        on_exit=Shutdown(),
    )
    return [*first, *controllers, merger]
