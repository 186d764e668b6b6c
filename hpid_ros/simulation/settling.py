"""Setting down what was loaded: the robot on its tyres, the bricks on their supports."""

from __future__ import annotations

import math
from collections.abc import Collection

from hpid_ros.errors import SettingError
from hpid_ros.simulation.boxes import box_pose, still
from hpid_ros.simulation.bricks import Workplace
from hpid_ros.simulation.bullet import pybullet
from hpid_ros.simulation.scene_joints import brake_joints

GROUND_FRICTION = 1.0  # Bullet multiplies the two surfaces' coefficients: the robot's decides
SETTLING_TIME = 0.25  # [s]
LOCK_FORCE = 1e6  # [N m]
STAYING = 0.005  # [m], how far a brick may be from where it is put when it has settled
NEARBY = 1e3  # [m], how far the robot may be from the ground before it is put down


def put_on_ground(client: int, body: int) -> None:
    """Make the ground, and set the robot down so that its lowest point touches it."""
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    ground = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
    pybullet.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION, physicsClientId=client)
    near = pybullet.getClosestPoints(body, ground, NEARBY, physicsClientId=client)
    if not near:
        return  # a robot without collision shapes falls, wherever it starts
    gap = min(point[8] for point in near)
    position, orientation = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    lowered = (position[0], position[1], position[2] - gap)
    pybullet.resetBasePositionAndOrientation(body, lowered, orientation, physicsClientId=client)


def settle(client: int, body: int, joints: Collection[int], physics_period: float) -> None:
    """Let the robot sink into its tyres with every joint locked, then take away all speed."""
    brake_joints(client, body, list(joints), [LOCK_FORCE] * len(joints))
    for _ in range(max(1, round(SETTLING_TIME / physics_period))):
        pybullet.stepSimulation(physicsClientId=client)
    rest = (0.0, 0.0, 0.0)
    pybullet.resetBaseVelocity(body, rest, rest, physicsClientId=client)


def settle_bricks(client: int, bricks: tuple[int, ...], workplace: Workplace) -> None:
    """Take away what speed the bricks have left, and refuse those that fell or were pushed."""
    still(client, bricks)
    for body, brick in zip(bricks, workplace.bricks, strict=True):
        moved = math.dist(box_pose(client, body).position, brick.position)
        if moved > STAYING:
            raise SettingError(
                f"brick {brick.name!r} does not stay at {list(brick.position)} m: it moves by "
                f"{moved:.3g} m in {SETTLING_TIME:g} s; put it on a support, and into nothing"
            )
