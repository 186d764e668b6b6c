"""The joints of a scene: put in their places, locked, and released."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.bullet import pybullet
from hpid_ros.simulation.rotors import ROTOR_SUFFIX, geared, rotor_name


def place_joints(
    client: int, body: int, joints: Mapping[str, int], start: Mapping[str, float]
) -> None:
    """Put every joint at its starting position, at rest, and its rotor at rest."""
    for name, position in start.items():
        pybullet.resetJointState(body, joints[name], position, 0.0, physicsClientId=client)
        rotor = joints.get(name + ROTOR_SUFFIX)
        if rotor is not None:
            pybullet.resetJointState(body, rotor, 0.0, 0.0, physicsClientId=client)


def release_joints(
    client: int, body: int, joints: Mapping[str, int], description: RobotDescription
) -> None:
    """Free every joint of Bullet's default motor and leave it with its own friction.

    Coulomb friction is a motor whose target speed is 0 and whose force is the friction's: an
    implicit constraint of the solver, so a joint sticks truly and cannot chatter about zero.
    """
    moving = description.joints.values()
    friction = {joint.name: joint.friction for joint in moving}
    friction.update({rotor_name(joint): 0.0 for joint in geared(moving)})
    indices = [joints[name] for name in friction]
    brake_joints(client, body, indices, list(friction.values()))
    for joint in moving:
        pybullet.changeDynamics(
            body, joints[joint.name], jointDamping=joint.damping, physicsClientId=client
        )


def brake_joints(client: int, body: int, indices: Sequence[int], forces: Sequence[float]) -> None:
    """Hold joints where they are, each with at most its force, in [N m]."""
    pybullet.setJointMotorControlArray(
        body,
        indices,
        pybullet.VELOCITY_CONTROL,
        targetVelocities=[0.0] * len(indices),
        forces=forces,
        physicsClientId=client,
    )
