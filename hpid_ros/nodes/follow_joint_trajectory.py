"""Offers the action FollowJointTrajectory over the controllers of many joints."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.names import controller_name
from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.parameters import declare, read
from hpid_ros.nodes.core.status import (
    ERROR,
    OK,
    WARN,
    Diagnostics,
    StatusParameters,
    StatusPipe,
    log_change,
)
from hpid_ros.nodes.core.waiting import Waiting
from hpid_ros.nodes.parts.goal_follower import CANCELLED, GoalFollower, Outcome
from hpid_ros.nodes.parts.goal_graph import GroupTopics
from hpid_ros.nodes.parts.goal_server import GoalServer, action_type
from hpid_ros.nodes.parts.goals import (
    FIXED_PARAMETERS,
    GOAL_PARAMETERS,
    GoalError,
    GoalRequest,
    GoalResult,
    GroupSettings,
    JointFacts,
    ResultCode,
    joint_parameters,
    require_joints,
)
from hpid_ros.robot.description import RobotDescription, robot_source

_READINESS_PERIOD = 0.05  # [s]
_UNHEARD = "no controller listens to joint_trajectory"


@dataclass(frozen=True)
class ActionParameters(Record):
    """The group of joints that follows goals."""

    joints: tuple[str, ...] | None = quantity(
        "Joints that follow goals, in the order of feedback", default=None
    )
    robot_description: str = quantity(
        "URDF of the robot, XML text or path: positions in which joints stop, and which of "
        "them turn without end",
        default="",
    )
    angle_wraparound: tuple[str, ...] | None = quantity(
        "Joints whose controllers have angle_wraparound", default=None
    )
    multi_turn: tuple[str, ...] | None = quantity(
        "Joints whose controllers have multi_turn", default=None
    )
    state_topics: tuple[str, ...] | None = quantity(
        "Topics that hold the states of the joints", default=None
    )


def joint_facts(
    joints: Sequence[str], source: str, wrapping: Sequence[str], counting: Sequence[str]
) -> dict[str, JointFacts]:
    require_joints(joints, wrapping, counting)
    facts = {joint: JointFacts() for joint in joints}
    if source:
        for joint in RobotDescription.load(robot_source(source)).select(joints):
            is_endless = joint.type == "continuous"
            facts[joint.name] = JointFacts(
                joint.lower,
                joint.upper,
                is_endless,
                takes_shorter_way=is_endless and joint.name not in counting,
                unit="m" if joint.type == "prismatic" else "rad",
            )
    for name in wrapping:
        facts[name] = facts[name]._replace(is_endless=True, takes_shorter_way=True)
    return facts


class GoalHealth(Diagnostics):
    """Counts goals and what could not be used."""

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        super().__init__(node, ", ".join(joints))
        self._logger = node.get_logger()
        self._counts: Counter[str] = Counter()
        self._last_result = ""

    def note(self, result: GoalResult) -> None:
        """Note how a goal ended, and log it where it did not succeed."""
        self._counts["cancelled" if result is CANCELLED else result.code.name.lower()] += 1
        self._last_result = result.text
        if result.code is ResultCode.SUCCESSFUL:
            log_change(self._node, f"goal ended: {result.text}")
            return
        self._last_result = f"{result.code.name.lower()}: {result.text}"
        self._logger.warning(f"goal ended: {self._last_result}", throttle_duration_sec=0.1)

    def readings(self) -> dict[str, object]:
        """Return the counts by name."""
        ends = [code.name.lower() for code in ResultCode if code is not ResultCode.SUCCESSFUL]
        return {
            "goals reached": self._counts["successful"],
            "goals cancelled": self._counts["cancelled"],
            **{f"goals ended by {end}": self._counts[end] for end in ends},
            "last goal": self._last_result or "none",
        }


class JointTrajectoryController(executor.ClosingNode):
    """The shell around one :class:`~hpid_ros.nodes.parts.goal_follower.GoalFollower`.

    Controllers follow trajectories by themselves: this node publishes them, watches, and publishes
    a stop. Without it they go on to the last point of their trajectory, and hold there.
    """

    def __init__(self, name: str = "joint_trajectory_controller") -> None:
        action_type()
        super().__init__(name)
        asked = read(self, ActionParameters)
        self._joints = joints = asked.joints or ()
        self._facts = joint_facts(
            joints, asked.robot_description, asked.angle_wraparound or (), asked.multi_turn or ()
        )
        topics = asked.state_topics or ("joint_states",)
        if len(set(topics)) < len(topics) or "" in topics:
            line = f"the parameter state_topics must name each topic once, not {list(topics)}"
            raise SettingError(line)
        self._specs = {**FIXED_PARAMETERS, **GOAL_PARAMETERS}
        for joint in joints:
            self._specs |= joint_parameters(joint)
        declare(self, self._specs.values(), read_only=FIXED_PARAMETERS)
        self._follower = GoalFollower(self._settings())
        self._health = GoalHealth(self, joints)
        self._topics = GroupTopics(
            self,
            self._follower,
            topics,
            {joint: f"{controller_name(joint)}/reference" for joint in joints},
            act=self._act,
            fault=self._health.fault,
            warn=self._health.warn,
            note_conflict=self._note_conflict,
        )
        self._server = GoalServer(
            self, self._begin, lambda: self._act(self._follower.cancel()), self._health.note
        )
        self._is_ready = False
        self._namesakes: list[str] = []
        self._waiting = Waiting(self)
        self._waiting.add(self._topics.awaited)
        self._waiting.add(self._topics.awaited_references)
        self._waiting.begin()
        steady_timer(self, _READINESS_PERIOD, self._log_when_ready)
        rate = float(self.get_parameter("action_monitor_rate").value)
        steady_timer(self, 1.0 / rate, self._send_feedback)
        steady_timer(self, 1.0, self._report)
        self.add_on_set_parameters_callback(self._verdict)
        self.add_post_set_parameters_callback(self._change)
        StatusPipe(self).send("listening")

    def _settings(self, changes: Sequence[Parameter] = ()) -> GroupSettings:
        """Return the settings that would be active after a change."""
        values = {name: self.get_parameter(name).value for name in self._specs}
        values.update({each.name: each.value for each in changes if each.name in values})
        return GroupSettings.from_parameters(self._joints, self._facts, values)

    def _verdict(self, changes: Sequence[Parameter]) -> SetParametersResult:
        try:
            self._settings(changes)
        except HpidError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _begin(self, request: GoalRequest) -> None:
        if not self._topics.subscribers():
            raise GoalError(_UNHEARD)
        self._act(self._follower.begin(request))

    def _act(self, outcome: Outcome | None) -> None:
        """Publish and answer what follows from something."""
        if outcome is None:
            return
        if outcome.trajectory is not None:
            self._topics.publish(outcome.trajectory)
        if outcome.result is not None:
            self._server.end(outcome.result)

    def _note_conflict(self, line: str) -> None:
        """Report at once that the states of a joint come from two sources, or from one again."""
        if line:
            self._health.error(line)
        else:
            self.get_logger().info("states come from one source again: goals can be followed")
        self._report()

    def _against(self) -> str:
        """Return why no goal can be followed now; empty if one can be."""
        against = self._follower.reason_against()
        return against or ("" if self._topics.subscribers() else _UNHEARD)

    def _log_when_ready(self) -> None:
        """Log once that goals can be followed, with the joints."""
        if self._is_ready or self._against():
            return
        self._is_ready = True
        joints = ", ".join(self._joints)
        self.get_logger().info(f"ready for goals on {self._server.name}: {joints}")

    def _send_feedback(self) -> None:
        feedback = self._follower.feedback()
        if feedback is not None:
            self._server.send_feedback(feedback, self._joints)

    def _change(self, changes: Sequence[Parameter]) -> None:
        self._follower.settings = self._settings()

    def _report(self) -> None:
        warnings = []
        namesakes = self._look_for_namesakes()
        if rivals := self._topics.rivals():
            warnings.append(f"{', '.join(sorted(rivals))} may send trajectories, too")
        silent = [
            joint
            for joint, has in zip(self._joints, self._topics.has_reference, strict=True)
            if not has
        ]
        if silent and self._topics.subscribers():
            names = ", ".join(f"{controller_name(joint)}/reference" for joint in silent)
            warnings.append(f"nothing has come on {names}: whether they follow is not seen")
        against, feedback = self._against(), self._follower.feedback()
        if against or silent:
            self._waiting.begin()
        course = f"no goal can be followed: {against}" if against else "no goal"
        if feedback is not None and not against:
            course = f"following a goal for {feedback.since_start_ns * 1e-9:.3g} s"
        self._health.publish(
            ERROR if against or namesakes else WARN if warnings else OK,
            "; ".join([course, *([namesakes] if namesakes else []), *warnings]),
            {
                **self._health.readings(),
                "refused messages": self._topics.misread,
                "times stood still": self._topics.stood_still,
                "states that were not finite": self._follower.unusable,
                "goals rejected in a flood": self._server.rejected,
                "last fault": self._health.last_fault,
            },
        )

    def _look_for_namesakes(self) -> str:
        """Return in a line which other servers take the same goals, and log it when it changes."""
        names = self._server.namesakes()
        line = ""
        if names:
            line = (
                f"another action server is called {self._server.name}, of {', '.join(names)}: "
                "each takes every goal, and clients get the answers of all"
            )
        if names != self._namesakes:
            self._namesakes = names
            if line:
                self._health.warn(line)
            else:
                self.get_logger().info(f"no other action server is called {self._server.name} now")
        return line

    def begin_stop(self) -> Future | None:
        """Stop the joints, and give every client its result."""
        self._act(self._follower.leave("the node ends"))
        return self._server.leave()

    def stop_now(self) -> None:
        """Stop the joints, if that has not been done."""
        self._act(self._follower.leave("the node ends"))

    def close(self) -> None:
        """Wait until the last trajectory has been acknowledged."""
        self._server.close()
        self._topics.wait_until_acknowledged()

    def destroy_node(self) -> None:
        """Destroy the node, and its action first."""
        if "_server" in vars(self):  # else it was refused while it was made
            self._server.destroy()
        super().destroy_node()


USAGE = Usage(
    "follow_joint_trajectory",
    "Offers the action FollowJointTrajectory over the controllers of many joints.",
    "-p joints:=[JOINT, ...] [-r __node:=NAME]",
    [
        *names_of(ActionParameters),
        *GOAL_PARAMETERS,
        *FIXED_PARAMETERS,
        *joint_parameters("*"),
        *names_of(StatusParameters),
    ],
    ["joint_states (or state_topics)", "joint_trajectory", "JOINT_controller/reference"],
    ["joint_trajectory", "/diagnostics"],
    ["~/follow_joint_trajectory (an action)"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [JointTrajectoryController()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
