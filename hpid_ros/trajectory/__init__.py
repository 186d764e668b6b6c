"""Reference trajectories: sampling by joint_trajectory_controller's rules, and generators."""

from hpid_ros.trajectory.base_path import BasePath, base_path
from hpid_ros.trajectory.combining import combined
from hpid_ros.trajectory.configuration import reference_from
from hpid_ros.trajectory.generators import minimum_jerk, sine, step
from hpid_ros.trajectory.joint_trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.trajectory.spline import Column, Knot, ReferenceSample, SplineReference

__all__ = [
    "BasePath",
    "Column",
    "JointTrajectory",
    "Knot",
    "ReferenceSample",
    "SplineReference",
    "TrajectoryPoint",
    "base_path",
    "combined",
    "minimum_jerk",
    "reference_from",
    "sine",
    "step",
]
