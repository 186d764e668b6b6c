"""Inertias that the motors of an experiment's robot accelerate where it starts."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics


def initial_inertias(
    experiment: Experiment, loops: Sequence[LoopSettings] = ()
) -> dict[str, float]:
    """Return the effective inertia of every driven joint in the initial pose.

    An arm's joint has 1 / (M^-1)_jj on a base that is held, a wheel of a base that of the robot
    that rolls on it with its arm held, with the payload that the experiment begins with.
    """
    from hpid_ros.robot.dynamics import wheel_inertias

    world = experiment.world
    description = RobotDescription.load(world.robot_description)
    payload = world.payload_mass, world.payload_link
    held = Dynamics(description, True, *payload)
    inertias = held.joint_inertias(world.joints, world.initial_positions)
    if world.base is not None and not world.fixed_base:
        inertias |= wheel_inertias(description, world.base, world.initial_positions, *payload)
    return inertias | {each.joint: 1.0 for each in loops if each.model.is_decoupling}
