"""A merger's streams of commands, who receives its own, and its health."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future
from rclpy.timer import Timer

from hpid_ros.base.durations import Durations
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import LATCHED, RARE, steady_timer
from hpid_ros.nodes.core.status import ERROR, OK, WARN, Diagnostics
from hpid_ros.nodes.parts.joint_topics import Sink
from hpid_ros.nodes.parts.merger import CommandMerger, Merged, MergerSettings, Receiver
from hpid_ros.nodes.parts.merger_settings import GroupOutput

_LOOK_EVERY = 0.05  # [s]
_LOOK_AGAIN = 0.002  # [s], while nobody knows whose a subscription is
_NAMED_WITHIN = 0.5  # [s]; then it is taken for the receiver's, which is asked again
_NAMELESS = "_NODE_NAME_UNKNOWN_"  # of rmw, before a node has told which subscriptions it has
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
        self._nameless: dict[bytes, float] = {}  # subscriptions without a node, since when
        self._requests = 0
        self._is_asking = False
        self._asked_at = 0.0
        self._client: Any = None
        self.told_by = "nobody"
        """Who says whether the controller is active."""
        if receiver.name:
            self._client = node.create_client(GetParameters, f"{receiver.name}/get_parameters")
            self.told_by = _hear_activity(node, manager, self._hear)

    def start(self) -> None:
        """Look from now on."""
        if not self._timers:
            self._timers = [
                steady_timer(self._node, every, self.look) for every in (_LOOK_EVERY, _LOOK_AGAIN)
            ]
            self._timers[1].cancel()

    def stop(self) -> None:
        """Look no more."""
        while self._timers:
            self._node.destroy_timer(self._timers.pop())

    def look(self) -> None:
        """See who subscribes now, and ask a controller that is new for its joints."""
        if not self._timers:
            return
        matches = self._output.matches  # before the graph is asked, which knows of all of them
        endpoints, are_all_known = self._endpoints()
        if self._receiver.see(endpoints):
            self._is_asking = False
            self._requests += 1  # who was asked before is not the one that is there now
        if self._receiver.must_be_asked:
            self._output.forget()  # it has been sent nothing that zeros would have to end
            self._ask()
        self._changed()
        self._settle(matches, are_all_known)

    def _settle(self, matches: int, are_all_known: bool) -> None:
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
            if not wanted or wanted == f"{info.node_namespace.rstrip('/')}/{info.node_name}":
                found.add(endpoint)
            elif info.node_name == _NAMELESS:
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
        request = self._client.call_async(GetParameters.Request(names=list(_ASKED)))
        request.add_done_callback(partial(self._answered, self._requests))

    def _answered(self, number: int, future: Future) -> None:
        answer = future.result()
        if number != self._requests or answer is None:
            return
        self._is_asking = False
        values = [parameter_value_to_python(value) for value in answer.values]
        joints, interface = [*values, None, None][:2]
        self._receiver.note_joints(joints, interface)
        self._changed()

    def _hear(self, states: Mapping[str, str]) -> None:
        self._receiver.note_state(states.get(self._receiver.name.rpartition("/")[2]))
        self._changed()


def _hear_activity(node: Node, manager: str, hear: Callable[[Mapping[str, str]], None]) -> str:
    """Listen to what a manager says of its controllers.

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
            lambda message: _from_diagnostics(message, names, hear),
            RARE,
        )
        return "/diagnostics"
    topic = f"{manager}/activity"
    node.create_subscription(
        ControllerManagerActivity,
        topic,
        lambda message: hear({each.name: each.state.label for each in message.controllers}),
        LATCHED,
    )
    return topic


def _from_diagnostics(
    message: DiagnosticArray, names: set[str], hear: Callable[[Mapping[str, str]], None]
) -> None:
    for status in message.status:
        if status.name in names:
            hear(
                {
                    pair.key.removesuffix(_STATE): pair.value
                    for pair in status.values
                    if pair.key.endswith(_STATE)
                }
            )


_LOCK_WITHIN = 0.2  # [s]; whoever holds it longer is stuck in the middleware, as we would be
_BURST = 10  # zeros at once, where nobody may come back to repeat them
_SHORTEST_WAIT_NS = 20_000  # of the timer
_CLOSE_ENOUGH = 0.05  # of two waits, for which the timer stays as it is


class MergedStream:
    """A merger with its clock, its timer and its output.

    What is sent is whole and in the order in which it was merged, whichever thread sends it.
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
        self._timer = steady_timer(node, 1.0, self._on_deadline)
        self._timer.cancel()
        self._timer_ns = NANOSECONDS
        self._is_armed = False

    def begin(self, settings: MergerSettings) -> CommandMerger:
        """Merge from now on."""
        merger = CommandMerger(settings)
        with self._lock:
            self.output.agree(settings.names)
            self.merger = merger
        if self._node.supervisor is not None:
            self._node.supervisor.check_again()
        return merger

    def end(self) -> None:
        """Merge no more."""
        with self._lock:
            self.merger = None
        self._disarm()

    def sink(self, joint: str) -> Sink:
        """Return the sink of one joint's controller in the same process."""
        publisher = self.output.publisher
        return Sink(
            publisher,
            # Nobody hears it before the merger has a receiver.
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
        with self._sending():
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

    def zero(self) -> None:
        """Send a zero for every joint, if anything has been sent before."""
        with self._sending():
            self.output.zero()

    def _send(self, merged: Merged | None, merger: CommandMerger, now_ns: int) -> None:
        """Publish what is to be sent; only to be called by who has the lock."""
        if merged is None or merger is not self.merger or self._is_cut:
            return
        self.output.send(merged)
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
            self._send(merger.look(now_ns), merger, now_ns)
        self._arm(merger, now_ns)

    @contextlib.contextmanager
    def _sending(self) -> Iterator[None]:
        """Hold the lock, or do without where whoever has it is stuck."""
        is_locked = self._lock.acquire(timeout=_LOCK_WITHIN)
        try:
            yield
        finally:
            if is_locked:
                self._lock.release()

    # What follows is called on the supervisor's thread, also while a callback does not return.

    def check(self) -> float:
        """Send the fallbacks of joints that have fallen silent, and what else is due."""
        merger = self.merger
        if merger is None:
            return math.inf
        now_ns = time.perf_counter_ns()
        with self._sending():
            silences = merger.silences
            self._send(merger.look(now_ns), merger, now_ns)
            has_changed = merger.silences > silences
            within = merger.within(now_ns)
        if has_changed:
            self._node.hand_over(self._changed, merger)
        return min(within, merger.shortest_timeout)  # a joint may come back at any time

    def cut(self) -> None:
        """Leave all joints without effort."""
        if not self._is_cut:
            self._is_cut = True
            for _ in range(_BURST):
                self.zero()

    def restore(self) -> None:
        """Merge again; the joints come back from zero."""
        merger = self.merger
        if merger is not None:
            with self._sending():
                merger.supersede(0.0, time.perf_counter_ns())
        self._is_cut = False


_OFTEN_LATE = 0.1  # of the messages of a report
_MICROSECOND = 1e3  # [ns]


class Standing(NamedTuple):
    """How a merger stands at its surroundings."""

    lifecycle: str  # the managed node's state
    waiting: str  # what it waits for before it sends anything; empty if nothing
    is_unheard: bool  # whether that is a controller that does not act, or cannot be used
    claim: str  # how its claim of the topic stands
    refusal: str  # whose the topic is if not its own; empty if nobody has said so
    told_by: str  # who says whether the receiver is active
    rivals: Sequence[str]  # nodes that publish beside it
    withheld: int  # messages that were not sent while it was not known to whom they would go


class MergerHealth:
    """Counts what came, and publishes the merger's status."""

    period = 1.0

    def __init__(self, node: Node, topic: str) -> None:
        self._topic = topic
        self._diagnostics = Diagnostics(node, topic)
        self.fault = self._diagnostics.fault
        self.misread = 0
        self.delays = Durations()
        self._requests = 0
        self._before: dict[str, tuple[int, int]] = {}  # late and invalid, by joint
        self._sent_before = 0
        self.scheduling = ""

    def misread_command(self, line: str) -> None:
        """Note bytes that were no command."""
        self.misread += 1
        self.fault(f"command refused: {line}")

    def refused_request(self, line: str) -> None:
        """Note a service request, or a transition, that failed."""
        self._requests += 1
        self.fault(line)

    def report(self, standing: Standing, merger: CommandMerger | None, conflict: str) -> None:
        """Publish the status now."""
        level, message = self._verdict(standing, merger, conflict)
        self._diagnostics.publish(
            level,
            message,
            {
                "lifecycle": standing.lifecycle,
                "claim": standing.claim,
                "topic": self._topic,
                "activity told by": standing.told_by,
                **(_readings(merger) if merger is not None else {}),
                "messages withheld": standing.withheld,
                **self._delays(),
                "misread commands": self.misread,
                "refused requests": self._requests,
                "scheduling": self.scheduling,
                "last fault": self._diagnostics.last_fault,
            },
        )

    def _verdict(
        self, standing: Standing, merger: CommandMerger | None, conflict: str
    ) -> tuple[bytes, str]:
        if standing.lifecycle != "active":
            if standing.refusal:
                return WARN, f"{standing.lifecycle}: {standing.refusal}"
            return OK, standing.lifecycle
        errors = [conflict] if conflict else []
        if standing.rivals:
            errors.append(f"{', '.join(standing.rivals)} also publishes on {self._topic}")
        if standing.is_unheard:
            errors.insert(0, standing.waiting)
        if merger is not None and merger.has_begun and merger.silent:
            errors.append(shown_silent(merger))
        warnings = [standing.waiting] if standing.waiting and not standing.is_unheard else []
        warnings += self._irregular(merger) if merger is not None else []
        if errors or warnings:
            return ERROR if errors else WARN, "; ".join(errors + warnings)
        return OK, "merging"

    def _irregular(self, merger: CommandMerger) -> list[str]:
        """Return warnings of joints that were often late since the last report, or not finite."""
        messages, self._sent_before = merger.sent - self._sent_before, merger.sent
        lines = []
        for name, counts in merger.counts.items():
            late, invalid = self._before.get(name, (0, 0))
            self._before[name] = counts.late, counts.invalid
            if counts.invalid > invalid:
                lines.append(f"{name} commands what is not finite")
            elif counts.late - late > _OFTEN_LATE * max(messages, 1):
                lines.append(f"{name} is late")
        return lines

    def restart(self) -> None:
        """Note that what was counted is counted from zero."""
        self._before, self._sent_before = {}, 0

    def _delays(self) -> dict[str, float]:
        spread = self.delays.recent()
        return {
            "first answer to message, median [us]": spread.median,
            "first answer to message, 99th percentile [us]": spread.p99,
            "first answer to message, largest [us]": spread.maximum,
        }


def shown_silent(merger: CommandMerger) -> str:
    """Return one line about the joints that are silent."""
    joints = ", ".join(f"{joint.name} (sent {joint.fallback:g})" for joint in merger.silent)
    return f"silent: {joints}"


def _readings(merger: CommandMerger) -> dict[str, object]:
    """Return what a merger counted, by name, for ``/diagnostics``."""
    counts = merger.counts.values()
    by_joint = {
        "late": {name: each.late for name, each in merger.counts.items()},
        "silences": {name: each.silences for name, each in merger.counts.items()},
        "returns": {name: each.returns for name, each in merger.counts.items()},
        "commands not finite": {name: each.invalid for name, each in merger.counts.items()},
    }
    return {
        "joints": ", ".join(merger.settings.names),
        "silent": ", ".join(joint.name for joint in merger.silent) or "none",
        "period of the states [us]": merger.rounds.period_ns / _MICROSECOND,
        "wait for stragglers [us]": merger.rounds.wait_ns / _MICROSECOND,
        "messages": merger.sent,
        "messages with every answer": merger.sent_whole,
        "commands": sum(each.commands for each in counts),
        "commands for other joints": merger.foreign,
        **{what: _named(values) for what, values in by_joint.items()},
    }


def _named(values: dict[str, int]) -> str:
    """Return the counts that are not zero, with their joints."""
    return ", ".join(f"{name} {count}" for name, count in values.items() if count) or "none"
