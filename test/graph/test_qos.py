"""Qualities of service: newest commands for drivers, and overrides that change one topic alone."""

import pytest
from harness.graph import ros_arguments
from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import JointState

from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import NEWEST_STATES, OFFERED, overridable

MS = 1_000_000


@pytest.fixture
def node(harness):
    overrides = {
        "qos_overrides./a.publisher.depth": 7,
        "qos_overrides./a.publisher.lifespan": 50 * MS,
        "qos_overrides./a.subscription.reliability": "reliable",
    }
    node = ClosingNode(
        "overridden",
        context=harness.context,
        parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
    )
    yield node
    node.destroy_node()


def test_an_override_is_in_force_on_its_topic_alone(node):
    first, second = (
        node.create_publisher(JointState, topic, OFFERED, qos_overriding_options=overridable())
        for topic in ("a", "b")
    )
    assert (first.qos_profile.depth, second.qos_profile.depth) == (7, OFFERED.depth)
    (told,) = node.get_publishers_info_by_topic("/a")
    assert told.qos_profile.lifespan == Duration(nanoseconds=50 * MS)
    (told,) = node.get_publishers_info_by_topic("/b")
    assert told.qos_profile.lifespan > Duration(seconds=10**6)
    heard = [
        node.create_subscription(
            JointState, topic, print, NEWEST_STATES, qos_overriding_options=overridable()
        )
        for topic in ("a", "b")
    ]
    policies = [each.qos_profile.reliability for each in heard]
    assert policies == [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]


@pytest.mark.parametrize(
    ("interface", "depth"), [("float64_multi_array", 1), ("float64", 1), ("joint_state", 4000)]
)
def test_a_driver_is_sent_the_newest_command_and_a_recorder_all_of_them(harness, interface, depth):
    topic = {"joint_state": "/joint_commands", "float64": "/elbow_controller/command"}
    topic = topic.get(interface, "/elbow_controller/commands")
    name = f"qos_overrides.{topic}.publisher.depth"
    harness.processes.start(
        "elbow_controller",
        "joint_controller",
        ros_arguments(joint="elbow", command_interface=interface, claim="none"),
    )
    request = GetParameters.Request(names=[name])
    answer = harness.call(GetParameters, "elbow_controller/get_parameters", request)
    assert [value.integer_value for value in answer.values] == [depth]
