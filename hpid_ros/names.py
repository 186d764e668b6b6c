"""Names that several parts of the package must agree on."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any


def controller_name(joint: str) -> str:
    """Return the node name of a joint's controller in a composition, a launch or a run.

    Args:
        joint: Name of the joint.
    """
    return f"{joint}_controller"


def claim_topic(commands: str, joint: str) -> str:
    """Return the topic on which a joint is claimed; ``ros2 topic list`` hides it.

    Args:
        commands: Full name of the topic of the joint's commands.
        joint: The joint; what a topic's name may not have becomes an underscore.
    """
    return f"{commands}/_claim_{re.sub('[^A-Za-z0-9]+', '_', joint)}"


ANYWHERE = "/**/"
"""Before a node's name in a parameter file: the node of that name in whatever namespace."""


def node_sections(document: object) -> dict[str, Mapping[str, Any]]:
    """Return the parameters in a ROS parameter file by the nodes that they are for.

    Args:
        document: Its content: nodes, or namespaces of nodes, to ``{"ros__parameters": {...}}``.

    Returns:
        By full name, in which ``*`` stands for one part and ``**`` for any number of them.
    """
    sections: dict[str, Mapping[str, Any]] = {}
    for key, value in document.items() if isinstance(document, Mapping) else ():
        if not isinstance(value, Mapping):
            continue
        name = f"/{str(key).strip('/')}"
        if isinstance(value.get("ros__parameters"), Mapping):
            sections[name] = value["ros__parameters"]
        below = {each: inner for each, inner in value.items() if each != "ros__parameters"}
        sections |= {f"{name}{inner}": found for inner, found in node_sections(below).items()}
    return sections


def is_for(section: str, node: str) -> bool:
    """Tell whether a section of a parameter file is for a node, by rcl's rules.

    Args:
        section: From :func:`node_sections`.
        node: Full name of the node.
    """
    parts = {"**": r"(/\w+)*", "*": r"/\w+"}
    pattern = "".join(parts.get(part, f"/{re.escape(part)}") for part in section.split("/")[1:])
    return re.fullmatch(pattern, node) is not None


NODE_PARAMETERS = frozenset(
    {
        "autostart",
        "certify",
        "claim",
        "command_interface",
        "compensation",
        "cpu_affinity",
        "introspection_rate",
        "qos_overrides",
        "realtime_priority",
        "require_certificate",
        "robot_description",
        "start_type_description_service",
        "state_watchdog",
        "status_fd",
        "stop",
        "stop_duration",
        "use_sim_time",
        "wait_for_command_subscribers",
        "wait_for_reference",
    }
)
"""A controller node's parameters beside those of its loop, by the first part of the name."""

PROFILE_FILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Environment variables that name a file of Fast DDS profiles: Fast DDS 2, which Jazzy has, reads
the first, its successors the second."""
