"""The nodes' parameters of an experiment, as ROS parameter files.

The same files serve the nodes on a real robot: ``ros2 run hpid_ros joint_controllers --ros-args
--params-file controllers.yaml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.names import controller_name

_NANOSECONDS = 1_000_000_000


def controllers_document(settings: Sequence[LoopSettings]) -> dict[str, Any]:
    """Return the parameters of all controllers, and of their composition in one process.

    Args:
        settings: One for each joint.
    """
    document: dict[str, Any] = {
        "joint_controllers": {"ros__parameters": {"joints": [each.joint for each in settings]}}
    }
    for each in settings:
        document[controller_name(each.joint)] = {"ros__parameters": _nested(each.to_parameters())}
    return document


def bridge_document(experiment: Experiment) -> dict[str, Any]:
    """Return the parameters of the bridge."""
    world = experiment.world
    return {
        "pybullet_bridge": {
            "ros__parameters": {
                "robot_description": str(world.robot_description),
                "joints": list(world.joints),
                "control_rate": _NANOSECONDS / world.control_period_ns,
                "physics_steps": world.physics_steps,
                "initial_positions": [
                    float(world.initial_positions.get(joint, 0.0)) for joint in world.joints
                ],
                "encoder_counts": list(world.counts),
                "seed": world.seed,
                "fixed_base": world.fixed_base,
                "payload_mass": world.payload_mass,
                "duration": experiment.duration,
                "answer_timeout": experiment.answer_timeout,
            }
        }
    }


def write_parameters(path: Path, document: Mapping[str, Any]) -> None:
    """Write a ROS parameter file."""
    path.write_text(yaml.safe_dump(dict(document), sort_keys=False), encoding="utf-8")


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
