"""Parameters as people and tools give them: files and requests, in the types that nodes declare.

``60`` for a double is an integer to ROS; ``ros2 param dump`` writes ``null`` where an array was
left out, and a file gives that back as a text; ``ros2 param load`` sends every value as the text
that Python makes of it, so that ``5.0e-05`` comes as the text ``5e-05``. None of these can be
mistaken for another value, so they are taken for what they say. Everything else keeps its type.

ROS passes over a section that names another node, or the same one in another namespace, without a
word: the node would run with its defaults, and a bridge would simulate another robot.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.names import ANYWHERE, is_for, node_sections

_Type = Parameter.Type
_OVERRIDES = "qos_overrides."
_UNSET = ("null", "~", "None")
_WORDS = {
    _Type.BOOL: "true or false",
    _Type.INTEGER: "an integer",
    _Type.DOUBLE: "a double",
    _Type.STRING: "a text",
    _Type.BYTE_ARRAY: "an array of bytes",
    _Type.BOOL_ARRAY: "an array of true and false",
    _Type.INTEGER_ARRAY: "an array of integers",
    _Type.DOUBLE_ARRAY: "an array of doubles",
    _Type.STRING_ARRAY: "an array of texts",
}


def as_declared(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return a parameter that was given in the type that was declared."""
    if given.type_ == kind or kind == _Type.NOT_SET:
        return given
    if kind in (_Type.DOUBLE, _Type.DOUBLE_ARRAY):
        given = _numbers(given, kind)
    if kind.name.endswith("_ARRAY") and _is_empty(given):
        return Parameter(given.name, kind, [])
    if given.type_ == kind:
        return given
    if given.type_ == _Type.NOT_SET or (given.type_ == _Type.STRING and given.value in _UNSET):
        return Parameter(given.name)
    quotes = f", written '{given.value}'" if kind == _Type.STRING else ""
    raise SettingError(
        f"{given.name} must be {_WORDS[kind]}{quotes}, "
        f"not {_WORDS[given.type_]} ({_shown(given.value)})"
    )


def is_same(present: Parameter, change: Parameter) -> bool:
    """Tell whether a change would change nothing."""
    return bool(present.get_parameter_value() == change.get_parameter_value())


def require_known(nodes: Sequence[tuple[str, Collection[str], Collection[str]]]) -> None:
    """Refuse parameters that were given to nodes of which none has them.

    rclpy ignores them silently, and a mistyped gain would be a gain of zero. What is given on
    the command line goes to every node of a process, so it is enough that one of them has it;
    what is in a node's own section of a file that node must have.
    """
    for first, given, _ in nodes:
        for name in given:
            if name.startswith(_OVERRIDES):
                continue
            own = {each for _, got, has in nodes if name in got for each in has}
            if name in own:
                continue
            elsewhere = [node for node, _, has in nodes if name in has]
            line = f"it has no parameter {name!r}, {elsewhere[0]} has" if elsewhere else ""
            raise SettingError(f"{first}: {line or _unknown_parameter(name, own)}")


def _unknown_parameter(name: str, known: Iterable[str]) -> str:
    """Return the line for a parameter that does not exist: what is nearest is enough."""
    names = [each for each in known if not each.startswith(_OVERRIDES)]
    line, _, _ = unknown_name("parameter", name, names).partition(" known: ")
    return line if "did you mean" in line else f"{line} --help lists those that there are"


def _numbers(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Return numbers as doubles, whatever they were written as; what is none unchanged."""
    value = given.value
    try:
        if kind == _Type.DOUBLE and given.type_ in (_Type.INTEGER, _Type.STRING):
            return Parameter(given.name, kind, float(value))
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.INTEGER_ARRAY:
            return Parameter(given.name, kind, [float(each) for each in value])
        if kind == _Type.DOUBLE_ARRAY and given.type_ == _Type.STRING and value[:1] == "[":
            return Parameter(given.name, kind, [float(each) for each in value[1:-1].split(",")])
    except ValueError:
        pass
    return given


def _is_empty(given: Parameter) -> bool:
    """Tell whether an empty array was given, which has no type: YAML makes booleans of it."""
    return given.type_ == _Type.BOOL_ARRAY and not len(given.value)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class _Names(yaml.SafeLoader):
    """Reads the names in files of launch, which tags its arrays as tuples of Python."""


_Names.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


class ParameterSources:
    """The parameter files of a process."""

    def __init__(self, command_line: Sequence[str] = ()) -> None:
        self._files: dict[str, list[str]] = {}
        for file in _files(command_line):
            text = Path(file).read_text(encoding="utf-8", errors="replace")
            self._files[file] = list(node_sections(yaml.load(text, _Names)))

    def require_namespace(self, node: Node) -> None:
        """Refuse a file that has this node in another namespace only."""
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
