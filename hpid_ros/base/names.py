"""Names of nodes, topics and labels."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any

from hpid_ros.base.errors import HpidError, unknown_name
from hpid_ros.base.text import shown

_CONTROLLER = "_controller"
_OTHER = re.compile("[^A-Za-z0-9_]")
_ESCAPE = re.compile("(?:^|_)((?:u[0-9a-f]{4,6}_)+)")
_LOOKS_ESCAPED = re.compile("u[0-9a-f]{4,6}(?:_|[^A-Za-z0-9_])")
_LONGEST_NODE = 200  # characters; with a service and its reply behind it, DDS allows 255
_SHOWN = 60  # characters


def node_word(text: str) -> str:
    """Return a text as a part of a name of ROS: letters, digits and underscores stay.

    Every other character, and a digit that comes first, becomes ``u`` with its number in Unicode,
    between underscores: ``left-arm`` is ``left_u002d_arm``, ``1st`` is ``u0031_st``. What looks so
    already is escaped, too, so that no two texts have one name; :func:`text_of_word` leads back.
    """
    escaped: list[str] = []
    parts: list[str] = []
    is_after_escape = True  # as at the beginning, where the underscore in front is left out
    for at, character in enumerate(text):
        is_escaped = (
            _OTHER.match(character) is not None
            or (at == 0 and character.isdigit())
            or (character == "_" and _LOOKS_ESCAPED.match(text, at + 1) is not None)
            or (is_after_escape and _LOOKS_ESCAPED.match(text, at) is not None)
        )
        if is_escaped:
            escaped.append(f"u{ord(character):04x}_")
        else:
            if escaped:
                parts += ["_" if parts else "", *escaped]
                escaped.clear()
            parts.append(character)
        is_after_escape = is_escaped
    return "".join([*parts, "_" if parts and escaped else "", *escaped])


def text_of_word(word: str) -> str:
    """Return the text that :func:`node_word` makes this word of; else the word itself."""

    def unescaped(match: re.Match[str]) -> str:
        numbers = (int(each[1:], 16) for each in match[1].split("_")[:-1])
        return "".join(chr(number) if number <= sys.maxunicode else "" for number in numbers)

    text = _ESCAPE.sub(unescaped, word)
    return text if node_word(text) == word else word


def controller_name(joint: str) -> str:
    """Return the node name of a joint's controller in a composition, a launch or a run."""
    return f"{node_word(joint)}{_CONTROLLER}"


def joint_of_controller(node: str) -> str:
    """Return the joint whose controller has this name, by :func:`controller_name`."""
    return text_of_word(node.removesuffix(_CONTROLLER))


def require_node_names(joints: Iterable[str], error: type[HpidError]) -> None:
    """Refuse joints after which no node, and no file of its log, can be called."""
    for joint in joints:
        length = len(controller_name(joint))
        if not joint:
            raise error("a joint without a name cannot have a node")
        if length > _LONGEST_NODE:
            raise error(
                f"joint {joint[:_SHOWN]!r}... cannot have a node: its name, "
                f"{controller_name(joint)[:_SHOWN]}..., would have {length} characters, "
                f"{_LONGEST_NODE} are allowed"
            )


def claim_topic(commands: str, joint: str) -> str:
    """Return the topic on which a joint is claimed; ``ros2 topic list`` hides it."""
    return f"{commands}/_claim_{node_word(joint)}"


_LEFT_OUT = ("!", "^")
"""Before a name or pattern: all but these. Shells give ``!`` a meaning of their own."""


class NamePatterns:
    """Names that people choose among: by themselves, by shell patterns, or as what they are not.

    ``arm_*`` are those that match, ``!*finger*`` (or ``^*finger*``) all but those; several are
    taken together. A name that exists is meant before a pattern of the same letters.
    """

    def __init__(self, texts: Sequence[str]) -> None:
        self._texts = tuple(texts)
        self._wanted = [each for each in texts if not each.startswith(_LEFT_OUT)]

    def __contains__(self, name: object) -> bool:
        """Return whether a name may be meant, before it is known which others there are."""
        if name in self._texts or not self._wanted:
            return True
        return any(fnmatchcase(str(name), each) for each in self._wanted)

    def chosen(
        self,
        kind: str,
        known: Collection[str],
        error: type[HpidError],
        default: Iterable[str] | None = None,
    ) -> list[str]:
        """Return the names that are meant, in the order in which they are asked for.

        Args:
            kind: What the names are, for the error about one that is none.
            known: The names that exist.
            error: What is raised where nothing matches.
            default: The names of which some are left out; all if None.
        """
        found: dict[str, None] = {}
        left_out: set[str] = set()
        is_chosen = False
        for text in self._texts:
            is_out = text not in known and text.startswith(_LEFT_OUT)
            pattern = text[1:] if is_out else text
            matched = [pattern] if pattern in known else _matched(pattern, known)
            if not matched:
                raise error(unknown_name(kind, text, known))
            if is_out:
                left_out.update(matched)
            else:
                found.update(dict.fromkeys(matched))
                is_chosen = True
        if not is_chosen:
            found.update(dict.fromkeys(known if default is None else default))
        chosen = [name for name in found if name not in left_out]
        if not chosen:
            raise error(
                f"no {kind} is left of {', '.join(self._texts)}; known: {', '.join(known)}"
            )
        return chosen


def _matched(pattern: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if fnmatchcase(name, pattern)]


ALL_JOINTS_CLAIM = "all joints"
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

LABEL_RULE = (
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
        raise error(f"{where}: a name must be {LABEL_RULE}, not {came}")
    return str(text)
