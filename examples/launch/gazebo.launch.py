"""Controllers before the joint force topics of Gazebo, and the bridge between Gazebo and ROS.

    ros2 launch examples/launch/gazebo.launch.py model:=arm world:=default

The model has gz's JointStatePublisher and an ApplyJointForce for each joint, as
docs/robots/simulators.md has them. Gazebo itself, with the model in it, is started before.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

GAINS = {
    "shoulder": {"gains.p": 39.6, "gains.i": 132.0, "gains.d": 3.96},
    "elbow": {"gains.p": 7.56, "gains.i": 25.2, "gains.d": 0.756},
}


def force_topic(joint):
    """Return the topic of a joint's effort, as substitutions."""
    return ["/model/", LaunchConfiguration("model"), f"/joint/{joint}/cmd_force"]


def bridge():
    """Return the bridge: states to ROS, efforts to Gazebo."""
    model, world = LaunchConfiguration("model"), LaunchConfiguration("world")
    states = ["/world/", world, "/model/", model, "/joint_state"]
    efforts = [[*force_topic(joint), "@std_msgs/msg/Float64]gz.msgs.Double"] for joint in GAINS]
    return Node(
        package="ros_gz_bridge",
        executable="parameter_bridge",
        arguments=[[*states, "@sensor_msgs/msg/JointState[gz.msgs.Model"], *efforts],
        remappings=[(states, "joint_states")],
    )


def controller(joint):
    """Return a joint's controller, whose clock is that of the states."""
    parameters = {
        "joint": joint,
        "law": "hpid",
        "mu": -0.1,
        "norm.error_scale": 0.3,
        "command_interface": "float64",
        "state_clock": "simulated",  # a paused world is no gap
    }
    return Node(
        package="hpid_ros",
        executable="joint_controller",
        name=f"{joint}_controller",
        parameters=[parameters | GAINS[joint]],
        remappings=[("~/command", force_topic(joint))],
    )


def generate_launch_description():
    """Return the bridge and a controller for each joint."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("model", default_value="arm", description="name in the world"),
            DeclareLaunchArgument("world", default_value="default", description="Gazebo's world"),
            bridge(),
            *map(controller, GAINS),
        ]
    )
