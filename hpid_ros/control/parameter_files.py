"""Settings of controllers in the content of ROS parameter files and dumps, read elsewhere.

A file of ros2_control's own controllers is taken for their PIDs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, SettingError, unknown_name
from hpid_ros.base.names import ANYWHERE, NODE_PARAMETERS, is_for, node_sections
from hpid_ros.control.ros2_control_pids import pids_of
from hpid_ros.control.settings import LOOP_PARAMETERS, PARAMETERS, LoopSettings, Value

INERTIA_RANGES = "inertia_ranges"
"""Section of a parameter file with the least and the largest inertia of joints."""


Remarks = tuple[str, ...]

_MOST_SECTIONS = 1000  # each is held against each


class ParameterFile(NamedTuple):
    """What a ROS parameter file says of joint controllers."""

    loops: dict[str, LoopSettings]  # settings by node name, in the order of the file
    # [kg m^2] least and largest inertia by joint, of those that it knows
    inertias: dict[str, tuple[float, float]]
    remarks: tuple[str, ...] = ()  # of ros2_control's own: what has no counterpart, a line each


def parameters_from(document: object, where: str) -> ParameterFile:
    """Return what the content of a parameter file says.

    It has parameters of joint controllers, or of ros2_control's own controllers with a PID for
    each joint.
    """
    nodes, remarks = _given(document, where)
    loops = {name: _settings(values, f"{where}: {name}") for name, values in nodes.items()}
    return ParameterFile(loops, _inertia_ranges(document, where), remarks)


def settings_from_parameters(document: object, where: str) -> dict[str, LoopSettings]:
    """Return the settings of every joint controller in the content of a parameter file."""
    return parameters_from(document, where).loops


def parameters_in_file(document: object, where: str) -> dict[str, dict[str, Value]]:
    """Return what a parameter file itself says of every loop, by node; checked as a whole."""
    given, _ = _given(document, where)
    return {
        name: {key: value for key, value in each.to_parameters().items() if key in given[name]}
        for name, each in settings_from_parameters(document, where).items()
    }


def _given(document: object, where: str) -> tuple[Mapping[str, Mapping[str, Any]], Remarks]:
    """Return the parameters of every joint controller by node, unchecked, and remarks on them."""
    if not isinstance(document, Mapping):
        raise SettingError(f"{where} is no ROS parameter file: it must map node names")
    sections = {name: _flat(own) for name, own in node_sections(document).items()}
    if len(sections) > _MOST_SECTIONS:
        raise SettingError(f"{where} has {len(sections)} sections; {_MOST_SECTIONS} are allowed")
    pids = pids_of(sections, where)
    if pids is not None:
        return pids
    for name, node in document.items():
        if not node_sections({name: node}):
            is_old = isinstance(node, Mapping) and isinstance(node.get("type"), str)
            hint = ", as controllers of ROS 1" if is_old else ""
            raise SettingError(f"{where}: {name} has no mapping ros__parameters{hint}")
    nodes = _named_nodes(sections)
    for section, own in sections.items():
        of_loops = sorted(PARAMETERS.keys() & own.keys())
        is_used = _is_ranges(section) or any(is_for(section, full) for full in nodes.values())
        if of_loops and not is_used:
            raise SettingError(
                f"{where}: {section} has {of_loops[0]}, and the file names no node that it is for"
            )
    found = {}
    for name, full in nodes.items():
        values: dict[str, Any] = {}
        for section, own in sections.items():  # of two the later one counts, as for rcl
            if is_for(section, full):
                values |= own
        if "joint" in values:
            found[name] = values
    if not found:
        raise SettingError(
            f"{where} has no joint controller: no node in it has the parameter joint, nor a PID "
            f"of ros2_control's (nodes: {', '.join(nodes) or 'none'})"
        )
    return found, ()


def _is_ranges(section: str) -> bool:
    return section.rpartition("/")[2] == INERTIA_RANGES


def _named_nodes(sections: Iterable[str]) -> dict[str, str]:
    """Return a full name of each node, by the name that people know it by."""
    named = [each for each in sections if not each.endswith("*") and not _is_ranges(each)]
    certain = [each for each in named if "*" not in each]
    return {
        _short(each): each.replace("/**", "").replace("/*", "/any")
        for each in named
        if each in certain or not any(is_for(each, other) for other in certain)
    }


def _short(name: str) -> str:
    """Return a node's name as people know it: its namespace only where it has a certain one."""
    base = name.removeprefix(ANYWHERE).removeprefix("/")
    return name if "/" in base or "*" in base else base


def _inertia_ranges(document: object, where: str) -> dict[str, tuple[float, float]]:
    ranges: dict[str, tuple[float, float]] = {}
    for name, own in node_sections(document).items():
        if not _is_ranges(name):
            continue
        for joint, value in _flat(own).items():
            is_pair = isinstance(value, list) and len(value) == 2
            if not is_pair or not all(isinstance(x, float | int) for x in value):
                raise SettingError(
                    f"{where}: {INERTIA_RANGES} of {joint!r} must be its least and largest "
                    f"inertia, not {value!r}"
                )
            ranges[joint] = (float(value[0]), float(value[1]))
    return ranges


def _flat(parameters: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in parameters.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def _settings(values: Mapping[str, Any], where: str) -> LoopSettings:
    loop = {}
    for name, value in values.items():
        if name in PARAMETERS:
            loop[name] = value
        elif name.split(".")[0] not in NODE_PARAMETERS:
            raise SettingError(f"{where}: {unknown_name('parameter', name, LOOP_PARAMETERS)}")
    try:
        return LoopSettings.from_parameters(loop)
    except HpidError as error:
        raise SettingError(f"{where}: {error}") from None
