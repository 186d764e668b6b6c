"""Inertias of a robot's joints over their range and payloads."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics

_SEED = 1


def inertia_ranges(
    description: RobotDescription, joints: Sequence[str], payload: float, poses: int
) -> dict[str, tuple[float, float]]:
    """Return the least and the largest inertia that each joint's motor has to accelerate.

    It is 1 / (M^-1)_jj on a fixed base, rotors included; a wheel on the ground accelerates the
    robot as well, which is not in it.

    Args:
        description: The robot.
        joints: Joints asked for.
        payload: Largest payload in [kg]; the least is none.
        poses: Poses sampled within the joints' limits, for each payload.

    Raises:
        RobotDescriptionError: The robot lacks a joint, or has no link for the payload.
        SettingError: No pose, or an impossible payload.
    """
    names = list(dict.fromkeys(joints))
    ranges = [
        Dynamics(description, payload_mass=mass).inertia_range(names, poses, _SEED)
        for mass in sorted({0.0, payload})
    ]
    return {
        name: (min(each[name].minimum for each in ranges), max(e[name].maximum for e in ranges))
        for name in names
    }
