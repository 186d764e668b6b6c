"""References that a controller takes, trajectories as messages, and introspection topics."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import HpidError, MessageError, TrajectoryError, reason_of
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import Motion, Setpoint
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import (
    TrajectoryArrays,
    decode_float64,
    decode_trajectory,
    named_joints,
)
from hpid_ros.messages.reports import decode_numbers
from hpid_ros.motion.joint_trajectory import Column
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import (
    LATCHED,
    OFFERED,
    RARE,
    declare_overrides,
    overridable,
)
from hpid_ros.nodes.core.parameters import read


def column_of(decoded: TrajectoryArrays, joint: str) -> Column | None:
    """Check a decoded message and return one joint's column."""
    if joint not in decoded.names:
        return None
    decoded.require()
    return decoded.column(joint)


TRAJECTORY = "joint_trajectory"

_COPIED_WITHIN = 2.0  # [s] a message comes by both subscriptions, if by both
_MATCHED_WITHIN = 10.0  # [s] a latched subscription that is new brings what there is
_COPIES = 64  # of what has come by one, to be known by the other
_WAITS = 0.05  # [s] what comes by the latched one alone, for the other


class TrajectorySubscriptions:
    """Takes ``joint_trajectory`` from latched and from volatile publishers alike.

    A subscription that asks for the latched message gets nothing at all from a volatile
    publisher (``ros2 topic pub``, rqt, MoveIt), whose log says so, and a volatile one gets
    nothing that was published before. So there is a volatile one, and from the first latched
    publisher on another one, which stays: made anew, it would bring old messages again.

    The volatile one brings all that is published from now on, in its order; the latched one may
    be ahead of it. So what comes by the latched one waits for a moment, and is taken where it
    does not come by the other, nor anything newer.
    """

    def __init__(
        self, node: ClosingNode, joint: str, take: Callable[[bytes, bool, bool], None]
    ) -> None:
        self._node, self._joint = node, joint
        # With whether it is latched, so perhaps from before the subscription, and can be read.
        self._take = take
        self._latched: Subscription | None = None
        self._latched_since = math.inf
        self._volatile_copies: deque[tuple[int, float]] = deque(maxlen=_COPIES)
        self._latched_copies: deque[tuple[int, float]] = deque(maxlen=_COPIES)
        self._waiting: dict[bool, tuple[bytes, float]] = {}  # by whether it can be read
        self._timer: threading.Timer | None = None
        # Only the latched one's profile may be overridden: both would have the same parameters.
        declare_overrides(node, TRAJECTORY, LATCHED)
        self._volatile = node.create_subscription(
            JointTrajectory,
            TRAJECTORY,
            self._on_volatile,
            RARE,  # not a depth of 1: one message of zero bytes would end what a reader gets
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(matched=lambda _: self.look()),
        )
        self.look()

    def discard(self) -> None:
        """Forget what waits: something newer has come, or nothing is taken any more."""
        self._waiting.clear()

    def close(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
        self.discard()
        for each in (self._volatile, self._latched):
            if each is not None:
                self._node.destroy_subscription(each)

    def look(self) -> None:
        """Ask latched publishers for what they had published before, from the first one on.

        To be called now and then: the graph may not show at once who is there.
        """
        if self._latched is not None or not any(
            each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            for each in self._node.get_publishers_info_by_topic(self._volatile.topic_name)
        ):
            return
        self._latched_since = time.monotonic()
        self._latched = self._node.create_subscription(
            JointTrajectory,
            TRAJECTORY,
            self._on_latched,
            LATCHED,
            raw=True,
            # Without rclpy's warning of publishers that are not latched: the other takes them.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=overridable(),
        )

    def _on_volatile(self, raw: bytes) -> None:
        is_readable = self._is_readable(raw)
        if is_readable is None:
            return
        self._waiting.pop(is_readable, None)  # it is older, or comes by this subscription, too
        now = time.monotonic()
        if _has_come(self._latched_copies, raw, now - _COPIED_WITHIN):
            return
        self._volatile_copies.append((hash(raw), now))
        self._take(raw, False, is_readable)

    def _on_latched(self, raw: bytes) -> None:
        is_readable = self._is_readable(raw)
        now = time.monotonic()
        is_new = now < self._latched_since + _MATCHED_WITHIN
        since = -math.inf if is_new else now - _COPIED_WITHIN
        if is_readable is None or _has_come(self._volatile_copies, raw, since):
            return
        self._waiting[is_readable] = raw, now
        self._wait()

    def _is_readable(self, raw: bytes) -> bool | None:
        """Tell whether a message can be read; None where it is about other joints.

        What others follow, as what nobody can read, replaces nothing that waits.
        """
        names = named_joints(raw)
        return None if names is not None and self._joint not in names else names is not None

    def _wait(self) -> None:
        if self._timer is None:
            self._timer = threading.Timer(_WAITS, self._node.hand_over, [self._take_waiting])
            self._timer.daemon = True
            self._timer.start()

    def _take_waiting(self) -> None:
        if self._timer is None:
            return  # closed meanwhile
        self._timer, now = None, time.monotonic()
        for is_readable, (raw, came_at) in list(self._waiting.items()):
            if now >= came_at + _WAITS:
                del self._waiting[is_readable]
                self._latched_copies.append((hash(raw), now))
                self._take(raw, True, is_readable)
        if self._waiting:
            self._wait()


def _has_come(copies: deque[tuple[int, float]], raw: bytes, since: float) -> bool:
    """Tell whether the other subscription has brought a message, and forget that it has."""
    key = hash(raw)
    for copy in copies:
        if copy[0] == key and copy[1] > since:
            copies.remove(copy)
            return True
    return False


Decoded = TrajectoryArrays | Exception
"""What became of a message; for instance a ``MessageError``."""


class ReferenceDecoder:
    """Decodes the newest message of each source on a thread of its own.

    A message that has not been begun with when the next one of its source comes is dropped, so
    that a flood costs one slot. What several sources have got alike is decoded once.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[object, tuple[bytes, Callable[[Decoded], None]]] = {}
        self._thread: threading.Thread | None = None

    def decode(self, source: object, raw: bytes, take: Callable[[Decoded], None]) -> None:
        with self._changed:
            self._waiting[source] = raw, take
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="references", daemon=True)
                self._thread.start()
            self._changed.notify()

    def _run(self) -> None:
        last: bytes | None = None
        decoded: Decoded
        while True:
            with self._changed:
                while not self._waiting:
                    self._changed.wait()
                raw, take = self._waiting.pop(next(iter(self._waiting)))
            if raw != last:
                last = raw
                try:
                    decoded = decode_trajectory(raw)
                except Exception as error:  # of any kind: the message is refused
                    decoded = error
            take(decoded)


reference_decoder = cache(ReferenceDecoder)
"""Returns the one of this process."""


class ControllerReferences:
    """Listens to ``joint_trajectory``, ``~/setpoint`` and ``~/relay``.

    A trajectory is decoded on another thread and handed back to the executor's, which alone
    calls what is given here. Of all references the one that came last is followed, however long
    they took to decode.
    """

    def __init__(
        self,
        node: ClosingNode,
        joint: str,
        follow: Callable[[Motion, bool], None],  # with whether it is a latched trajectory
        relay: Callable[[RelayRequest | None], None],
        refuse: Callable[[str], None],
        reason_against: Callable[[], str],
    ) -> None:
        self._node, self._joint = node, joint
        self._follow, self._relay = follow, relay
        self._refuse, self._reason_against = refuse, reason_against
        self._arrived = self._followed = self._discarded = 0  # references, in their order
        trajectories = TrajectorySubscriptions(node, joint, self._on_trajectory)
        setpoint = node.create_subscription(
            Float64, "~/setpoint", self._on_setpoint, RARE, raw=True
        )
        relays = node.create_subscription(
            Float64MultiArray, "~/relay", self._on_relay, RARE, raw=True
        )
        self._trajectories = trajectories
        self._subscriptions: list[Any] = [setpoint, relays]

    def look(self) -> None:
        """Look for latched publishers, as :meth:`TrajectorySubscriptions.look`."""
        self._trajectories.look()

    def discard(self) -> None:
        """Forget what is still being decoded."""
        self._discarded = self._arrived
        self._trajectories.discard()

    def close(self) -> None:
        self.discard()
        self._trajectories.close()
        for each in self._subscriptions:
            self._node.destroy_subscription(each)
        self._subscriptions = []

    def _on_trajectory(self, raw: bytes, is_latched: bool, is_readable: bool) -> None:
        self._arrived += 1
        take = partial(self._decoded, self._arrived, self._reason_against(), is_latched)
        guarded = self._node.guarded(TRAJECTORY, take)
        reference_decoder().decode((self, is_readable), raw, guarded)

    def _decoded(
        self, number: int, reason_against: str, is_latched: bool, decoded: Decoded
    ) -> None:
        """Take the joint's own column on the decoder's thread, and hand it to the executor's."""
        found: Motion | Exception | None
        try:
            found = decoded if isinstance(decoded, Exception) else column_of(decoded, self._joint)
        except Exception as error:
            found = error
        self._node.hand_over(self._take, number, reason_against, found, is_latched)

    def _take(
        self,
        number: int,
        reason_against: str,
        found: Motion | Exception | None,
        is_latched: bool = False,
    ) -> None:
        if number <= self._discarded or found is None:
            return
        if isinstance(found, Exception):
            self._refuse(reason_of(found))
        elif reason_against:
            self._refuse(reason_against)
        elif number > self._followed:
            try:
                self._follow(found, is_latched)
            except TrajectoryError as error:  # of another time
                self._refuse(str(error))
            else:
                self._followed = number

    def _on_setpoint(self, raw: bytes) -> None:
        self._trajectories.discard()
        self._arrived += 1
        found: Motion | HpidError
        try:
            found = Setpoint(decode_float64(raw))
        except HpidError as error:
            found = error
        self._take(self._arrived, self._reason_against(), found)

    def _on_relay(self, raw: bytes) -> None:
        """Take what is asked of a relay; a message without numbers ends one."""
        against = self._reason_against()
        try:
            numbers = decode_numbers(raw)
            if numbers and against:
                raise MessageError(against)
            self._relay(RelayRequest.from_message(numbers))
        except HpidError as error:
            self._refuse(str(error))


@dataclass(frozen=True)
class IntrospectionParameters(Record):
    """What is published for plots."""

    introspection_rate: float = quantity(
        "Rate of ~/reference, ~/terms and ~/estimate [Hz]; 0 is off, negative is every sample",
        default=20.0,
        least=-1e6,
        most=1e6,
    )


class Introspection:
    """Publishes the reference, the law's terms and the observer's estimate at a limited rate."""

    def __init__(self, node: Node, joint: str, has_model: bool = False) -> None:
        rate = read(node, IntrospectionParameters).introspection_rate
        self._period_ns = round(NANOSECONDS / rate) if rate > 0.0 else 0
        self._is_on = rate != 0.0
        self._has_model = has_model
        self._last_ns: int | None = None
        if not self._is_on:
            return
        profile = OFFERED if rate < 0.0 else RARE  # each sample: as many may wait as states may
        self._reference = node.create_publisher(JointState, "~/reference", profile)
        self._terms = node.create_publisher(JointState, "~/terms", profile)
        self._estimate = node.create_publisher(JointState, "~/estimate", profile)
        self._estimate_template = JointStateTemplate(
            [joint], position=True, velocity=True, effort=True
        )
        self._reference_template = JointStateTemplate([joint], position=True, velocity=True)
        names = ["p", "i", "d", *(["model"] if has_model else []), "feedforward"]
        self._terms_template = JointStateTemplate(names, effort=True)

    def sample(self, stamp_ns: int, loop: JointLoop) -> None:
        """Publish this sample if it is due on the control clock."""
        if not self._is_on:
            return
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._period_ns:
            return
        self._last_ns = stamp_ns
        position, velocity = loop.following.reference
        self._reference.publish(
            self._reference_template.encode(stamp_ns, position=(position,), velocity=(velocity,))
        )
        model = (loop.law.model_effort,) if self._has_model else ()
        terms = (*loop.law.terms, *model, loop.feedforward.effort)
        self._terms.publish(self._terms_template.encode(stamp_ns, effort=terms))
        estimate = loop.estimation.observer_state(loop.law.model_gain)
        if estimate is not None:
            place, rate, disturbance = estimate
            self._estimate.publish(
                self._estimate_template.encode(
                    stamp_ns, position=(place,), velocity=(rate,), effort=(disturbance,)
                )
            )
