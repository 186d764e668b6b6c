"""Poses and twists of links, asked of Bullet."""

from __future__ import annotations

from hpid_ros.simulation.bullet.connection import pybullet
from hpid_ros.simulation.poses import Pose, Twist

ROOT = -1  # Bullet's index of a robot's root link


def link_pose(client: int, body: int, index: int) -> Pose:
    """Return the pose of a link's URDF frame.

    Args:
        client: PyBullet's client.
        body: The robot.
        index: Bullet's index of the link; -1 is the root.
    """
    if index != ROOT:
        state = pybullet.getLinkState(body, index, physicsClientId=client)
        return Pose(state[4], state[5])
    # Of the root Bullet gives the principal frame at the centre of mass.
    centre = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    inertial = pybullet.getDynamicsInfo(body, ROOT, physicsClientId=client)[3:5]
    frame = pybullet.invertTransform(*inertial, physicsClientId=client)
    return Pose(*pybullet.multiplyTransforms(*centre, *frame, physicsClientId=client))


def centre_of_mass(client: int, body: int, index: int) -> tuple[float, float, float]:
    """Return a link's centre of mass in the world, in [m]."""
    if index == ROOT:
        return pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0]
    return pybullet.getLinkState(body, index, physicsClientId=client)[0]


def root_twist(client: int, body: int) -> Twist:
    """Return the velocity of the root link's frame."""
    origin, orientation = link_pose(client, body, ROOT)
    centre = centre_of_mass(client, body, ROOT)
    (vx, vy, vz), angular = pybullet.getBaseVelocity(body, physicsClientId=client)
    wx, wy, wz = angular
    x, y, z = (a - b for a, b in zip(origin, centre, strict=True))
    linear = (vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x)
    _, inverse = pybullet.invertTransform((0.0, 0.0, 0.0), orientation, physicsClientId=client)
    return Twist(
        pybullet.rotateVector(inverse, linear, physicsClientId=client),
        pybullet.rotateVector(inverse, angular, physicsClientId=client),
    )
