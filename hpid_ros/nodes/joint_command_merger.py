"""Merges the commands of joint controllers into one message for all of their joints."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer
from sensor_msgs.msg import JointState

from hpid_ros.base.durations import Durations
from hpid_ros.base.errors import ClaimError, MessageError, SettingError
from hpid_ros.base.names import ALL_JOINTS_CLAIM
from hpid_ros.base.records import Record, names_of, parameters_of, quantity
from hpid_ros.control.settings import LARGEST_EFFORT, LONGEST_TIMEOUT
from hpid_ros.messages.joint_state import EffortReader
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import (
    ALL_COMMANDS,
    full_name,
    steady_timer,
    subscribe_raw,
    wait_until_acknowledged,
)
from hpid_ros.nodes.core.parameters import read, read_one
from hpid_ros.nodes.core.process import Scheduling, schedule
from hpid_ros.nodes.core.rclpy_internals import given_parameters
from hpid_ros.nodes.core.status import (
    ERROR,
    OK,
    WARN,
    Diagnostics,
    StatusParameters,
    StatusPipe,
    log_change,
)
from hpid_ros.nodes.core.waiting import (
    PUBLISHER,
    Wait,
    Waiting,
    described,
    fits,
    other_side,
    topic_view,
    unseen,
)
from hpid_ros.nodes.parts.bridge_commanders import Commanders
from hpid_ros.nodes.parts.claims import ClaimParameters, JointClaim, claims_joint
from hpid_ros.nodes.parts.command_interfaces import ARRAY, COMMANDS, OF_MERGERS
from hpid_ros.nodes.parts.joint_topics import Sink, sender_of
from hpid_ros.nodes.parts.lifecycle import ManagedNode, ManagedParameters
from hpid_ros.nodes.parts.merger import (
    CommandMerger,
    JointCounts,
    MergerSettings,
    Receiver,
    joints_of,
)
from hpid_ros.nodes.parts.merger_output import (
    GroupOutput,
    MergedStream,
    ReceiverWatch,
)

_LEAST_TIMEOUT = 1e-3  # [s]
_LONGEST_FADE_IN = 100.0  # [s]
_LEAST_SHARE = 0.01


def _timeout(meaning: str) -> Any:
    return quantity(meaning, "s", default=0.15, least=_LEAST_TIMEOUT, most=LONGEST_TIMEOUT)


@dataclass(frozen=True)
class MergerParameters(Record):
    """What the parameters say."""

    joints: tuple[str, ...] | None = quantity(
        "Order of the merged command; left out it is that of the controller's own parameter",
        default=None,
    )
    controller: str = quantity(
        "Group controller of ros2_control that gets the commands on its topic commands; "
        "it is asked for its joints, and nothing is sent while it is not active",
        default="",
    )
    controller_manager: str = quantity(
        "Manager of that controller; controller_manager in its namespace if empty", default=""
    )
    command_interface: str = quantity(
        f"Message of the merged commands: {', '.join(OF_MERGERS)}",
        default=ARRAY,
        choices=OF_MERGERS,
    )
    straggler_wait: float = quantity(
        "How long answers wait for those to the same state, as part of the states' period",
        default=0.5,
        least=_LEAST_SHARE,
        most=1.0,
    )
    # longer than state_timeout: the fallback_effort of a controller comes before the fallback
    command_timeout: float = _timeout("A joint is silent after so long")
    fade_in_time: float = quantity(
        "A joint that comes back is faded in from its fallback for so long [s], all joints from "
        "zero for a receiver that is new to it; 0 jumps",
        default=0.1,
        least=0.0,
        most=_LONGEST_FADE_IN,
    )


@dataclass(frozen=True)
class SilenceParameters(Record):
    """What is said of the silence of one joint."""

    command_timeouts: float = _timeout("The joint is silent after so long")
    fallback_efforts: float = quantity(
        "Effort of the joint while it is silent",
        "N m or N",
        default=0.0,
        least=-LARGEST_EFFORT,
        most=LARGEST_EFFORT,
    )


@dataclass(frozen=True)
class MergerOptions:
    """The parameters, with all names in full."""

    joints: tuple[str, ...]  # the order that was given; empty to take the controller's
    controller: str  # full name of the controller that gets the commands
    manager: str  # full name of that controller's manager
    given: MergerParameters
    timeouts: dict[str, float]  # [s] by joint
    fallbacks: dict[str, float]  # [N m] or [N], by joint

    def settings(self, order: Sequence[str]) -> MergerSettings:
        """Return the settings of a merger."""
        given = self.given
        joints = joints_of(order, given.command_timeout, self.timeouts, self.fallbacks)
        return MergerSettings(joints, given.straggler_wait, given.fade_in_time)


def read_parameters(node: Node, joints: Sequence[str]) -> MergerOptions:
    """Declare the parameters of a merger and return what they say."""
    given = read(node, MergerParameters)
    controller = _full_name(node, given.controller)
    order = given.joints or tuple(joints)
    if controller and order == tuple(joints):  # "-p joints:=..." is for every node of the process
        order = ()
    manager = _full_name(node, given.controller_manager)
    options = MergerOptions(
        joints=order,
        controller=controller,
        manager=manager or f"{controller.rpartition('/')[0]}/controller_manager",
        given=given,
        timeouts=_by_joint(node, "command_timeouts"),
        fallbacks=_by_joint(node, "fallback_efforts"),
    )
    if controller and given.command_interface != ARRAY:
        raise SettingError(
            f"controller is for command_interface {ARRAY}, not for {given.command_interface}"
        )
    if order:
        options.settings(order)  # which refuses what cannot be used
    elif not controller:
        raise SettingError(
            "the parameter joints must name the joints in their order, or controller a group "
            "controller that has them; both are empty"
        )
    return options


def _by_joint(node: Node, group: str) -> dict[str, float]:
    """Declare the parameters of a group that were given, and return their values by joint."""
    spec = parameters_of(SilenceParameters)[group]
    prefix = f"{group}."
    names = sorted(name for name in given_parameters(node) if name.startswith(prefix))
    own = [replace(spec, name=name) for name in names]
    return {
        each.name.removeprefix(prefix): each.checked(read_one(node, each, each.default))
        for each in own
    }


def _full_name(node: Node, name: str) -> str:
    """Return a node's full name; one without a slash is in this node's namespace."""
    if not name or name.startswith("/"):
        return name.rstrip("/")
    return f"{node.get_namespace().rstrip('/')}/{name}"


_OFTEN_LATE = 0.1  # of the messages of a report
_MICROSECOND = 1e3  # [ns]


class MergerHealth(Diagnostics):
    """Counts what came of commands."""

    def __init__(self, node: Node, topic: str) -> None:
        super().__init__(node, topic)
        self.misread = 0
        self.delays = Durations()
        self.restart()

    def restart(self) -> None:
        """Note that what a merger counts is counted from zero."""
        self._before: dict[str, tuple[int, int]] = {}  # late and invalid, by joint
        self._sent_before = 0

    def irregular(self, merger: CommandMerger) -> list[str]:
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


def _shown_silent(merger: CommandMerger) -> str:
    joints = ", ".join(f"{joint.name} (sent {joint.fallback:g})" for joint in merger.silent)
    return f"silent: {joints}"


def _readings(merger: CommandMerger) -> dict[str, object]:
    """Return what a merger counted, by name, for ``/diagnostics``."""

    def by_joint(count: Callable[[JointCounts], int]) -> str:
        counts = {name: count(each) for name, each in merger.counts.items()}
        return ", ".join(f"{name} {n}" for name, n in counts.items() if n) or "none"

    return {
        "joints": ", ".join(merger.settings.names),
        "silent": ", ".join(joint.name for joint in merger.silent) or "none",
        "period of the states [us]": merger.rounds.period_ns / _MICROSECOND,
        "wait for stragglers [us]": merger.rounds.wait_ns / _MICROSECOND,
        "messages": merger.sent,
        "messages with every answer": merger.sent_whole,
        "commands": sum(each.commands for each in merger.counts.values()),
        "commands for other joints": merger.foreign,
        "late": by_joint(lambda each: each.late),
        "silences": by_joint(lambda each: each.silences),
        "returns": by_joint(lambda each: each.returns),
        "commands not finite": by_joint(lambda each: each.invalid),
        "commands from before a reset": by_joint(lambda each: each.outdated),
    }


_LONGEST_GAP = 0.2  # of the patience with a joint's sender
_ZEROS = 10  # with which it leaves: nobody acknowledges a best-effort message
_BETWEEN_ZEROS = 0.01  # [s]
_NAMED_AT_MOST = 1000  # joints that commands have named
_ZEROS_WITHHELD = 100  # at most, while it is not known whose a subscription is


class JointCommandMerger(ManagedNode):
    """The managed shell around one :class:`~hpid_ros.nodes.parts.merger.CommandMerger`.

    An active merger waits for the receiver of its commands, and for as many publishers of
    ``joint_commands`` as it has joints that may not be missing; then it listens, so that
    controllers begin when all of them have a subscriber. Controllers of the same process hand
    their commands to it without a topic between (:meth:`sink`).
    """

    def __init__(
        self,
        name: str = "joint_command_merger",
        joints: Sequence[str] = (),
        is_composed: bool = False,
        waiting: Waiting | None = None,
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self._is_composed = is_composed
        self._wanted = parameters = read_parameters(self, joints)
        is_claiming = claims_joint(self)
        self._output = GroupOutput(
            self,
            parameters.given.command_interface,
            f"{parameters.controller}/commands" if parameters.controller else "",
            sender_of(self, is_claiming),
            bool(parameters.controller),
            self._look_at_receiver,
        )
        topic = self._output.publisher.topic_name
        self._receiver = Receiver(parameters.controller, parameters.joints, topic)
        self._watch = ReceiverWatch(
            self, self._receiver, self._output, parameters.manager, self._look_around
        )
        what = f"all that is sent on {topic}"
        self._claim = JointClaim(self, is_claiming, ALL_JOINTS_CLAIM, topic, self._lose, what)
        self._health = MergerHealth(self, topic)
        self._stream = MergedStream(
            self, self._output, self._health.delays.note, self._report_silences
        )
        self._status = StatusPipe(self)
        self._reader = EffortReader()
        self._commanders: Commanders | None = None
        self._commands: Any = None
        self._refusal = self._reported = ""
        self._zeros_left = self._zeros_withheld = 0
        self._repeating: Timer | None = None
        self._scheduling = ""
        self._named: set[str] = set()  # joints in commands, while some are waited for
        self._waiting_log = waiting or Waiting(self)
        self._waiting_log.add(self._awaited)
        steady_timer(self, 1.0, self._report)
        self.start()
        self._scheduling = schedule(self)

    def _look_at_receiver(self) -> None:
        """See whose the subscriptions of the commands are: one has come, or gone."""
        self._watch.look()

    def begin(self) -> None:
        self._stop_repeating()
        self._commanders = None
        self._claim.take()
        self._watch.start()

    def leave(self) -> None:
        """Deactivate: zeros for all joints, again and again for a while."""
        self.is_starting = False
        self._stop_merging()
        if self._commands is not None:
            self.destroy_subscription(self._commands)
            self._commands = None
        self._zeros_left, self._zeros_withheld = (_ZEROS if self._output.has_sent else 0), 0
        self._repeat_zero()
        if self._zeros_left:
            self._repeating = steady_timer(self, _BETWEEN_ZEROS, self._repeat_zero)

    def _repeat_zero(self) -> None:
        if self.is_active:
            return  # again, before the timer's last call
        if self._zeros_left:
            is_last = self._zeros_withheld >= _ZEROS_WITHHELD
            may_be_sent = is_last or not self._receiver.must_be_asked
            if not self._output.has_sent:  # to who is there now
                self._zeros_left = 0
            elif may_be_sent and self._stream.zero(is_last=is_last):
                self._zeros_left -= 1
            else:
                self._zeros_withheld += 1
        if not self._zeros_left:
            self._stop_repeating()
            self._watch.stop()  # until the last zero it notices new subscriptions
            self._claim.release()

    def _stop_repeating(self) -> None:
        """Be done with zeros: all have been sent, or commands follow."""
        self._zeros_left = self._zeros_withheld = 0
        self._output.forget()
        if self._repeating is not None:
            self.destroy_timer(self._repeating)
            self._repeating = None

    def _lose(self, error: ClaimError, was_held: bool) -> None:
        """Leave joints that are another's after all: zeros would be in its way."""
        if self.is_starting and not was_held:
            raise error
        self._health.warn(f"deactivated: {error}")
        self._output.forget()
        if self.is_active:
            self.trigger_deactivate()
        self._report()

    @property
    def _waiting(self) -> str:
        """What an active merger waits for before it merges; empty if nothing."""
        if self._refusal:
            return self._refusal
        if not self._claim.is_settled:
            return "waiting for other claims of the topic"
        if self._receiver.reason:
            return self._receiver.reason
        merger = self._stream.merger
        if merger is not None and merger.missing:
            return f"waiting for commands of {', '.join(merger.missing)}"
        return ""

    def _awaited(self) -> Wait | None:
        """Return what an active merger waits for, for the log."""
        if not self.is_active or self._refusal or not self._waiting:
            return None
        receiver, merger = self._receiver, self._stream.merger
        if not self._claim.is_settled:
            wait = Wait("other claims of the topic", "are settled", "", lambda _: "")
        elif receiver.is_refused or receiver.is_deactivated:
            return None  # it has said so itself, and that is logged at once
        elif receiver.reason:
            topic = self._output.publisher.topic_name
            what = "a subscriber of the commands"
            if receiver.endpoints:
                what = f"{receiver.name} to say which joints it has"
            arrival = "is there" if not receiver.endpoints else "has ended"
            wait = Wait(what, arrival, topic, self._receiver_found)
        elif merger is None or self._is_composed:
            return None  # the controllers of this process say what they wait for
        else:
            topic = self.resolve_topic_name(COMMANDS)
            wait = Wait("commands", "come", topic, self._commands_found, tuple(merger.missing))
        return wait._replace(has_come=lambda: self.is_active)

    def _receiver_found(self, joints: Sequence[str]) -> str:
        receiver, view = self._receiver, other_side(self, self._output.publisher)
        if not receiver.name:
            return described(view)
        if receiver.endpoints:
            return f"its service {receiver.name}/get_parameters does not answer"
        return f"{described(view)}; the parameter controller is {receiver.name}"

    def _commands_found(self, joints: Sequence[str]) -> str:
        topic = self.resolve_topic_name(COMMANDS)
        view = topic_view(self, topic, PUBLISHER, JointState, ALL_COMMANDS)
        parts = [described(view)]
        if self._commands is None:
            parts.append(f"{len(joints)} joints must have one before the merger listens")
        elif seen := unseen(joints, self._named):
            parts.append(seen)
        elif fits(view):
            parts.append("nothing has come for these joints")
        return "; ".join(parts)

    def _look_around(self) -> None:
        """Begin or cease to merge, by what is known of the receiver."""
        if not self.is_active:
            return
        if not self._claim.settle() or self._receiver.reason:
            self._stop_merging()
        elif self._stream.merger is None and not self._refusal:
            self._start_merging()
        merger = self._stream.merger
        if merger is not None and self._commands is None and not self._is_composed:
            self._listen_when_all_are_there(merger)
        self._report_change()

    def _start_merging(self) -> None:
        order = self._receiver.joints
        try:
            settings = self._wanted.settings(order)
        except SettingError as error:  # only the controller knew its joints
            self._refusal = str(error)
            return
        self._health.restart()
        merger = self._stream.begin(settings)
        if self._commanders is None:
            patience = max(joint.timeout for joint in settings.joints)
            longest_gap = _LONGEST_GAP * patience
            self._commanders = Commanders(self, order, merger.counts, patience, longest_gap)
        else:
            self._commanders.go_on(order, merger.counts)
        self.is_starting = False
        self._status.send("merging", joints=list(order))

    def _stop_merging(self) -> None:
        self._refusal = ""
        self._stream.end()

    def _listen_when_all_are_there(self, merger: CommandMerger) -> None:
        """Subscribe to commands once every joint that must be there has a publisher."""
        needed = sum(not joint.may_be_missing for joint in merger.settings.joints)
        if self.count_publishers(COMMANDS) < needed:
            return
        self._commands = subscribe_raw(self, COMMANDS, self._on_command, ALL_COMMANDS)
        self._status.send("listening")

    def _on_command(self, raw: bytes) -> None:
        try:
            stamp_ns, names, efforts = self._reader.read(raw)
        except MessageError as error:
            self._health.misread += 1
            self._health.fault(f"command refused: {error}")
            return
        commanders, sender = self._commanders, self._reader.sender
        if commanders is None:
            return
        if self._reported and len(self._named) < _NAMED_AT_MOST:
            self._named.update(names)
        names, efforts = commanders.heed(names, efforts, sender, commanders.move())
        for name, effort in zip(names, efforts, strict=True):
            self._stream.take(name, stamp_ns, effort, is_signed=bool(sender))

    def sink(self, node: Node, joint: str, sender: str) -> Sink:
        return self._stream.sink(joint)

    def _report_change(self) -> None:
        """Report at once when it waits for something else than before."""
        if self._waiting == self._reported:
            return
        self._reported = self._waiting
        self._named.clear()
        self._waiting_log.begin()
        if self._is_unusable:
            self._health.warn(self._reported)
        else:
            log_change(self, self._reported or f"merging: {', '.join(self._receiver.joints)}")
        self._report()

    def _report_silences(self, merger: CommandMerger) -> None:
        """Report at once who has fallen silent, or has come back."""
        if merger.has_begun and merger.silent:
            self._health.warn(_shown_silent(merger))
        self._report()

    def refuse(self, line: str) -> None:
        self._health.refuse(line)

    @property
    def _is_unusable(self) -> bool:
        """Whether the receiver does not act, or cannot be used."""
        return bool(self._refusal or self._receiver.is_refused or self._receiver.is_deactivated)

    def _report(self) -> None:
        lifecycle, merger, health = self.lifecycle, self._stream.merger, self._health
        level, message = self._verdict(lifecycle, merger)
        health.publish(
            level,
            message,
            {
                "lifecycle": lifecycle,
                "claim": self._claim.text,
                "topic": self._output.publisher.topic_name,
                "activity topic": self._watch.activity_topic,
                **(_readings(merger) if merger is not None else {}),
                "messages withheld": self._output.withheld,
                **health.delays.recent().readings("first answer to message"),
                "misread commands": health.misread,
                "refused requests": health.refused_requests,
                "scheduling": self._scheduling,
                "last fault": health.last_fault,
            },
        )

    def _verdict(self, lifecycle: str, merger: CommandMerger | None) -> tuple[bytes, str]:
        # Counted since the last report, so it is read with each.
        conflict = self._commanders.conflict() if self._commanders is not None else ""
        if lifecycle != "active":
            refusal = self._claim.refusal
            return (WARN, f"{lifecycle}: {refusal}") if refusal else (OK, lifecycle)
        waiting, is_unusable = self._waiting, self._is_unusable
        errors = [waiting] if is_unusable else []
        errors += [conflict] if conflict else []
        if rivals := self._rivals():
            topic = self._output.publisher.topic_name
            errors.append(f"{', '.join(rivals)} also publishes on {topic}")
        if merger is not None and merger.has_begun and merger.silent:
            errors.append(_shown_silent(merger))
        warnings = [waiting] if waiting and not is_unusable else []
        warnings += self._health.irregular(merger) if merger is not None else []
        if errors or warnings:
            return ERROR if errors else WARN, "; ".join(errors + warnings)
        return OK, "merging"

    def _rivals(self) -> list[str]:
        """Return the other nodes that publish the merged commands."""
        own = self.get_fully_qualified_name()
        infos = self.get_publishers_info_by_topic(self._output.publisher.topic_name)
        names = sorted(map(full_name, infos))
        if own in names:
            names.remove(own)
        return names

    def stop_now(self) -> None:
        """Send a zero for every joint, if that has not been done."""
        self._leave()

    def destroy_node(self) -> None:
        """Destroy the node, and what would keep it on the graph."""
        super().destroy_node()
        self._output.destroy()

    def close(self) -> None:
        """Send the zeros that are left: the executor does it no more."""
        while self._zeros_left:
            time.sleep(_BETWEEN_ZEROS)
            self._watch.look()
            self._repeat_zero()
        wait_until_acknowledged(self, self._output.publisher, "the last command, of zero efforts,")

    def check(self) -> float:
        """Send the fallbacks of silent joints, and what else is due."""
        return min(self._stream.check(), self._claim.keep())

    def cut_effort(self) -> bool:
        self._stream.cut()
        return True

    def wait_until_cut(self, within: float) -> None:
        """Wait until reliable subscribers have acknowledged the last zero."""
        self._output.publisher.wait_for_all_acked(Duration(seconds=within))

    def restore_effort(self) -> None:
        """Merge again; the joints come back from zero."""
        self._stream.restore()


USAGE = Usage(
    "joint_command_merger",
    "Merges the commands of joint controllers into one message for all of their joints.",
    "-p joints:=[JOINT, ...]",
    [
        *names_of(MergerParameters),
        *(f"{name}.*" for name in names_of(SilenceParameters)),
        *names_of(ClaimParameters, ManagedParameters, Scheduling, StatusParameters),
    ],
    ["joint_commands", "/controller_manager/activity (or /diagnostics)"],
    ["~/commands (or joint_command, dynamic_joint_commands, CONTROLLER/commands)", "/diagnostics"],
    ["~/change_state and the others of a managed node"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [JointCommandMerger()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
