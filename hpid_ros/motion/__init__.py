"""Reference trajectories: sampling by joint_trajectory_controller's rules, and generators."""

from hpid_ros.motion.base_path import BasePath
from hpid_ros.motion.generators import combined, minimum_jerk, sine, step
from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    Knot,
    ReferenceSample,
    SplineReference,
    TrajectoryPoint,
)

__all__ = [
    "BasePath",
    "Column",
    "JointTrajectory",
    "Knot",
    "ReferenceSample",
    "SplineReference",
    "TrajectoryPoint",
    "combined",
    "minimum_jerk",
    "sine",
    "step",
]
