"""The bridge's parameters: its world, a file and what is laid over it, and its pace."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import ExperimentError, SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.documents.yaml_files import load_document
from hpid_ros.nodes.ros.parameters import read_choice, read_number, read_only
from hpid_ros.simulation.world_file import WorldFile, world_of

MODES = ("lockstep", "realtime")

_RESTART_TAKES = 0.2  # [s], at least: nobody waits for the place of one that was killed
_POSITIVE = (1e-6, 1e6)
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
    """Declare the parameters of a world and return what they say."""
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
    found = world_of(values, document)
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


@dataclass(frozen=True)
class Pace:
    """When a state is published."""

    is_lockstep: bool  # every state waits for its answers; otherwise the wall clock paces them
    end_ns: int | None  # [ns] stamp of the last state; None runs for ever
    exits: bool  # whether the process ends after the last state
    real_time_factor: float  # simulated time per wall time in realtime
    answer_timeout: float  # [s] wall time that lockstep waits for one answer
    command_timeout_ns: int  # [ns] simulated time for which a command stands in realtime
    subscribers: int  # subscribers that the states must have before the first one
    publishers: int  # publishers that the commands must have before the first state

    @property
    def command_patience(self) -> float:
        """Silence of a joint's publisher after which another one may command it, in [s]."""
        if self.is_lockstep:
            return min(self.answer_timeout, _RESTART_TAKES)
        return self.command_timeout_ns / NANOSECONDS / self.real_time_factor


def read_pace(node: Node, joints: int, answer_timeout: float) -> Pace:
    """Declare the parameters of time and return what they say."""
    mode = read_choice(node, "mode", "lockstep", f"Pace of the states: {', '.join(MODES)}", MODES)
    everyone = joints if mode == "lockstep" else 0

    def positive(name: str, default: float, description: str) -> float:
        return read_number(node, name, default, description, _POSITIVE)

    duration = read_number(
        node, "duration", 0.0, "Stamp of the last state [s]; 0 runs for ever", (0.0, 1e9)
    )
    timeout = positive(
        "command_timeout", 0.1, "Simulated time for which a command stands in realtime [s]"
    )
    return Pace(
        is_lockstep=mode == "lockstep",
        end_ns=round(duration * NANOSECONDS) if duration > 0.0 else None,
        exits=read_only(node, "exit_when_done", True, "End the process after the last state"),
        real_time_factor=positive(
            "real_time_factor", 1.0, "Simulated time per wall time in realtime"
        ),
        answer_timeout=answer_timeout,
        command_timeout_ns=round(timeout * NANOSECONDS),
        subscribers=read_only(
            node, "wait_for_subscribers", everyone, "Subscribers that states must have first"
        ),
        publishers=read_only(
            node, "wait_for_publishers", everyone, "Publishers that commands must have first"
        ),
    )
