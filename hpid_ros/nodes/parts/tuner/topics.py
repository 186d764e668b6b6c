"""Where a controller gets its states and tells its commands, whatever is remapped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

_STATES, _COMMANDS = "joint_states", "joint_commands"
KINDS: dict[str, Any] = {
    "sensor_msgs/msg/JointState": JointState,
    "std_msgs/msg/Float64MultiArray": Float64MultiArray,
    "std_msgs/msg/Float64": Float64,
}
JOINT_STATE = "sensor_msgs/msg/JointState"


class Topic(NamedTuple):
    """A topic."""

    name: str  # its full name
    type: str  # one of KINDS
    is_reliable: bool = False  # whether what was lost is sent again


class ControllerTopics(NamedTuple):
    """The topics of one controller that tell how it does."""

    states: Topic  # where its states come from
    commands: Topic | None  # where its commands go; None where they are not to be listened to
    reference: Topic


def controller_topics(node: Node, controller: str) -> tuple[ControllerTopics, bool]:
    """Return the topics of a controller, and whether the graph has told all of them.

    One that is not active listens to no states, and one of several in a process may leave both to
    the process: these have their usual names then.
    """
    space, _, name = controller.rpartition("/")
    known = [
        Topic(topic, kind)
        for topic, kinds in node.get_topic_names_and_types()
        for kind in kinds
        if kind in KINDS
    ]

    def of_controller(find: Callable[[str], list[TopicEndpointInfo]]) -> list[Topic]:
        """Go by endpoints: a dead node's name may be left, and hide a new node of that name."""
        who = (name, space or "/")
        return [
            each
            for each in known
            if any(
                (*who, each.type) == (info.node_name, info.node_namespace, info.topic_type)
                for info in find(each.name)
            )
        ]

    listens = of_controller(node.get_subscriptions_info_by_topic)
    tells = of_controller(node.get_publishers_info_by_topic)
    states = _chosen(listens, controller, _STATES, (JOINT_STATE,))
    commands = _chosen(tells, controller, _COMMANDS, tuple(KINDS))
    topics = ControllerTopics(
        states or Topic(f"{space}/{_STATES}", JOINT_STATE),
        commands or Topic(f"{space}/{_COMMANDS}", JOINT_STATE),
        Topic(f"{controller}/reference", JOINT_STATE, is_reliable=True),
    )
    return topics, states is not None and commands is not None


def _chosen(
    found: Sequence[Topic], controller: str, usual: str, kinds: Sequence[str]
) -> Topic | None:
    """Return the one that can be meant: of the usual name, if there are several."""
    own = f"{controller}/"
    might = [
        each
        for each in found
        if each.type in kinds and not (each.type == JOINT_STATE and each.name.startswith(own))
    ]
    might.sort(key=lambda each: (each.name.rpartition("/")[2] != usual, each.name))
    return might[0] if might else None
