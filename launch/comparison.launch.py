"""The comparison of an experiment, as `hpid compare` runs it: closed, in lock-step, recorded.

ros2 launch hpid_ros comparison.launch.py [experiment:=FILE] [output:=FOLDER]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from hpid_ros.nodes.core.launching import failures


def generate_launch_description():
    hpid = ExecutableInPackage(package="hpid_ros", executable="hpid")
    command = [hpid, "compare", LaunchConfiguration("experiment")]
    output = LaunchConfiguration("output")
    is_default = EqualsSubstitution(output, "")
    default = [FindPackageShare("hpid_ros"), "config", "experiments", "paper.yaml"]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "experiment",
                default_value=PathJoinSubstitution(default),
                description="experiment file",
            ),
            DeclareLaunchArgument(
                "output",
                default_value="",
                description="new result folder; results/NAME-TIME if empty",
            ),
            *failures(),
            ExecuteProcess(cmd=command, output="screen", condition=IfCondition(is_default)),
            ExecuteProcess(
                cmd=[*command, "--output", output],
                output="screen",
                condition=UnlessCondition(is_default),
            ),
        ]
    )
