"""Goals of FollowJointTrajectory over decentralised joint controllers, without ROS."""

from hpid_ros.goals.active_goal import Feedback
from hpid_ros.goals.follower import CANCELLED, Begun, GoalFollower, Outcome
from hpid_ros.goals.results import GoalError, Result, ResultCode
from hpid_ros.goals.settings import (
    FIXED_PARAMETERS,
    GOAL_PARAMETERS,
    GroupSettings,
    JointFacts,
    joint_parameters,
    require_joints,
)
from hpid_ros.goals.tolerances import AskedTolerance, Tolerance, Tolerances
from hpid_ros.goals.trajectories import GoalRequest, GroupTrajectory

__all__ = [
    "CANCELLED",
    "FIXED_PARAMETERS",
    "GOAL_PARAMETERS",
    "AskedTolerance",
    "Begun",
    "Feedback",
    "GoalError",
    "GoalFollower",
    "GoalRequest",
    "GroupSettings",
    "GroupTrajectory",
    "JointFacts",
    "Outcome",
    "Result",
    "ResultCode",
    "Tolerance",
    "Tolerances",
    "joint_parameters",
    "require_joints",
]
