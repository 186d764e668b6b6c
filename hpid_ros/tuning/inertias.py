"""Inertias of a robot's joints over their range and payloads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hpid_ros.messages.series import JointSeries
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics

_SEED = 1
_VISITED = 200  # poses of a recording


def inertia_ranges(
    description: RobotDescription,
    joints: Sequence[str],
    payload: float,
    poses: int | Sequence[Mapping[str, float]],
) -> dict[str, tuple[float, float]]:
    """Return the least and the largest inertia that each joint's motor has to accelerate.

    It is 1 / (M^-1)_jj on a fixed base, rotors included; a wheel on the ground accelerates the
    robot as well, which is not in it.
    """
    names = list(dict.fromkeys(joints))
    found: dict[str, list[float]] = {name: [] for name in names}
    for mass in sorted({0.0, payload}):
        dynamics = Dynamics(description, payload_mass=mass)
        if isinstance(poses, int):
            for name, each in dynamics.inertia_range(names, poses, _SEED).items():
                found[name] += [each.minimum, each.maximum]
        else:
            for pose in poses:
                known = {name: at for name, at in pose.items() if name in description.joints}
                for name, inertia in dynamics.joint_inertias(names, known).items():
                    found[name].append(inertia)
    return {name: (min(each), max(each)) for name, each in found.items()}


def visited_poses(recorded: Sequence[JointSeries]) -> list[dict[str, float]]:
    """Return poses of a recording, evenly spaced among its states: none in a long gap."""
    if not recorded:
        return []
    known = np.unique(np.concatenate([each.state_stamps_ns for each in recorded]))
    places = np.linspace(0.0, len(known) - 1.0, _VISITED)
    stamps = np.interp(places, np.arange(len(known)), known)
    columns = [np.interp(stamps, each.state_stamps_ns, each.position) for each in recorded]
    names = [each.joint for each in recorded]
    return [dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)]
