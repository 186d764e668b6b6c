"""Reference trajectories: sampling by joint_trajectory_controller's rules, and generators."""

from typing import TYPE_CHECKING

from hpid_ros.motion.joint_trajectory import (
    Column,
    JointTrajectory,
    Knot,
    ReferenceSample,
    SplineReference,
    TrajectoryPoint,
)

if TYPE_CHECKING:
    from hpid_ros.motion.base_path import BasePath
    from hpid_ros.motion.generators import combined, minimum_jerk, sine, step

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


def __getattr__(name: str) -> object:
    """Import what makes motions when it is asked for: a controller, which follows them, does not.

    Source: PEP 562.
    """
    if name == "BasePath":
        from hpid_ros.motion.base_path import BasePath

        return BasePath
    if name in ("combined", "minimum_jerk", "sine", "step"):
        from hpid_ros.motion import generators

        return getattr(generators, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
