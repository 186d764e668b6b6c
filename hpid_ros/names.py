"""Names that several parts of the package must agree on."""

from __future__ import annotations

import re


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
