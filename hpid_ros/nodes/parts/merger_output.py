"""A merger's output: messages for several joints, their receiver, and the stream that it gets."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future
from rclpy.timer import Timer

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.reports import decode_activity
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import (
    LATCHED,
    NEWEST_COMMAND,
    RARE,
    UNNAMED,
    full_name,
    held,
    overridable,
    steady_timer,
)
from hpid_ros.nodes.core.rclpy_internals import MatchCounter
from hpid_ros.nodes.parts.command_interfaces import COMMAND_INTERFACES, Template, message_type
from hpid_ros.nodes.parts.joint_topics import Sink
from hpid_ros.nodes.parts.merger import CommandMerger, Merged, MergerSettings, Receiver


class GroupOutput:
    """Publishes merged commands of the joints that were set last.

    One that is guarded publishes nothing from the moment in which the middleware knows of a
    subscription that has not been looked at yet: it may be a controller with other joints.
    """

    def __init__(
        self,
        node: Node,
        interface: str,
        topic: str,
        sender: str,
        is_guarded: bool,
        matched: Callable[[], None],
    ) -> None:
        self._node, self._interface, self._sender = node, COMMAND_INTERFACES[interface], sender
        self._template: Template | None = None
        self._scales: list[float] = []  # of the joints' efforts in the message
        self._last_ns = 0
        self.has_sent = False
        self.is_first = True  # whether a receiver is yet to get its first message
        self.sent = self.withheld = 0  # messages
        self.publisher = node.create_publisher(
            message_type(interface),
            topic or self._interface.merger_topic,
            NEWEST_COMMAND,
            qos_overriding_options=overridable(),
            event_callbacks=PublisherEventCallbacks(matched=lambda _: matched()),
        )
        self._counter = MatchCounter(self.publisher) if is_guarded else None
        self._count_known = partial(node.count_subscribers, self.publisher.topic_name)
        self._settled: tuple[int, int] | None = (0, 0)

    @property
    def matches(self) -> tuple[int, int] | None:
        """How many subscriptions it was ever matched with, and are known beyond its matches now.

        None where they changed meanwhile. Fast DDS puts one into the graph, then sends to it, and
        only then counts it as a match; each look may wait for it, until one subscription has taken
        another's place: so the matches are counted last, too.
        """
        if self._counter is None:
            return 0, 0
        ever, now = before = self._counter()
        known = self._count_known()
        return (ever, known - now) if self._counter() == before else None

    @property
    def is_settled(self) -> bool:
        """Whether all subscriptions have been looked at."""
        return self._settled is not None and self.matches == self._settled

    def settle(self, matches: tuple[int, int] | None) -> None:
        """Note that the subscriptions of these matches have been looked at, if they still are."""
        if self.matches == matches:
            self._settled = matches

    def set_joints(self, joints: Sequence[str]) -> None:
        """Send these joints from now on, in this order."""
        self._template = self._interface.template(joints, self._sender)
        self._scales = [self._interface.scale(self._node, each) for each in joints]

    def send(self, merged: Merged, *, is_last: bool = False) -> bool:
        """Publish a merged command, unless there is a subscription that was not looked at.

        One that is the last is not withheld: a joint that keeps its effort is worse than a
        controller that ends.
        """
        if self._template is None:
            return False
        numbers = [
            scale * effort for scale, effort in zip(self._scales, merged.efforts, strict=True)
        ]
        raw = self._template.encode(merged.stamp_ns, effort=numbers)
        # Asked at the end: a subscription may still match before the next line.
        if not is_last and not self.is_settled:
            self.withheld += 1
            return False
        self.publisher.publish(raw)
        self._last_ns = merged.stamp_ns
        self.has_sent, self.is_first = True, False
        self.sent += 1
        return True

    def zero(self, *, is_last: bool) -> bool:
        """Publish zeros if there is anything that they would end, and return whether they went."""
        zeros = Merged(self._last_ns, (0.0,) * len(self._scales))
        return self.has_sent and self.send(zeros, is_last=is_last)

    def destroy(self) -> None:
        """Let the middleware forget the publisher."""
        if self._counter:
            self._counter.destroy()

    def forget(self) -> None:
        """Start again: there is nothing that a zero would have to end."""
        self.has_sent, self.is_first = False, True


_LOOK_EVERY = 0.05  # [s]
_LOOK_AGAIN = 0.002  # [s], while it is not known whose a subscription is
_NAMED_WITHIN = 0.5  # [s]; then it is taken for the receiver's, which is asked again
_ANSWER_WITHIN = 1.0  # [s]; then it is asked again
_ASKED = ("joints", "interface_name")
_ACTIVITY = "Controllers Activity"  # of a manager's diagnostics
_STATE = ".state"


class ReceiverWatch:
    """Keeps what is known of a receiver up to date."""

    def __init__(
        self,
        node: Node,
        receiver: Receiver,
        output: GroupOutput,
        manager: str,
        changed: Callable[[], None],
    ) -> None:
        self._node, self._receiver, self._output = node, receiver, output
        self._changed = changed
        self._timers: list[Timer] = []
        self._served: frozenset[bytes] = frozenset()  # subscriptions that were sent something
        self._sent = 0
        self._nameless: dict[bytes, float] = {}  # subscriptions without a node, since when
        self._requests = 0
        self._is_asking = False
        self._asked_at = 0.0
        self._client: Any = None
        self._request: Future | None = None  # the last one, answered or not
        self.activity_topic = "nobody"
        """Where it is published whether the controller is active."""
        if receiver.name:
            self._client = node.create_client(GetParameters, f"{receiver.name}/get_parameters")
            self.activity_topic = _subscribe_to_activity(node, manager, self._note_states)

    def start(self) -> None:
        if not self._timers:
            self._timers = [
                steady_timer(self._node, every, self.look) for every in (_LOOK_EVERY, _LOOK_AGAIN)
            ]
            self._timers[1].cancel()

    def stop(self) -> None:
        while self._timers:
            self._node.destroy_timer(self._timers.pop())

    def look(self) -> None:
        """See who subscribes now, and ask a controller that is new for its joints."""
        if not self._timers:
            return
        matches = self._output.matches  # before the graph is asked, which knows of all of them
        endpoints, are_all_known = self._endpoints()
        if self._output.sent != self._sent:
            self._sent = self._output.sent
            self._served |= self._receiver.endpoints
        if endpoints and not endpoints & self._served:  # nothing that zeros would have to end
            self._output.forget()
            self._served = frozenset()
        if self._receiver.note_endpoints(endpoints):
            self._is_asking, self._output.is_first = False, True
            self._requests += 1  # who was asked before is not the one that is there now
        if self._receiver.must_be_asked:
            self._ask()
        self._changed()
        self._settle(matches, are_all_known)

    def _settle(self, matches: tuple[int, int] | None, are_all_known: bool) -> None:
        """Let the output go on once it is known whose all subscriptions are."""
        if are_all_known:
            self._output.settle(matches)
        if self._output.is_settled:
            self._timers[1].cancel()
        elif self._timers[1].is_canceled():
            self._timers[1].reset()

    def _endpoints(self) -> tuple[frozenset[bytes], bool]:
        """Return the receiver's subscriptions, and whether it is known whose the others are."""
        wanted, now = self._receiver.name, time.monotonic()
        found, nameless = set(), {}
        for info in self._node.get_subscriptions_info_by_topic(self._output.publisher.topic_name):
            endpoint = bytes(info.endpoint_gid)
            if not wanted or wanted == full_name(info):
                found.add(endpoint)
            elif info.node_name == UNNAMED:
                nameless[endpoint] = self._nameless.get(endpoint, now)
        self._nameless = nameless
        taken = {each for each, since in nameless.items() if now - since > _NAMED_WITHIN}
        return frozenset(found | taken), len(taken) == len(nameless)

    def _ask(self) -> None:
        if self._is_asking and time.monotonic() - self._asked_at < _ANSWER_WITHIN:
            return
        if not self._client.service_is_ready():
            return
        self._is_asking, self._asked_at = True, time.monotonic()
        self._requests += 1
        if self._request is not None:  # else the client keeps it until it is answered
            self._client.remove_pending_request(self._request)
        self._request = self._client.call_async(GetParameters.Request(names=list(_ASKED)))
        self._request.add_done_callback(partial(self._answered, self._requests))

    def _answered(self, number: int, future: Future) -> None:
        answer = future.result()
        if number != self._requests or answer is None:
            return
        self._is_asking = False
        values = [parameter_value_to_python(value) for value in answer.values]
        joints, interface = [*values, None, None][:2]
        self._receiver.note_joints(joints, interface)
        self._changed()

    def _note_states(self, states: Mapping[str, str]) -> None:
        self._receiver.note_state(states.get(self._receiver.name.rpartition("/")[2]))
        self._changed()


def _subscribe_to_activity(
    node: Node, manager: str, note: Callable[[Mapping[str, str]], None]
) -> str:
    """Subscribe to the states of a manager's controllers, and return the topic.

    Its topic of activity says so at once; where the package of that message is not installed, its
    diagnostics do, once a second.
    """
    try:
        from controller_manager_msgs.msg import ControllerManagerActivity
    except ImportError:
        names = {f"{manager}: {_ACTIVITY}"}
        if manager.count("/") == 1:  # of several managers with namespaces nobody knows which
            names.add(f"{manager[1:]}: {_ACTIVITY}")
        node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: _from_diagnostics(message, names, note),
            RARE,
        )
        return "/diagnostics"
    topic = f"{manager}/activity"
    node.create_subscription(
        ControllerManagerActivity,
        topic,
        lambda raw: note(decode_activity(raw)),
        LATCHED,
        raw=True,
    )
    return topic


def _from_diagnostics(
    message: DiagnosticArray, names: set[str], note: Callable[[Mapping[str, str]], None]
) -> None:
    for status in message.status:
        if status.name in names:
            note(
                {
                    pair.key.removesuffix(_STATE): pair.value
                    for pair in status.values
                    if pair.key.endswith(_STATE)
                }
            )


_BURST = 10  # zeros at once, where none may follow
_SHORTEST_WAIT_NS = 20_000  # of the timer
_CLOSE_ENOUGH = 0.05  # of two waits, for which the timer stays as it is


class MergedStream:
    """A merger with its clock, its timer and its output.

    What is sent is whole and in the order in which it was merged, whichever thread sends it. Where
    one is stuck with the lock, the supervisor's does without: its efforts are the safe ones.
    """

    def __init__(
        self,
        node: ClosingNode,
        output: GroupOutput,
        note_delay: Callable[[int], None],
        changed: Callable[[CommandMerger], None],
    ) -> None:
        self.merger: CommandMerger | None = None
        self.output = output
        self._node, self._note_delay, self._changed = node, note_delay, changed
        self._lock = threading.Lock()  # of the merger, and of the order of what is sent
        self._is_cut = False
        self._timer = steady_timer(node, 1.0, self._on_deadline, is_rearmed=True)
        self._timer.cancel()
        self._timer_ns = NANOSECONDS
        self._is_armed = False

    def begin(self, settings: MergerSettings) -> CommandMerger:
        merger = CommandMerger(settings, from_zero=self.output.is_first)
        with self._lock:
            self.output.set_joints(settings.names)
            self.merger = merger
        if self._node.supervisor is not None:
            self._node.supervisor.check_again()
        return merger

    def end(self) -> None:
        with self._lock:
            self.merger = None
        self._disarm()

    def sink(self, joint: str) -> Sink:
        """Return the sink of one joint's controller in the same process."""
        publisher = self.output.publisher
        return Sink(
            publisher,
            # There is no subscriber before the merger has a receiver.
            lambda: publisher.get_subscription_count() if self.merger is not None else 0,
            partial(self._take_on_any_thread, joint),
        )

    def _take_on_any_thread(self, joint: str, stamp_ns: int, effort: float) -> None:
        if threading.current_thread() is threading.main_thread():  # the executor's
            self.take(joint, stamp_ns, effort)
            return
        merger = self.merger  # the supervisor's thread: the executor may be stuck
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with held(self._lock):
            merged = merger.take(joint, stamp_ns, effort, now_ns) or merger.flush(now_ns)
            self._send(merged, merger, now_ns)

    def take(self, joint: str, stamp_ns: int, effort: float, *, is_signed: bool = True) -> None:
        """Take a command, on the executor's thread."""
        merger = self.merger
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with self._lock:
            returns = merger.returns
            merged = merger.take(joint, stamp_ns, effort, now_ns, is_signed=is_signed)
            self._send(merged, merger, now_ns)
            has_returned = merger.returns > returns
        self._arm(merger, now_ns)
        if has_returned:
            self._changed(merger)

    def zero(self, *, is_last: bool = False) -> bool:
        with held(self._lock):
            return self.output.zero(is_last=is_last)

    def _look(self, merger: CommandMerger, now_ns: int) -> None:
        """Publish what is due, which may answer nothing; only to be called by who has the lock."""
        has_come = merger.rounds.deadline_ns is not None
        self._send(merger.look(now_ns), merger, now_ns, is_answer=has_come)

    def _send(
        self,
        merged: Merged | None,
        merger: CommandMerger,
        now_ns: int,
        *,
        is_answer: bool = True,
    ) -> None:
        """Publish what is to be sent; only to be called by who has the lock."""
        if merged is None or merger is not self.merger or self._is_cut:
            return
        self.output.send(merged)
        if is_answer:
            self._note_delay(now_ns - merger.rounds.began_ns)

    def _arm(self, merger: CommandMerger, now_ns: int) -> None:
        """Have the timer look when what has come is due, if anything is."""
        deadline_ns = merger.rounds.deadline_ns if merger.has_begun else None
        if deadline_ns is None:
            self._disarm()
            return
        if self._is_armed:
            return
        wait_ns = max(deadline_ns - now_ns, _SHORTEST_WAIT_NS)
        if abs(wait_ns - self._timer_ns) > _CLOSE_ENOUGH * wait_ns:
            self._timer.timer_period_ns = self._timer_ns = wait_ns
        self._timer.reset()
        self._is_armed = True

    def _disarm(self) -> None:
        if self._is_armed:
            self._timer.cancel()
            self._is_armed = False

    def _on_deadline(self) -> None:
        self._disarm()
        merger = self.merger
        if merger is None:
            return
        now_ns = time.perf_counter_ns()
        with self._lock:
            self._look(merger, now_ns)
        self._arm(merger, now_ns)

    # What follows is called on the supervisor's thread, also while a callback does not return.

    def check(self) -> float:
        """Send the fallbacks of joints that have fallen silent, and what else is due."""
        merger = self.merger
        if merger is None:
            return math.inf
        now_ns = time.perf_counter_ns()
        with held(self._lock):
            silences = merger.silences
            self._look(merger, now_ns)
            has_changed = merger.silences > silences
            time_left = merger.time_left(now_ns)
        if has_changed:
            self._node.hand_over(self._changed, merger)
        return min(time_left, merger.shortest_timeout)  # a joint may come back at any time

    def cut(self) -> None:
        if not self._is_cut:
            self._is_cut = True
            for _ in range(_BURST):  # what is not known of a subscription is not waited for
                self.zero(is_last=True)

    def restore(self) -> None:
        """Merge again; the joints come back from zero."""
        merger = self.merger
        if merger is not None:
            with held(self._lock):
                merger.supersede(0.0, time.perf_counter_ns())
        self._is_cut = False
