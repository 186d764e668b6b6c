"""The action's part of the graph: parameters, health, trajectories published and received."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import HpidError, MessageError, SettingError
from hpid_ros.base.files import find_resource
from hpid_ros.messages.joint_state import GroupReader, JointReader
from hpid_ros.messages.joint_trajectory import encode_trajectory
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import (
    LATCHED,
    NEWEST_STATES,
    overridable,
    steady_timer,
    subscribe_raw,
)
from hpid_ros.nodes.core.process import declare, read_only
from hpid_ros.nodes.core.status import ERROR, OK, WARN, Diagnostics
from hpid_ros.nodes.parts.goal_follower import CANCELLED, GoalFollower, Outcome
from hpid_ros.nodes.parts.goals import (
    FIXED_PARAMETERS,
    GOAL_PARAMETERS,
    GroupSettings,
    GroupTrajectory,
    JointFacts,
    Result,
    ResultCode,
    joint_parameters,
    require_joints,
)
from hpid_ros.nodes.parts.references import (
    Decoded,
    TrajectorySubscriptions,
    column_of,
    reference_decoder,
)
from hpid_ros.robot.description import RobotDescription


class GroupParameters:
    """Makes of a node's parameters the settings of its group."""

    def __init__(self, node: Node) -> None:
        self._node = node
        names = Parameter.Type.STRING_ARRAY
        self.joints = tuple(
            read_only(node, "joints", names, "Joints that follow goals, in the order of feedback")
            or ()
        )
        require_joints(self.joints)
        wrapping = read_only(
            node, "angle_wraparound", names, "Joints whose controllers have angle_wraparound"
        )
        counting = read_only(node, "multi_turn", names, "Joints whose controllers have multi_turn")
        self.state_topics = tuple(
            read_only(node, "state_topics", names, "Topics that hold the states of the joints")
            or ("joint_states",)
        )
        if len(set(self.state_topics)) < len(self.state_topics) or "" in self.state_topics:
            raise SettingError(
                f"the parameter state_topics must name each topic once, not "
                f"{list(self.state_topics)}"
            )
        source = read_only(
            node,
            "robot_description",
            "",
            "URDF of the robot, XML text or path: positions in which joints stop, and which of "
            "them turn without end",
        )
        self._facts = joint_facts(self.joints, str(source), wrapping or (), counting or ())
        specs = {**FIXED_PARAMETERS, **GOAL_PARAMETERS}
        for joint in self.joints:
            specs |= joint_parameters(joint)
        self._names = tuple(specs)
        declare(node, specs.values(), read_only=FIXED_PARAMETERS)
        self.settings()

    def settings(self, changes: Sequence[Parameter] = ()) -> GroupSettings:
        """Return the settings that would be active after a change."""
        values = {name: self._node.get_parameter(name).value for name in self._names}
        values.update({each.name: each.value for each in changes if each.name in values})
        return GroupSettings.from_parameters(self.joints, self._facts, values)

    def verdict(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Say whether a change can be applied."""
        try:
            self.settings(changes)
        except HpidError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def joint_facts(
    joints: Sequence[str], source: str, wrapping: Sequence[str], counting: Sequence[str]
) -> dict[str, JointFacts]:
    """Return what is known of joints."""
    require_joints(joints, wrapping, counting)
    facts = {joint: JointFacts() for joint in joints}
    if source:
        path = source if source.lstrip().startswith("<") else str(find_resource(source))
        for joint in RobotDescription.load(path).select(joints):
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


class GoalHealth:
    """Counts goals and what could not be used, and publishes the status."""

    period = 1.0

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._node = node
        self._diagnostics = Diagnostics(node, ", ".join(joints))
        self.fault = self._diagnostics.fault
        self._counts: Counter[str] = Counter()
        self.misread = self.stood_still = 0
        self._last_result = ""

    def note(self, result: Result) -> None:
        """Note how a goal ended, and log it where it did not succeed."""
        self._counts["cancelled" if result is CANCELLED else result.code.name.lower()] += 1
        self._last_result = result.text
        logger = self._node.get_logger()
        if result.code is ResultCode.SUCCESSFUL:
            logger.info(f"goal ended: {result.text}")
            return
        self._last_result = f"{result.code.name.lower()}: {result.text}"
        logger.warning(f"goal ended: {self._last_result}", throttle_duration_sec=0.1)

    def misread_message(self, line: str) -> None:
        """Note bytes that could not be read."""
        self.misread += 1
        self.fault(line)

    def report(
        self, course: str, against: str, warnings: Sequence[str], values: dict[str, object]
    ) -> None:
        """Publish the status now."""
        level = ERROR if against else WARN if warnings else OK
        self._diagnostics.publish(
            level,
            "; ".join([f"no goal can be followed: {against}" if against else course, *warnings]),
            {
                "goals reached": self._counts["successful"],
                "goals cancelled": self._counts["cancelled"],
                **{
                    f"goals ended by {code.name.lower()}": self._counts[code.name.lower()]
                    for code in ResultCode
                    if code is not ResultCode.SUCCESSFUL
                },
                "last goal": self._last_result or "none",
                "refused messages": self.misread,
                "times stood still": self.stood_still,
                **values,
                "last fault": self._diagnostics.last_fault,
            },
        )


_LOOKS = 10  # for the states, in each state_timeout
_STOOD_STILL = 0.25  # [s] without a look; an executor that is merely busy is faster


class FollowerInputs:
    """Gives a follower the states and references of its joints, and tells it of silence."""

    def __init__(
        self,
        node: ClosingNode,
        follower: GoalFollower,
        state_topics: Sequence[str],
        references: Mapping[str, str],
        act: Callable[[Outcome | None], None],
        misread: Callable[[str], None],
        stood_still: Callable[[float], None],
    ) -> None:
        self._follower, self._act = follower, act
        self._misread, self._tell_standstill = misread, stood_still
        self._reader = GroupReader(tuple(references))
        for topic in state_topics:
            subscribe_raw(node, topic, self._on_state, NEWEST_STATES)
        self.has_told = [False] * len(references)
        for number, (joint, topic) in enumerate(references.items()):
            take = partial(self._on_reference, number, JointReader(joint))
            node.create_subscription(JointState, topic, take, NEWEST_STATES, raw=True)
        self._silence, self._seen_ns = 0.0, follower.now_ns
        self._looked_at = time.monotonic()
        self._look_period = follower.settings.state_timeout / _LOOKS
        steady_timer(node, self._look_period, self._look_for_states)

    def _on_state(self, raw: bytes) -> None:
        self._wake()
        try:
            stamp_ns, parts = self._reader.read(raw)
        except MessageError as error:
            self._misread(f"state refused: {error}")
            return
        if parts:
            self._act(self._follower.take_state(stamp_ns, parts))

    def _on_reference(self, joint: int, reader: JointReader, raw: bytes) -> None:
        self._wake()
        try:
            sample = reader.read(raw)
        except MessageError as error:
            self._misread(f"reference refused: {error}")
            return
        if sample is not None:
            self.has_told[joint] = True
            self._act(self._follower.take_reference(joint, sample.stamp_ns, sample.position))

    def _wake(self) -> None:
        """Notice that the process has stood still: what is waiting for it is old."""
        now = time.monotonic()
        stood, self._looked_at = now - self._looked_at, now
        if stood > self._look_period + _STOOD_STILL:
            self._follower.allow_late(stood)
            self._tell_standstill(stood)

    def _look_for_states(self) -> None:
        """Count for how long there has been no new state, while this process has run."""
        self._wake()
        if self._follower.now_ns != self._seen_ns:
            self._seen_ns, self._silence = self._follower.now_ns, 0.0
            return
        self._silence += self._look_period
        if self._silence > self._follower.settings.state_timeout:
            self._act(self._follower.note_timeout(self._silence))


_OWN_KEPT = 16  # messages that may be on their way back
_HEARD_WITHIN = Duration(seconds=0.5)


class GroupTrajectoryPublisher:
    """Tells controllers trajectories, and hears what others tell them."""

    def __init__(
        self,
        node: ClosingNode,
        joints: Sequence[str],
        is_listening: Callable[[], bool],
        yield_joints: Callable[[Sequence[str]], None],
    ) -> None:
        self._node, self._joints = node, joints
        self._is_listening, self._give_way = is_listening, yield_joints
        self._own: deque[bytes] = deque(maxlen=_OWN_KEPT)
        self._sent = 0
        self._publisher = node.create_publisher(
            JointTrajectory, "joint_trajectory", LATCHED, qos_overriding_options=overridable()
        )
        TrajectorySubscriptions(node, self._on_trajectory)

    def tell(self, told: GroupTrajectory) -> None:
        """Publish a trajectory, latched."""
        raw = encode_trajectory(told.stamp_ns, told.names, told.times_ns, told.arrays)
        self._own.append(raw)
        self._sent += 1
        self._publisher.publish(raw)

    def wait_until_heard(self) -> None:
        """Wait until every controller has acknowledged the last trajectory, for a while."""
        if self._sent and not self._publisher.wait_for_all_acked(_HEARD_WITHIN):
            self._node.get_logger().warning(
                "the last trajectory was not acknowledged by every subscriber within "
                f"{_HEARD_WITHIN.nanoseconds * 1e-9:g} s"
            )

    def listeners(self) -> set[str]:
        """Return full names of the other nodes that hear trajectories."""
        return self._others(self._node.get_subscriptions_info_by_topic)

    def rivals(self) -> set[str]:
        """Return full names of the other nodes that may tell trajectories."""
        return self._others(self._node.get_publishers_info_by_topic)

    def _others(self, infos: Callable[..., Sequence[object]]) -> set[str]:
        names = {
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"  # type: ignore[attr-defined]
            for info in infos(self._publisher.topic_name)
        }
        return names - {self._node.get_fully_qualified_name()}

    def _on_trajectory(self, raw: bytes) -> None:
        if raw in self._own or not self._is_listening():
            return
        reference_decoder().decode(self, raw, partial(self._decoded, self._sent))

    def _decoded(self, sent: int, decoded: Decoded) -> None:
        """Find out, on the decoder's thread, whose joints follow this."""
        if isinstance(decoded, Exception):
            return  # no controller follows what cannot be read
        named = [joint for joint in self._joints if joint in decoded.names]
        try:
            is_followed = bool(named) and column_of(decoded, named[0]) is not None
        except HpidError:
            return
        if is_followed:
            self._node.hand_over(self._heard, sent, named)

    def _heard(self, sent: int, named: Sequence[str]) -> None:
        if sent == self._sent:  # else controllers have been told something newer since
            self._give_way(named)
