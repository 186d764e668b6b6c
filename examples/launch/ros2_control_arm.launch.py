"""A ros2_control arm from its URDF to joint controllers: manager, broadcaster, merger, loops.

    ros2 launch examples/launch/ros2_control_arm.launch.py urdf:=arm.urdf

``arm.urdf`` has a ros2_control tag with ``effort`` as command interface of each joint
(docs/robots/ros2_control.md). The parameters of both sides are the package's examples: copy
config/ros2_control and put your joints and gains into them.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("hpid_ros")
CONTROLLERS = PathJoinSubstitution([SHARE, "config", "ros2_control", "controllers.yaml"])
LOOPS = PathJoinSubstitution([SHARE, "config", "ros2_control", "joint_controllers.yaml"])
LOOPS_LAUNCH = PathJoinSubstitution([SHARE, "launch", "ros2_control.launch.py"])
SPAWNED = ("joint_state_broadcaster", "effort_controller")


def generate_launch_description():
    """Return the hardware's side, its controllers, and ours."""
    text = ParameterValue(Command(["cat ", LaunchConfiguration("urdf")]), value_type=str)
    return LaunchDescription(
        [
            DeclareLaunchArgument("urdf", description="with a ros2_control tag"),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[{"robot_description": text}],
            ),
            Node(
                package="controller_manager",
                executable="ros2_control_node",
                parameters=[CONTROLLERS],
                remappings=[("~/robot_description", "/robot_description")],
            ),
            Node(
                package="controller_manager",
                executable="spawner",
                arguments=[*SPAWNED, "--param-file", CONTROLLERS],
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(LOOPS_LAUNCH),
                launch_arguments={"params_file": LOOPS}.items(),
            ),
        ]
    )
