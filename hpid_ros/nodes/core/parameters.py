"""Parameters: declared by records, and taken for what files, dumps and people say.

``60`` for a double is an integer to ROS; ``ros2 param dump`` writes ``null`` where an array was
left out, and a file gives that back as a text; ``ros2 param load`` sends every value as the text
that Python makes of it, so that ``5.0e-05`` comes as the text ``5e-05``. None of these can be
mistaken for another value, so they are taken for what they say. Everything else keeps its type.

ROS passes over a section that names another node, or the same one in another namespace, without a
word: the node would run with its defaults, and a bridge would simulate another robot.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rcl_interfaces.srv import ListParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.names import ANYWHERE, is_for, node_sections
from hpid_ros.base.records import (
    AnyRecord,
    ParameterSpec,
    from_parameters,
    parameters_of,
    short_repr,
)
from hpid_ros.base.units import of_slide

_Type = Parameter.Type
_TYPES = {
    bool: _Type.BOOL,
    int: _Type.INTEGER,
    float: _Type.DOUBLE,
    str: _Type.STRING,
    tuple[str, ...]: _Type.STRING_ARRAY,
    tuple[int, ...]: _Type.INTEGER_ARRAY,
    tuple[float, ...]: _Type.DOUBLE_ARRAY,
}


def _descriptor(spec: ParameterSpec, text: str, *, read_only: bool) -> ParameterDescriptor:
    described = ParameterDescriptor(description=text, read_only=read_only)
    if spec.choices:
        described.additional_constraints = f"one of: {', '.join(spec.choices)}"
    elif isinstance(spec.default, float) and math.isfinite(spec.minimum + spec.maximum):
        described.additional_constraints = f"from {spec.minimum:g} to {spec.maximum:g}"
    if spec.slider:
        low, high = spec.slider
        described.floating_point_range = [
            FloatingPointRange(from_value=low, to_value=high, step=0.0)
        ]
    return described


def declare(
    node: Node,
    specs: Iterable[ParameterSpec],
    read_only: Collection[str] = (),
    *,
    is_slide: bool = False,
    defaults: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Declare parameters from their records; for a prismatic joint in m and N.

    ``defaults`` take the place of the records' own.
    """
    for spec in specs:
        text = of_slide(spec.description) if is_slide else spec.description
        described = _descriptor(spec, text, read_only=spec.name in read_only)
        node.declare_parameter(spec.name, defaults.get(spec.name, spec.default), described)


def read(node: Node, kind: type[AnyRecord], **defaults: Any) -> AnyRecord:
    """Declare a record's parameters, fixed when the node starts, and return what they say."""
    specs = parameters_of(kind).items()
    values = {
        name: read_one(node, spec, defaults.get(spec.path, spec.default)) for name, spec in specs
    }
    return from_parameters(kind, values)


def read_one(node: Node, spec: ParameterSpec, default: object = None, note: str = "") -> Any:
    """Declare one parameter, fixed when the node starts, and return its value; None if not given.

    Without a default its type alone is declared.
    """
    start = _TYPES[spec.kind] if default is None else default
    start = list(start) if isinstance(start, tuple) else start
    described = _descriptor(spec, spec.description + note, read_only=True)
    return node.declare_parameter(spec.name, start, described).value


def declared_names(node: Node) -> list[str]:
    """Return the names of a node's parameters, also of those without a value."""
    return list(node.list_parameters([], ListParameters.Request.DEPTH_RECURSIVE).names)


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
    number = _number(given, kind)
    if number is not None:
        return Parameter(given.name, kind, number)
    # An empty array has no type in YAML: ROS makes booleans of it.
    is_empty = given.type_ == _Type.BOOL_ARRAY and not len(given.value)
    if kind.name.endswith("_ARRAY") and is_empty:
        return Parameter(given.name, kind, [])
    if given.type_ == _Type.NOT_SET or (given.type_ == _Type.STRING and given.value in _UNSET):
        return Parameter(given.name)
    hint = _quoting(given) if kind in (_Type.STRING, _Type.STRING_ARRAY) else ""
    raise SettingError(
        f"{given.name} must be {_WORDS[kind]}, "
        f"not {_WORDS[given.type_]} ({short_repr(given.value)}){hint}"
    )


def _quoting(given: Parameter) -> str:
    """Return how to write the text that ROS has taken for something else."""
    is_array = given.type_.name.endswith("_ARRAY")
    value = given.value[0] if is_array else given.value
    if isinstance(value, bool):
        words = ("y", "yes", "on", "true") if value else ("n", "no", "off", "false")
        why, example = f"{', '.join(words[:-1])} and {words[-1]} are booleans to ROS", words[0]
    elif isinstance(value, int | float):
        why, example = "numbers are no texts to ROS", f"{value:g}"
    else:
        return ""
    quoted = f'["{example}"]' if is_array else f'"{example}"'
    return f"; without quotes {why}: write '{quoted}'"


def _number(given: Parameter, kind: Parameter.Type) -> float | list[float] | None:
    """Return what a double, or an array of them, was written as; None for what is none."""
    value, type_ = given.value, given.type_
    try:
        if kind == _Type.DOUBLE and type_ in (_Type.INTEGER, _Type.STRING):
            return float(value)
        if kind == _Type.DOUBLE_ARRAY and type_ == _Type.INTEGER_ARRAY:
            return [float(each) for each in value]
        if kind == _Type.DOUBLE_ARRAY and type_ == _Type.STRING and value[:1] == "[":
            return [float(each) for each in value[1:-1].split(",")]
    except ValueError:
        pass
    return None


def require_known_parameters(
    nodes: Sequence[tuple[str, Collection[str], Collection[str]]],
) -> None:
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


class _Names(yaml.SafeLoader):
    """Reads files of launch, which tags its arrays as tuples of Python."""


_Names.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


class ParameterSources:
    """The parameter files of a process."""

    def __init__(self, command_line: Sequence[str] = ()) -> None:
        self._files: dict[str, list[str]] = {}
        is_ros = False
        for argument, file in pairwise(command_line):
            if argument in ("--ros-args", "--"):
                is_ros = argument == "--ros-args"
            elif is_ros and argument == "--params-file":
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
