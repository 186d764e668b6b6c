"""The simulated robot with its controllers on the open graph, to look into and to retune.

ros2 launch hpid_ros robot.launch.py [experiment:=FILE] [controller:=hPID] [mode:=realtime]
                                     [composed:=false] [bag:=FOLDER] [namespace:=NAME]
                                     [engine:=mujoco]

Where robot_state_publisher is installed it runs, too, so that RViz and Foxglove show the robot.
Two robots side by side are two launches with a namespace each.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import bridge_name, recorded_topics, write_run_files
from hpid_bench.experiment.processes import parameters
from hpid_ros.base.names import controller_name
from hpid_ros.nodes.core.launching import failures
from hpid_ros.nodes.core.process import LAUNCH
from hpid_ros.robot.description import RobotDescription

STATE_PUBLISHER = "robot_state_publisher"

ARGUMENTS = {
    "controller": ("", None, "label under compare in the experiment file; the last one if empty"),
    "mode": ("realtime", ["realtime", "lockstep"], "lockstep: as fast as the machine allows"),
    "engine": (
        "",
        ["", "pybullet", "mujoco"],
        "physics engine; empty: the experiment file's",
    ),
    "composed": ("false", ["true", "false"], "all controllers in one process"),
    "bag": ("", None, "record into this new folder"),
    "namespace": ("", None, "of all nodes, topics and services, and before the frames' names"),
    "gui": ("false", ["true", "false"], "show the engine's window"),
}


def generate_launch_description():
    default = [FindPackageShare("hpid_ros"), "config", "experiments", "paper.yaml"]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "experiment",
                default_value=PathJoinSubstitution(default),
                description="experiment file",
            ),
            *(
                DeclareLaunchArgument(
                    name, default_value=value, choices=choices, description=description
                )
                for name, (value, choices, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context):
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    file = LaunchConfiguration("experiment").perform(context)
    experiment = load_experiment(file, value["engine"] or None)
    label = value["controller"] or list(experiment.controllers)[-1]
    if label not in experiment.controllers:
        raise RuntimeError(
            f"controller must be one of {list(experiment.controllers)}, not {label}"
        )
    namespace = value["namespace"].strip("/")
    folder = Path(tempfile.mkdtemp(prefix="hpid_ros_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    settings = experiment.controllers[label]
    controllers, bridge = map(str, write_run_files(folder, experiment, settings))
    is_shown = is_installed(STATE_PUBLISHER)
    listeners = len(experiment.world.joints) + bool(value["bag"]) + is_shown
    started = [
        Node(
            package="hpid_ros",
            executable="trajectory_publisher",
            namespace=namespace,
            ros_arguments=parameters(reference_file=experiment.path),
        ),
        Node(
            package="hpid_ros",
            executable=bridge_name(experiment.world),
            namespace=namespace,
            on_exit=Shutdown(),
            parameters=[
                bridge,
                {
                    "mode": value["mode"],
                    "gui": value["gui"] == "true",
                    "duration": 0.0,
                    "frame_prefix": f"{namespace}/" if namespace else "",
                    # The robot would fall while its controllers are still starting, and a bag
                    # without its beginning cannot be compared. The publisher of the reference
                    # listens, too, until the motion has begun.
                    "wait_for_subscribers": listeners + 1,
                    "wait_for_publishers": len(experiment.world.joints),
                },
            ],
        ),
    ]
    # The reference starts for each joint with the first state that its controller takes: they
    # wait for it, so that all joints start together.
    if value["composed"] == "true":
        # Without a name: a name would be given to every node of the process.
        started.append(
            Node(
                package="hpid_ros",
                executable="joint_controllers",
                namespace=namespace,
                ros_arguments=[
                    "--params-file",
                    controllers,
                    "-p",
                    "wait_for_reference:=true",
                    "-p",
                    "state_clock:=simulated",
                ],
            )
        )
    else:
        started += [
            Node(
                package="hpid_ros",
                executable="joint_controller",
                namespace=namespace,
                name=controller_name(joint),
                parameters=[
                    controllers,
                    {"wait_for_reference": True, "state_clock": "simulated"},
                ],
            )
            for joint in experiment.world.joints
        ]
    if value["bag"]:
        started.append(
            Node(
                package="hpid_ros",
                executable="bag_recorder",
                namespace=namespace,
                on_exit=Shutdown(),
                ros_arguments=parameters(  # the file that launch makes has y for "y"
                    bag=value["bag"],
                    # What was retuned, too: hpid replay computes every command anew.
                    topics=["/parameter_events", *recorded_topics(experiment.world)],
                    controllers_file=controllers,
                ),
            )
        )
    if is_shown:
        started.append(
            Node(
                package=STATE_PUBLISHER,
                executable=STATE_PUBLISHER,
                namespace=namespace,
                parameters=[
                    {
                        "robot_description": RobotDescription.load(
                            experiment.world.robot_description
                        ).xml,
                        "frame_prefix": f"{namespace}/" if namespace else "",
                    }
                ],
            )
        )
    return [SetEnvironmentVariable(LAUNCH, str(os.getpid())), *failures(), *started]


def is_installed(package):
    try:
        get_package_share_directory(package)
    except PackageNotFoundError:
        return False
    return True
