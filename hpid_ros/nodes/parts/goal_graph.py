"""A follower's topics: states and references in, trajectories out, and those of other nodes."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import HpidError, MessageError
from hpid_ros.messages.joint_state import GroupReader, JointReader
from hpid_ros.messages.joint_trajectory import encode_trajectory, named_joints
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import (
    LATCHED,
    NEWEST_REFERENCE,
    NEWEST_STATES,
    RARE,
    full_name,
    overridable,
    steady_timer,
    subscribe_raw,
    wait_until_acknowledged,
)
from hpid_ros.nodes.core.waiting import (
    PUBLISHER,
    SeenJoints,
    Wait,
    described,
    fits,
    other_side,
    topic_view,
    unseen,
)
from hpid_ros.nodes.parts.goal_follower import GoalFollower, Outcome
from hpid_ros.nodes.parts.goals import GroupTrajectory
from hpid_ros.nodes.parts.references import (
    Decoded,
    column_of,
    reference_decoder,
)

_LOOKS = 10  # for the states, in each state_timeout
_STOOD_STILL = 0.25  # [s] without a look; an executor that is merely busy is faster
_TOPIC = "joint_trajectory"
_OWN_KEPT = 16  # messages that may be on their way back


class GroupTopics:
    """Gives a follower the states and references of its joints, and publishes trajectories.

    It notes how long there were no states, and yields joints to trajectories of other nodes.
    """

    def __init__(
        self,
        node: ClosingNode,
        follower: GoalFollower,
        state_topics: Sequence[str],
        references: Mapping[str, str],
        *,
        act: Callable[[Outcome | None], None],
        fault: Callable[[str], None],
        warn: Callable[[str], None],
        note_conflict: Callable[[str], None],
    ) -> None:
        self._node, self._follower, self._act = node, follower, act
        self._fault, self._warn = fault, warn
        self._note_conflict, self._has_conflict = note_conflict, False
        self.misread = self.stood_still = 0
        self._own: deque[bytes] = deque(maxlen=_OWN_KEPT)
        self._sent = 0
        self._publisher = node.create_publisher(
            JointTrajectory, _TOPIC, LATCHED, qos_overriding_options=overridable()
        )
        # A latched message may be from long before, and comes when its publisher is found: not
        # what the joints follow now. The volatile subscription gets what is sent from now on;
        # what it missed, as its sender was found late, shows in the controllers' references.
        node.create_subscription(JointTrajectory, _TOPIC, self._on_trajectory, RARE, raw=True)
        self._reader = GroupReader(tuple(references))
        self._states = [
            subscribe_raw(node, topic, self._on_state, NEWEST_STATES) for topic in state_topics
        ]
        self._seen = SeenJoints()
        self.has_reference = [False] * len(references)
        for number, (joint, topic) in enumerate(references.items()):
            take = partial(self._on_reference, number, JointReader(joint))
            node.create_subscription(JointState, topic, take, NEWEST_REFERENCE, raw=True)
        self._references = [node.resolve_topic_name(topic) for topic in references.values()]
        self._silence, self._seen_ns, self._standstill = 0.0, follower.now_ns, ""
        self._looked_at = time.monotonic()
        self._look_period = follower.settings.fixed.state_timeout / _LOOKS
        steady_timer(node, self._look_period, self._look_for_states)

    def awaited(self) -> Wait | None:
        """Return what goals cannot be followed without, for the log."""
        unseen_joints = self._follower.unseen
        if unseen_joints:
            topics = ", ".join(each.topic_name for each in self._states)
            return Wait("states", "come", topics, self._states_found, unseen_joints)
        if not self.subscribers():
            topic = self._publisher.topic_name
            return Wait("a controller", "is there", topic, self._subscribers_found)
        return None

    def awaited_references(self) -> Wait | None:
        """Return what goals are followed unwatched without, for the log."""
        joints = self._follower.settings.joints
        silent = [joint for joint, has in zip(joints, self.has_reference, strict=True) if not has]
        if not silent or self._follower.unseen or not self.subscribers():
            return None
        what = "the controllers' references"
        return Wait(what, "come", "", self._references_found, tuple(silent))

    def _states_found(self, joints: Sequence[str]) -> str:
        views = [other_side(self._node, states) for states in self._states]
        parts = [described(view) for view in views]
        others = unseen(joints, self._seen.names())
        if not others and any(map(fits, views)):
            others = "nothing of these joints has come"
        return "; ".join([*parts, *([others] if others else [])])

    def _subscribers_found(self, joints: Sequence[str]) -> str:
        return described(other_side(self._node, self._publisher))

    def _references_found(self, joints: Sequence[str]) -> str:
        """Describe the first topic on which nothing has come: that of the others is alike."""
        topic = self._references[self.has_reference.index(False)]
        view = topic_view(self._node, topic, PUBLISHER, JointState, NEWEST_REFERENCE)
        return f"{described(view)}; until they come it is not seen whether joints follow"

    def publish(self, trajectory: GroupTrajectory) -> None:
        raw = encode_trajectory(
            trajectory.stamp_ns, trajectory.names, trajectory.times_ns, trajectory.arrays
        )
        self._own.append(raw)
        self._sent += 1
        self._publisher.publish(raw)

    def wait_until_acknowledged(self) -> None:
        """Wait until every controller has acknowledged the last trajectory, for a while."""
        if self._sent:
            wait_until_acknowledged(self._node, self._publisher, "the last trajectory")

    def subscribers(self) -> set[str]:
        """Return full names of the other nodes that subscribe to trajectories."""
        topic = self._publisher.topic_name
        return self._others(self._node.get_subscriptions_info_by_topic(topic))

    def rivals(self) -> set[str]:
        """Return full names of the other nodes that may publish trajectories."""
        topic = self._publisher.topic_name
        return self._others(self._node.get_publishers_info_by_topic(topic))

    def _others(self, endpoints: Iterable[TopicEndpointInfo]) -> set[str]:
        return set(map(full_name, endpoints)) - {self._node.get_fully_qualified_name()}

    def _on_trajectory(self, raw: bytes) -> None:
        if raw in self._own:
            return
        names, own = named_joints(raw), self._follower.settings.joints
        named = tuple(joint for joint in own if names is None or joint in names)
        if named:
            take = self._node.guarded(_TOPIC, partial(self._decoded, self._sent, named))
            reference_decoder().decode((self, named), raw, take)

    def _decoded(self, sent: int, named: Sequence[str], decoded: Decoded) -> None:
        """Find out, on the decoder's thread, whether the joints follow this."""
        if isinstance(decoded, Exception):
            return  # no controller follows what cannot be read
        with contextlib.suppress(HpidError):
            column = column_of(decoded, named[0])
            if column is not None:
                self._node.hand_over(self._yield, sent, named, column.window_ns)

    def _yield(self, sent: int, named: Sequence[str], window_ns: tuple[int, int] | None) -> None:
        if sent == self._sent:  # else controllers have been sent something newer since
            self._act(self._follower.yield_joints(named, window_ns))

    def _on_state(self, raw: bytes) -> None:
        self._wake()
        try:
            stamp_ns, parts = self._reader.read(raw)
        except MessageError as error:
            self._refuse(f"state refused: {error}")
            return
        if len(parts) < len(self._reader.joints):
            self._seen.newest = raw
        if parts:
            missed = self._follower.misses
            self._act(self._follower.take_state(stamp_ns, parts))
            if bool(conflict := self._follower.conflict) is not self._has_conflict:
                self._has_conflict = not self._has_conflict
                self._note_conflict(conflict)
            if self._follower.misses and not missed:  # the executor's queue is first in, first out
                self._node.hand_over(self._confirm)

    def _confirm(self) -> None:
        self._wake()
        self._act(self._follower.confirm())

    def _on_reference(self, joint: int, reader: JointReader, raw: bytes) -> None:
        self._wake()
        try:
            sample = reader.read(raw)
        except MessageError as error:
            self._refuse(f"reference refused: {error}")
            return
        if sample is not None:
            self.has_reference[joint] = True
            self._act(self._follower.take_reference(joint, sample.stamp_ns, sample.position))

    def _refuse(self, line: str) -> None:
        self.misread += 1
        self._fault(line)

    def _wake(self) -> None:
        """Notice that the process has stood still: what is waiting for it is old."""
        now = time.monotonic()
        stood, self._looked_at = now - self._looked_at, now
        if stood > self._look_period + _STOOD_STILL:
            self._follower.allow_late(stood)
            self.stood_still += 1
            self._fault(f"this process stood still for {stood:.3g} s")

    def _look_for_states(self) -> None:
        """Count for how long there has been no new state, while this process has run."""
        self._wake()
        if self._follower.now_ns != self._seen_ns:
            self._seen_ns, self._silence, self._standstill = self._follower.now_ns, 0.0, ""
            return
        self._silence += self._look_period
        if self._silence > self._follower.settings.fixed.state_timeout:
            self._act(self._follower.note_timeout(self._silence))
            before, self._standstill = self._standstill, self._follower.standstill
            if self._standstill and not before:
                self._warn(self._standstill)
