"""Tasks turned into references: the brick task of the paper's robot.

:mod:`~hpid_ros.planning.bricks` does the planning; it is imported by name, and by the section
when there is such a task, since it needs Pinocchio.
"""

from hpid_ros.planning.configuration import PlannedReference, planned_reference, reference_from
from hpid_ros.planning.plan import (
    BrickGoal,
    BrickPlan,
    Grip,
    Placement,
    PlanOptions,
    TaskPose,
    TaskRobot,
)

__all__ = [
    "BrickGoal",
    "BrickPlan",
    "Grip",
    "Placement",
    "PlanOptions",
    "PlannedReference",
    "TaskPose",
    "TaskRobot",
    "planned_reference",
    "reference_from",
]
