"""ROS parameter files of an experiment's nodes.

The same files serve the nodes on a real robot: ``ros2 run hpid_ros joint_controllers --ros-args
--params-file controllers.yaml``, in whatever namespace.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from hpid_ros.base.names import ANYWHERE, controller_name
from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world_file import world_mapping


def controllers_document(settings: Sequence[LoopSettings], robot: str = "") -> dict[str, Any]:
    """Return the parameters of all controllers, and of their composition in one process."""
    document: dict[str, Any] = {
        f"{ANYWHERE}joint_controllers": {
            "ros__parameters": {"joints": [each.joint for each in settings]}
        }
    }
    for each in settings:
        values = each.to_parameters()
        if each.model.is_on and not each.model.description:
            values["model.description"] = robot
        document[f"{ANYWHERE}{controller_name(each.joint)}"] = {"ros__parameters": _nested(values)}
    return document


def controllers_text(settings: Sequence[LoopSettings], robot: str = "") -> str:
    """Return the same as the text of a file."""
    return str(yaml.safe_dump(controllers_document(settings, robot), sort_keys=False))


def bridge_document(experiment: Experiment, world_file: Path) -> dict[str, Any]:
    """Return the parameters of the bridge."""
    return {
        f"{ANYWHERE}{bridge_name(experiment.world)}": {
            "ros__parameters": {
                "world_file": str(world_file.resolve()),
                "duration": experiment.duration,
                "answer_timeout": experiment.answer_timeout,
                "ee_link": experiment.end_effector,
            }
        }
    }


def bridge_name(world: WorldSettings) -> str:
    """Return the executable, and the node, that simulates a world."""
    return f"{world.engine}_bridge"


def write_run_files(
    folder: Path, experiment: Experiment, settings: Sequence[LoopSettings]
) -> tuple[Path, Path]:
    """Write the parameter files of controllers, bridge and world, and return the first."""
    controllers, bridge, world = (
        folder / f"{name}.yaml" for name in ("controllers", "bridge", "world")
    )
    write_document(world, world_mapping(experiment.world))
    write_document(bridge, bridge_document(experiment, world))
    robot = str(experiment.world.robot_description)
    write_document(controllers, controllers_document(settings, robot))
    return controllers, bridge


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a YAML file; the text of a robot gets a file of its own beside it."""
    values = _with_robots_beside(document, path.resolve().parent)
    path.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def _with_robots_beside(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return parameters in which a URDF's text has become the path of a file with that text."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            value = _with_robots_beside(value, folder)
        elif isinstance(value, str) and value.startswith("<robot"):
            value = str(_robot_file(value, folder))
        result[name] = value
    return result


def _robot_file(text: str, folder: Path) -> Path:
    """Return the file with this text; it is written where it is not there yet."""
    for number in itertools.count(1):
        path = folder / ("robot.urdf" if number == 1 else f"robot_{number}.urdf")
        if not path.exists():
            path.write_text(text, encoding="utf-8")
        if path.read_text(encoding="utf-8") == text:
            break
    return path


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as nested mappings, the form that ``ros2 param dump`` gives."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split(".")
        inner = nested
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return nested
