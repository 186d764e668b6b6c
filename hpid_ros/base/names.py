"""Names of nodes, topics and labels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from hpid_ros.base.errors import HpidError
from hpid_ros.base.text import shown


def controller_name(joint: str) -> str:
    """Return the node name of a joint's controller in a composition, a launch or a run."""
    return f"{joint}_controller"


def claim_topic(commands: str, joint: str) -> str:
    """Return the topic on which a joint is claimed; ``ros2 topic list`` hides it."""
    return f"{commands}/_claim_{re.sub('[^A-Za-z0-9]+', '_', joint)}"


ALL_JOINTS = "all joints"
"""In place of a joint's name, where whoever commands them together claims them."""

ANYWHERE = "/**/"
"""Before a node's name in a parameter file: the node of that name in whatever namespace."""


def node_sections(document: object) -> dict[str, Mapping[str, Any]]:
    """Return the parameters in a ROS parameter file by the nodes that they are for."""
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
    """Return whether a section of a parameter file is for a node, by rcl's rules."""
    return section == node or ("*" in section and _pattern(section).fullmatch(node) is not None)


@lru_cache(maxsize=4096)
def _pattern(section: str) -> re.Pattern[str]:
    parts = {"**": r"(/\w+)*", "*": r"/\w+"}
    text = "".join(parts.get(part, f"/{re.escape(part)}") for part in section.split("/")[1:])
    return re.compile(text)


ALLOW_RELAY = "allow_relay"
"""Parameter of a controller: whether ``~/relay`` is obeyed."""

NODE_PARAMETERS = frozenset(
    {
        ALLOW_RELAY,
        "autostart",
        "certify",
        "claim",
        "command_interface",
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


_LONGEST = 48  # characters; with what is added to it a file's name stays below 255 bytes
_MARKS = frozenset(" -_.+=,()")

RULE = (
    "letters, digits, spaces and - _ . + = , ( ), beginning with a letter or digit, "
    f"at most {_LONGEST} characters"
)
"""What a label is."""


def is_label(text: object) -> bool:
    """Return whether something is a label."""
    return (
        isinstance(text, str)
        and 0 < len(text) <= _LONGEST
        and text[0].isalnum()
        and text == text.strip()
        and all(character.isalnum() or character in _MARKS for character in text)
    )


def require_label(text: object, where: str, error: type[HpidError]) -> str:
    """Return a label that is one."""
    if not is_label(text):
        came = shown(repr(text) if len(str(text)) <= 60 else f"{str(text)[:57]!r}...")
        raise error(f"{where}: a name must be {RULE}, not {came}")
    return str(text)
