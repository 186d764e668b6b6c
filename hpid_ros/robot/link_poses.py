"""Poses of all links of a robot at many instants, by forward kinematics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio

from hpid_ros.base.arrays import Numbers
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import bare_model, velocity_index
from hpid_ros.robot.kinematics import LinkPoses


def link_poses(
    description: RobotDescription, positions: Mapping[str, Numbers], count: int
) -> dict[str, LinkPoses]:
    """Return where each link is in the frame of the root link."""
    model = bare_model(description)
    data = model.createData()
    frames = {name: model.getFrameId(name) for name in description.links}
    motions = np.zeros((count, model.nv))
    for joint in description.select(positions):
        motions[:, velocity_index(model, joint.name)] = positions[joint.name]
    neutral = pinocchio.neutral(model)
    poses = {name: LinkPoses(np.empty((count, 3)), np.empty((count, 3, 3))) for name in frames}
    for k, motion in enumerate(motions):
        pinocchio.framesForwardKinematics(model, data, pinocchio.integrate(model, neutral, motion))
        for name, frame in frames.items():
            placement = data.oMf[frame]
            poses[name].positions[k] = placement.translation
            poses[name].rotations[k] = placement.rotation
    return poses
