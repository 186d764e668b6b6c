"""Offers the action FollowJointTrajectory over the controllers of many joints."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rclpy.parameter import Parameter
from rclpy.task import Future

from hpid_ros.base.names import controller_name
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.status import StatusPipe
from hpid_ros.nodes.parts.goal_follower import GoalFollower, Outcome
from hpid_ros.nodes.parts.goal_graph import (
    FollowerInputs,
    GoalHealth,
    GroupParameters,
    GroupTrajectoryPublisher,
)
from hpid_ros.nodes.parts.goal_server import GoalServer, action_type
from hpid_ros.nodes.parts.goals import (
    FIXED_PARAMETERS,
    GOAL_PARAMETERS,
    GoalError,
    GoalRequest,
    Result,
    joint_parameters,
)

_READINESS_PERIOD = 0.05  # [s]
_UNHEARD = "no controller listens to joint_trajectory"


class JointTrajectoryController(executor.ClosingNode):
    """The shell around one :class:`~hpid_ros.nodes.parts.goal_follower.GoalFollower`.

    Controllers follow trajectories by themselves: this node tells them, watches, and tells them to
    stop. Without it they go on to the last point of what they were told, and hold there.
    """

    def __init__(self, name: str = "joint_trajectory_controller") -> None:
        action_type()
        super().__init__(name)
        self._group = GroupParameters(self)
        self._follower = GoalFollower(self._group.settings())
        joints = self._group.joints
        self._health = GoalHealth(self, joints)
        self._told = GroupTrajectoryPublisher(
            self, joints, lambda: self._follower.is_active, self._give_way
        )
        self._inputs = FollowerInputs(
            self,
            self._follower,
            self._group.state_topics,
            {joint: f"{controller_name(joint)}/reference" for joint in joints},
            self._act,
            self._health.misread_message,
            self._stood_still,
        )
        self._server = GoalServer(self, self._begin, self._cancel, self._health.note)
        self._is_ready = False
        steady_timer(self, _READINESS_PERIOD, self._say_when_ready)
        rate = float(self.get_parameter("action_monitor_rate").value)
        steady_timer(self, 1.0 / rate, self._tell_feedback)
        steady_timer(self, self._health.period, self._report)
        self.add_on_set_parameters_callback(self._group.verdict)
        self.add_post_set_parameters_callback(self._change)
        StatusPipe(self).send("listening")

    def _begin(self, request: GoalRequest) -> Result | None:
        if not self._told.listeners():
            raise GoalError(_UNHEARD)
        begun = self._follower.begin(request)
        self._told.tell(begun.told)
        return begun.replaced

    def _cancel(self) -> None:
        self._act(self._follower.cancel())

    def _give_way(self, joints: Sequence[str]) -> None:
        self._act(self._follower.yield_joints(joints))

    def _act(self, outcome: Outcome | None) -> None:
        """Tell controllers and the client what follows from something."""
        if outcome is None:
            return
        if outcome.told is not None:
            self._told.tell(outcome.told)
        if outcome.result is not None:
            self._server.end(outcome.result)

    def _stood_still(self, stood: float) -> None:
        self._health.stood_still += 1
        self._health.fault(f"this process stood still for {stood:.3g} s")

    def _against(self) -> str:
        """Return why no goal can be followed now; empty if one can be."""
        if not self._told.listeners():
            return self._follower.reason_against() or _UNHEARD
        return self._follower.reason_against()

    def _say_when_ready(self) -> None:
        """Log once that goals can be followed, with the joints."""
        if self._is_ready or self._against():
            return
        self._is_ready = True
        joints = ", ".join(self._group.joints)
        self.get_logger().info(f"ready for goals on {self._server.name}: {joints}")

    def _tell_feedback(self) -> None:
        feedback = self._follower.feedback()
        if feedback is not None:
            self._server.tell(feedback, self._group.joints)

    def _change(self, changes: Sequence[Parameter]) -> None:
        self._follower.settings = self._group.settings()

    def _report(self) -> None:
        follower, told = self._follower, self._told
        warnings = []
        rivals = told.rivals()
        if rivals:
            warnings.append(f"{', '.join(sorted(rivals))} may send trajectories, too")
        silent = [
            joint
            for joint, has_told in zip(self._group.joints, self._inputs.has_told, strict=True)
            if not has_told
        ]
        against = self._against()
        if told.listeners() and silent:
            names = ", ".join(f"{controller_name(joint)}/reference" for joint in silent)
            warnings.append(f"nothing has come on {names}: whether they follow is not seen")
        feedback = follower.feedback()
        course = "no goal"
        if feedback is not None:
            course = f"following a goal for {feedback.since_start_ns * 1e-9:.3g} s"
        self._health.report(
            course,
            against,
            warnings,
            {
                "states that were not finite": follower.unusable,
                "goals rejected in a flood": self._server.rejected,
            },
        )

    def begin_stop(self) -> Future | None:
        """Stop the joints, and give every client its result."""
        self._act(self._follower.leave("the node ends"))
        return self._server.leave()

    def stop_now(self) -> None:
        """Stop the joints, if that has not been done."""
        self._act(self._follower.leave("the node ends"))

    def close(self) -> None:
        """Wait until the last trajectory has been heard."""
        self._server.close()
        self._told.wait_until_heard()


USAGE = Usage(
    "follow_joint_trajectory",
    "Offers the action FollowJointTrajectory over the controllers of many joints.",
    "-p joints:=[JOINT, ...] [-r __node:=NAME]",
    [
        "joints",
        "robot_description",
        "angle_wraparound",
        "multi_turn",
        "state_topics",
        *GOAL_PARAMETERS,
        *FIXED_PARAMETERS,
        *joint_parameters("*"),
        "status_fd",
    ],
    ["joint_states (or state_topics)", "joint_trajectory", "JOINT_controller/reference"],
    ["joint_trajectory", "/diagnostics"],
    ["~/follow_joint_trajectory (an action)"],
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the action server."""
    return executor.run(lambda: [JointTrajectoryController()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
