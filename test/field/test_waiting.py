"""What is waited for stands in the log, once: how people's robots stand still.

A topic in another namespace (lbr_fri_ros2_stack#275, kinova-ros#212), joints of another name
(ros2_controllers#406, lbr_fri_ros2_stack#244), another type of message (ros2cli#430), another
quality of service (rosbag2#967, ros2cli#593), nobody there (moveit2#2645, ar4_ros_driver#66).
"""

import time
from itertools import count

import pytest
from harness.goals import needs_control_msgs
from harness.graph import NAME, ros_arguments
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
VOLATILE = QoSProfile(depth=5, durability=DurabilityPolicy.VOLATILE)


class Robot:
    """A robot whose wiring may be wrong."""

    def __init__(self, harness):
        self._harness = harness
        self._stamps = count(1)
        self._states = []

    def state(self, topic, *joints, qos=BEST_EFFORT):
        """Publish states of joints from now on; without joints only seem to."""
        publisher = self._harness.node.create_publisher(JointState, topic, qos)
        if joints:
            self._states.append((publisher, joints))

    def obey(self, topic):
        self._harness.node.create_subscription(JointState, topic, lambda _: None, 10)

    def start(self, executable, namespace, *arguments, **parameters):
        """Start a node in a namespace, and return a function that says what it has logged."""
        name = f"{namespace}_{executable}"
        process = self._harness.processes.start(
            name,
            executable,
            [*ros_arguments(**parameters), "-r", f"__ns:=/{namespace}", *arguments],
            is_renamed=False,
        )
        return process.log.read_text

    def wait(self, condition, what):
        """Move, as long as it takes."""

        def moved():
            for publisher, joints in self._states:
                message = JointState(name=joints, position=[0.0] * len(joints))
                message.header.stamp.nanosec = next(self._stamps) * 1000
                publisher.publish(message)
            return condition()

        self._harness.wait(moved, what=what)

    def requires(self, lines):
        """Wait until each log has its line, and return them."""
        missing = dict(lines)

        def are_all_there():
            for log, line in lines.items():
                if line in log():
                    missing.pop(log, None)
            return not missing

        try:
            self.wait(are_all_there, "the lines")
        except AssertionError:
            raise AssertionError(
                "\n".join(f"no {line!r} in:\n{log()}" for log, line in missing.items())
            ) from None


@pytest.fixture
def robot(harness):
    return Robot(harness)


def controller(robot, namespace, joint="elbow"):
    return robot.start("joint_controller", namespace, joint=joint, certify=False)


def test_a_controller_says_what_is_wrong_with_its_states_and_when_they_come(robot, harness):
    for namespace in ("right", "other", "text", "still"):
        robot.obey(f"/{namespace}/joint_commands")
    robot.state("/other/joint_states", "shoulder", "elbow_joint")
    robot.state("/still/joint_states")
    harness.node.create_publisher(String, "/text/joint_states", 10)
    robot.state("/robot/joint_states", "elbow")
    deaf, none, other, text, still = (
        controller(robot, namespace) for namespace in ("deaf", "right", "other", "text", "still")
    )
    states = "waiting for states of elbow"
    robot.requires(
        {
            deaf: "waiting for a subscriber of the commands of elbow: /deaf/joint_commands has no "
            "subscriber; subscribers are on /joint_commands, /other/joint_commands",
            none: f"{states}: /right/joint_states has no publisher; publishers are on "
            "/joint_states, /other/joint_states, /robot/joint_states, /still/joint_states",
            other: f"{states}: /other/joint_states has 1 publisher (/robot); joints seen there: "
            "elbow_joint, shoulder; did you mean 'elbow_joint'?",
            text: f"{states}: /text/joint_states has 1 publisher (/robot); /robot publishes "
            "std_msgs/msg/String, not sensor_msgs/msg/JointState",
            still: f"{states}: /still/joint_states has 1 publisher (/robot); nothing has come",
        }
    )
    for namespace in ("right", "other"):
        robot.state(f"/{namespace}/joint_states", "elbow")
    robot.requires(dict.fromkeys((none, other), "states of elbow come now, after "))
    for log in (deaf, none, other, text, still):
        assert log().count("waiting for") == 1


def test_a_composition_says_in_one_line_what_all_its_joints_wait_for(robot):
    robot.obey("/arm/joint_commands")
    robot.state("/arm/joint_states", "arm_a", "arm_b")
    log = robot.start("joint_controllers", "arm", joints="[a,b]", certify=False)
    line = "waiting for states of a, b: /arm/joint_states has 1 publisher (/robot); joints seen"
    robot.requires({log: f"{line} there: arm_a, arm_b"})
    robot.state("/arm/joint_states", "a", "b")
    robot.requires({log: "states of a, b come now, after"})
    assert log().count("waiting for") == 1


def test_those_who_wait_for_controllers_say_so(robot, tmp_path):
    robot.obey("/hears/joint_command_merger/commands")
    group = robot.start("joint_command_merger", "deaf", controller="efforts")
    merger = robot.start("joint_command_merger", "hears", joints="[elbow,wrist]")
    bridge = robot.start("mujoco_bridge", "sim", joints="[arm_joint_1]")
    recorder = robot.start(
        "bag_recorder", "tape", bag=tmp_path / "bag", topics="[joint_comand,joint_states]"
    )
    robot.state("/tape/joint_commands")
    robot.requires(
        {
            group: "waiting for a subscriber of the commands: /deaf/efforts/commands has no "
            "subscriber; the parameter controller is /deaf/efforts",
            merger: "waiting for commands of elbow, wrist: /hears/joint_commands has no publisher",
            bridge: "waiting for a publisher of commands: /sim/joint_commands has no publisher",
            recorder: "waiting for a publisher of /tape/joint_comand: /tape/joint_comand has no "
            "publisher; publishers are on /tape/joint_commands",
        }
    )
    robot.requires({bridge: "waiting for a subscriber of the states: /sim/joint_states has no"})
    robot.state("/tape/joint_comand")
    robot.requires({recorder: "a publisher of /tape/joint_comand is there now, after"})


@needs_control_msgs
def test_the_action_says_what_goals_cannot_be_followed_without(robot):
    robot.state("/arm/joint_states", "elbow", "upper_shoulder")
    log = robot.start("follow_joint_trajectory", "arm", joints="[elbow,shoulder]")
    line = "waiting for states of shoulder: /arm/joint_states has 1 publisher (/robot); joints"
    robot.requires({log: f"{line} seen there: elbow, upper_shoulder; did you mean"})
    robot.state("/arm/joint_states", "shoulder")
    robot.requires({log: "waiting for a controller: /arm/joint_trajectory has no subscriber"})
    assert log().count("states of shoulder come now") == 1


@needs_control_msgs
def test_two_action_servers_of_one_name_warn_of_each_other(robot):
    """ros2/demos#417, ros2/rclpy#474: the client alone was told, and only sometimes."""
    logs = [robot.start("follow_joint_trajectory", "arm", joints="[elbow]")]
    robot.wait(lambda: "waiting" in logs[0](), "the first server")
    assert "another action server" not in logs[0]()
    second = robot._harness.processes.start(
        "second",
        "follow_joint_trajectory",
        [*ros_arguments(joints="[elbow]"), "-r", "__ns:=/arm"],
        is_renamed=False,
    )
    logs.append(second.log.read_text)
    name = "/arm/joint_trajectory_controller"
    line = f"another action server is called {name}/follow_joint_trajectory, of {name}: each"
    robot.requires(dict.fromkeys(logs, line))
    robot._harness.processes.stop(["second"])
    robot.requires({logs[0]: f"no other action server is called {name}/follow_joint_trajectory"})


def test_a_volatile_publisher_of_trajectories_is_not_told_that_nothing_is_sent(harness, capfd):
    """rclpy warned of the latched subscription, though the volatile one takes what it sends."""
    harness.start_controller(NAME, "elbow", gains__p=1.0, stop="zero")
    harness.ask_newcomer(1_000_000, 0.0)
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", VOLATILE)
    harness.wait(publisher.get_subscription_count, what="a match")
    end = time.monotonic() + 1.0
    harness.wait(lambda: time.monotonic() > end, what="a warning that should not come")
    assert "incompatible" not in capfd.readouterr().err
