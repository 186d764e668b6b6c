"""Robots: the record of a URDF, and the rigid-body dynamics that follow from it.

:mod:`~hpid_ros.robot.description` needs the standard library only;
:mod:`~hpid_ros.robot.dynamics` is the only importer of Pinocchio and is imported by name.
"""

from hpid_ros.robot.description import JointDescription, RobotDescription

__all__ = ["JointDescription", "RobotDescription"]
