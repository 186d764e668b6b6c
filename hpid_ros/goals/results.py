"""How a goal ends: codes of FollowJointTrajectory, and the line that says why.

Source: ``control_msgs/action/FollowJointTrajectory``, the constants of its result.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from hpid_ros.base.errors import TrajectoryError


class ResultCode(IntEnum):
    """``error_code`` of a result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Result(NamedTuple):
    """How a goal ended."""

    code: ResultCode  # what a program looks at
    text: str  # what a person reads, one line


class GoalError(TrajectoryError):
    """A goal that is not obeyed."""

    def __init__(self, text: str, code: ResultCode = ResultCode.INVALID_GOAL) -> None:
        super().__init__(text)
        self.code = code

    @property
    def result(self) -> Result:
        """The result that its client gets."""
        return Result(self.code, str(self))
