"""A robot with any number of joints: pendulums side by side on a fixed beam."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import yaml

from hpid_ros.experiment.description import Experiment, load_experiment

LABEL = "hPID"

_MASS = 0.5  # [kg]
_LENGTH = 0.3  # [m], a rod that hangs from its end
_WIDTH = 0.02  # [m]
_GAP = 0.1  # [m] between neighbours
_EFFORT = 20.0  # [N m]
_INERTIA = _MASS * _LENGTH**2 / 3.0  # [kg m^2] about the joint
_POLE = 10.0  # [rad/s]; three of them, as in tracking.yaml


def pendulum_experiment(folder: Path, joints: int, duration: float) -> Experiment:
    """Write robot and experiment into a folder, and load the experiment.

    Every joint swings up by 0.4 rad and back, under the homogeneous PID. There is one physics
    step in each control period of 1 ms.

    Args:
        folder: Existing folder for the two files.
        joints: How many.
        duration: Length in [s].
    """
    names = [f"joint_{k + 1}" for k in range(joints)]
    (folder / "pendulums.urdf").write_text(_urdf(names), encoding="utf-8")
    file = folder / "pendulums.yaml"
    file.write_text(yaml.safe_dump(_document(names, duration), sort_keys=False), encoding="utf-8")
    return load_experiment(file)


def _urdf(names: list[str]) -> str:
    robot = ElementTree.Element("robot", name="pendulums")
    _add_link(robot, "beam", 1.0)
    for k, name in enumerate(names):
        joint = ElementTree.SubElement(robot, "joint", name=name, type="revolute")
        ElementTree.SubElement(joint, "parent", link="beam")
        ElementTree.SubElement(joint, "child", link=f"rod_{k + 1}")
        ElementTree.SubElement(joint, "origin", xyz=f"0 {_GAP * k:g} 0")
        ElementTree.SubElement(joint, "axis", xyz="0 1 0")
        ElementTree.SubElement(
            joint, "limit", lower="-3", upper="3", effort=str(_EFFORT), velocity="20"
        )
        _add_link(robot, f"rod_{k + 1}", _MASS)
    return ElementTree.tostring(robot, encoding="unicode")


def _add_link(robot: ElementTree.Element, name: str, mass: float) -> None:
    """Add a rod that hangs down from its frame."""
    link = ElementTree.SubElement(robot, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=f"0 0 {-0.5 * _LENGTH:g}")
    ElementTree.SubElement(inertial, "mass", value=str(mass))
    across, along = mass * (_LENGTH**2 + _WIDTH**2) / 12.0, mass * _WIDTH**2 / 6.0
    moments = {"ixx": across, "iyy": across, "izz": along, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    ElementTree.SubElement(
        inertial, "inertia", {key: str(value) for key, value in moments.items()}
    )


def _document(names: list[str], duration: float) -> dict[str, object]:
    gains = {
        "p": 3.0 * _POLE**2 * _INERTIA,
        "i": _POLE**3 * _INERTIA,
        "d": 3.0 * _POLE * _INERTIA,
    }
    norm = {"type": "weighted", "error_scale": 0.4, "rate_weight": 0.2}
    return {
        "name": f"{len(names)} pendulums",
        "duration": duration,
        "seed": 1,
        "robot": {"description": "pendulums.urdf", "fixed_base": True},
        "control": {"rate": 1000, "answer_timeout": 60.0},
        "simulation": {"physics_steps": 1},
        "sensors": {"encoder_counts": 16384},
        "reference": {
            "kind": "minimum_jerk",
            "times": [0.0, 0.5 * duration, duration],
            "positions": {name: [0.0, 0.4, 0.0] for name in names},
        },
        "controllers": {
            "common": {
                **{"velocity_source": "filtered", "norm": norm},
                **{"gains": gains, "inertia": _INERTIA},
            }
        },
        "compare": {LABEL: {"law": "hpid", "mu": -0.1}},
    }
