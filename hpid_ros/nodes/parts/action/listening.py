"""What a goal's follower hears: states, references, and the silence between them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from sensor_msgs.msg import JointState

from hpid_ros.base.errors import MessageError
from hpid_ros.goals import GoalFollower, Outcome
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.middleware import NEWEST_STATES, subscribe_raw
from hpid_ros.nodes.ros.steady_timer import steady_timer
from hpid_ros.wire import GroupReader, JointReader

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
            self._follower.excuse(stood)
            self._tell_standstill(stood)

    def _look_for_states(self) -> None:
        """Count for how long there has been no new state, while this process has run."""
        self._wake()
        if self._follower.now_ns != self._seen_ns:
            self._seen_ns, self._silence = self._follower.now_ns, 0.0
            return
        self._silence += self._look_period
        if self._silence > self._follower.settings.state_timeout:
            self._act(self._follower.lapse(self._silence))
