"""Which of the parameter files that a process was given are for its nodes.

ROS passes over a section that names another node, or the same one in another namespace, without a
word: the node would run with its defaults, and a bridge would simulate another robot.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml
from rclpy.node import Node

from hpid_ros.errors import SettingError
from hpid_ros.names import ANYWHERE, is_for, node_sections


class _Names(yaml.SafeLoader):
    """Reads the names in files of launch, which tags its arrays as tuples of Python."""


_Names.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


class ParameterSources:
    """The parameter files of a process.

    Args:
        command_line: Its arguments, with files that rcl has read.
    """

    def __init__(self, command_line: Sequence[str] = ()) -> None:
        self._files: dict[str, list[str]] = {}
        for file in _files(command_line):
            text = Path(file).read_text(encoding="utf-8", errors="replace")
            self._files[file] = list(node_sections(yaml.load(text, _Names)))

    def require_namespace(self, node: Node) -> None:
        """Refuse a file that has this node in another namespace only.

        Raises:
            SettingError: There is one; the line says how it can be mended.
        """
        full, name = node.get_fully_qualified_name(), node.get_name()
        for file, sections in self._files.items():
            elsewhere = [each for each in sections if each.rpartition("/")[2] == name]
            if elsewhere and not any(is_for(each, full) for each in sections):
                raise SettingError(
                    f"{full}: {file} has parameters for {', '.join(elsewhere)} and none for this "
                    f"node; {ANYWHERE}{name} in it stands for the node in any namespace"
                )

    def without(self, nodes: Iterable[Node]) -> list[str]:
        """Return a line for each file that has nothing for any of these nodes."""
        names = [node.get_fully_qualified_name() for node in nodes]
        return [
            f"{file} has nothing for {', '.join(names)}: {', '.join(sections) or 'it is empty'}"
            for file, sections in self._files.items()
            if not any(is_for(section, name) for section in sections for name in names)
        ]


def _files(command_line: Sequence[str]) -> list[str]:
    files: list[str] = []
    is_ros = False
    for index, argument in enumerate(command_line):
        if argument in ("--ros-args", "--"):
            is_ros = argument == "--ros-args"
        elif is_ros and argument == "--params-file":
            files += command_line[index + 1 : index + 2]
    return files
