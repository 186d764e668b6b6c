"""The bridge's parameters as a simulated world: a file, and what is laid over it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import ExperimentError, HpidError, SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.documents.sections import Section
from hpid_ros.documents.yaml_files import load_document
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.simulation.world_file import OF_EXPERIMENTS, WorldFile, read_world

_DEFAULT_ROBOT = "urdf/mobile_manipulator.urdf"
OVER_THE_FILE = {
    "joints": (
        *("robot", "driven", Parameter.Type.STRING_ARRAY),
        "Driven joints; all moving ones if left out",
    ),
    "fixed_base": (
        *("robot", "fixed_base", Parameter.Type.BOOL),
        "Hold the robot's root, without a ground",
    ),
    "payload_mass": (
        *("robot", "payload", Parameter.Type.DOUBLE),
        "Mass in the gripper [kg]",
    ),
    "control_rate": (
        *("control", "rate", Parameter.Type.DOUBLE),
        "States per simulated second [Hz]",
    ),
    "answer_timeout": (
        *("control", "answer_timeout", Parameter.Type.DOUBLE),
        "Wall time that lockstep waits for one answer [s]",
    ),
    "physics_steps": (
        *("simulation", "physics_steps", Parameter.Type.INTEGER),
        "Physics steps in one control period",
    ),
    "seed": (
        *("", "seed", Parameter.Type.INTEGER),
        "Of where each encoder's counts begin, of noise, of homing",
    ),
}
"""Parameters that are laid over the file: its section (none: the root), key, type, meaning."""


def read_world_file(node: Node, engine: str) -> WorldFile:
    """Declare the parameters of a world and return what they say.

    Args:
        node: The bridge.
        engine: Who computes the physics, whatever the file says.

    Raises:
        SettingError: A value is out of range.
        HpidError: The file or the robot cannot be read, or the robot lacks a joint.
    """
    file = str(
        read_only(
            node,
            "world_file",
            "",
            "YAML file of the world, for instance an experiment; what is given besides counts",
        )
    )
    document = load_document(find_resource(file), ExperimentError) if file else None
    robot = str(
        read_only(
            node,
            "robot_description",
            "" if file else _DEFAULT_ROBOT,
            "URDF of the robot: its XML text, a path, or a path in this package's share folder; "
            "that of world_file if empty",
        )
    )
    if not (file or robot.strip()):
        raise SettingError("robot_description must be a URDF or name one, it is empty")
    values = _laid_over(node, {} if document is None else document.values, robot, engine)
    positions = read_only(
        node,
        "initial_positions",
        Parameter.Type.DOUBLE_ARRAY,
        "Position of each driven joint at the start [rad]; zero, or the file's, if left out",
    )
    counts = read_only(
        node,
        "encoder_counts",
        Parameter.Type.INTEGER_ARRAY,
        "Encoder counts per revolution of each driven joint; 0 measures exactly",
    )
    found = _read(values, file, () if document is None else document.folders)
    world, joints = found.world, found.world.joints
    if positions:
        along = _along(joints, "initial_positions", positions)
        world = replace(world, initial_positions=dict(zip(joints, along, strict=True)))
    if counts:
        world = replace(world, encoder_counts=_along(joints, "encoder_counts", counts))
    return found._replace(world=replace(world, gui=_gui(node)))


def _laid_over(node: Node, values: Any, robot: str, engine: str) -> Any:
    """Return a document with the parameters that were given laid over it."""
    if not isinstance(values, dict):
        return values
    values = dict(values)
    given: dict[str, dict[str, Any]] = {"simulation": {"engine": engine}}
    given |= {"robot": {"description": robot}} if robot else {}
    for name, (section, key, kind, meaning) in OVER_THE_FILE.items():
        value = read_only(node, name, kind, f"{meaning}; the file's, or its default, if left out")
        if value is not None:
            value = list(value) if kind == Parameter.Type.STRING_ARRAY else value
            given.setdefault(section, {})[key] = value
    values |= given.pop("", {})
    for section, entries in given.items():
        own = values.get(section, {})
        if isinstance(own, dict):
            values[section] = own | entries
    return values


def _read(values: Any, file: str, folders: Sequence[Path]) -> WorldFile:
    try:
        root = Section(values, "", SettingError)
        for key in OF_EXPERIMENTS:
            root.take(key, None)
        found = read_world(root, folders)
        root.finish()
    except HpidError as error:
        raise SettingError(f"{file}: {error}" if file else str(error)) from None
    return found


def _along(joints: Sequence[str], name: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """Return the values of an array with one entry for each joint."""
    if len(values) != len(joints):
        raise SettingError(
            f"{name} must have one entry for each of {len(joints)} driven joints, "
            f"not {len(values)}"
        )
    return tuple(values)


def _gui(node: Node) -> bool:
    wanted = bool(read_only(node, "gui", False, "Show the engine's window"))
    # Without a display Bullet would end the process without a word.
    if wanted and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise SettingError("gui needs a display, and the variable DISPLAY names none")
    return wanted
