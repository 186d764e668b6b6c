"""Every command interface on a graph: who subscribes gets the effort, its sign and its scale."""

import math

import pytest
from harness.graph import Told, ros_arguments
from sensor_msgs.msg import JointState

from hpid_ros.base.errors import SettingError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import NEWEST_COMMAND, OFFERED
from hpid_ros.nodes.parts.command_interfaces import (
    COMMAND_INTERFACES,
    OF_CONTROLLERS,
    OF_MERGERS,
    message_type,
)

MS = 1_000_000
P, AWAY = 8.0, 0.25  # [N m/rad] and [rad] from where the joint is held
EFFORTS = {"wrist": 1.5, "elbow": -4.0}

NUMBERS = {
    "joint_state": lambda message: list(message.effort),
    "float64_multi_array": lambda message: list(message.data),
    "float64": lambda message: [message.data],
    "dynamic_joint_state": lambda message: [each.values[0] for each in message.interface_values],
}
"""What a receiver reads of each interface's message."""

SCALES = dict.fromkeys(NUMBERS, 1.0)
"""What each message carries for an effort of 1 N m."""


def test_every_interface_is_tried():
    assert NUMBERS.keys() == SCALES.keys() == COMMAND_INTERFACES.keys()


def heard(harness, interface, topic):
    """Return a list that fills with the numbers that come on a topic."""
    try:
        kind = message_type(interface)
    except SettingError as error:
        pytest.skip(str(error))
    found = []
    harness.node.create_subscription(
        kind, topic, lambda message: found.append(NUMBERS[interface](message)), NEWEST_COMMAND
    )
    return found


@pytest.mark.parametrize("interface", OF_CONTROLLERS)
def test_a_controller_sends_its_effort(harness, interface):
    topic = COMMAND_INTERFACES[interface].controller_topic
    name = "elbow_controller"
    numbers = heard(harness, interface, topic.replace("~", name))
    gains = {"law": "pid", "gains__p": P, "gains__i": 0.0, "gains__d": 0.0}
    harness.start_controller(name, command_interface=interface, certify=False, **gains)
    stamps = iter(range(MS, 10**6 * MS, MS))

    def asked(position, expected):
        """Publish states until the answer to them comes, and return whether it is this."""
        harness.publish(next(stamps), position)
        return numbers and len(numbers[-1]) == 1 and math.isclose(numbers[-1][0], expected)

    harness.wait(lambda: asked(1.0, 0.0), what="an answer: the joint is held where it is")
    for away in (AWAY, -AWAY):  # a joint that is beyond its reference is driven back
        expected = SCALES[interface] * P * -away
        harness.wait(
            lambda away=away, expected=expected: asked(1.0 + away, expected),
            what=f"{expected} on {topic}",
            found=lambda: f"but {numbers[-3:]}",
        )


@pytest.mark.parametrize("interface", OF_MERGERS)
def test_a_merger_sends_the_efforts_in_their_order(harness, interface):
    name = "joint_command_merger"
    topic = COMMAND_INTERFACES[interface].merger_topic.replace("~", name)
    numbers = heard(harness, interface, topic)
    given = {"joints": str([*EFFORTS]), "command_interface": interface}
    arguments = ros_arguments(**given, fade_in_time=0.0, command_timeout=0.5)
    harness.processes.start(name, name, arguments)
    told = Told(harness, name)
    publishers = {  # a merger waits for as many as there are joints
        joint: harness.node.create_publisher(JointState, "joint_commands", OFFERED)
        for joint in EFFORTS
    }
    templates = {
        joint: JointStateTemplate([joint], f"/{joint}_controller", effort=True)
        for joint in EFFORTS
    }
    stamps = iter(range(MS, 10**6 * MS, MS))
    expected = [SCALES[interface] * effort for effort in EFFORTS.values()]

    def is_merged():
        stamp_ns = next(stamps)
        for joint, effort in EFFORTS.items():
            publishers[joint].publish(templates[joint].encode(stamp_ns, effort=[effort]))
        return numbers and numbers[-1] == expected

    harness.wait(
        is_merged,
        what=f"{expected} on {topic}",
        found=lambda: f"but {numbers[-3:]}, {told.newest()}",
    )
