"""Bricks and supports in Bullet."""

from __future__ import annotations

from collections.abc import Iterable

from hpid_ros.simulation.bullet.connection import pybullet
from hpid_ros.simulation.poses import Pose
from hpid_ros.simulation.world.workpieces import Brick, Support


def put_boxes(client: int, boxes: Iterable[Support]) -> tuple[int, ...]:
    """Put boxes into a simulation."""
    bodies = []
    for box in boxes:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[edge / 2.0 for edge in box.size],
            physicsClientId=client,
        )
        body = pybullet.createMultiBody(
            box.mass if isinstance(box, Brick) else 0.0,
            shape,
            basePosition=box.position,
            baseOrientation=box.orientation,
            physicsClientId=client,
        )
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=box.friction,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=client,
        )
        bodies.append(body)
    return tuple(bodies)


def let_hand_pass(client: int, robot: int, link: int, bricks: Iterable[int]) -> None:
    """Let a hand pass through bricks: it has no joint to put its fingers around them."""
    for index in _hand_links(client, robot, link):
        for brick in bricks:
            pybullet.setCollisionFilterPair(
                robot, brick, index, -1, enableCollision=0, physicsClientId=client
            )


def still(client: int, bodies: Iterable[int]) -> None:
    """Take away the speed of bodies."""
    nothing = (0.0, 0.0, 0.0)
    for body in bodies:
        pybullet.resetBaseVelocity(body, nothing, nothing, physicsClientId=client)


def box_pose(client: int, body: int) -> Pose:
    """Return where a box's centre is."""
    return Pose(*pybullet.getBasePositionAndOrientation(body, physicsClientId=client))


def _hand_links(client: int, robot: int, link: int) -> list[int]:
    """Return the links that are rigidly connected with a link, itself included."""
    infos = [
        pybullet.getJointInfo(robot, index, physicsClientId=client)
        for index in range(pybullet.getNumJoints(robot, physicsClientId=client))
    ]
    is_fixed = [info[2] == pybullet.JOINT_FIXED for info in infos]
    root = link
    while root >= 0 and is_fixed[root]:
        root = infos[root][16]
    hand = {root}
    for index, info in enumerate(infos):  # a parent comes before its children
        if is_fixed[index] and info[16] in hand:
            hand.add(index)
    return sorted(hand)
