"""Merges the commands of joint controllers into one message for all of their joints."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node
from rclpy.timer import Timer

from hpid_ros.base.errors import ClaimError, MessageError, SettingError
from hpid_ros.base.names import ALL_JOINTS
from hpid_ros.messages.joint_state import EffortReader
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import ALL_COMMANDS, steady_timer, subscribe_raw
from hpid_ros.nodes.core.process import schedule
from hpid_ros.nodes.core.status import StatusPipe
from hpid_ros.nodes.parts.bridge_commanders import Commanders
from hpid_ros.nodes.parts.claims import JointClaim, claims_joint
from hpid_ros.nodes.parts.joint_topics import Sink, sender_of
from hpid_ros.nodes.parts.lifecycle import ManagedNode
from hpid_ros.nodes.parts.merger import CommandMerger, Receiver
from hpid_ros.nodes.parts.merger_settings import GroupOutput, read_parameters
from hpid_ros.nodes.parts.merger_stream import (
    MergedStream,
    MergerHealth,
    ReceiverWatch,
    Standing,
    shown_silent,
)

_ZEROS = 10  # with which it leaves: nobody acknowledges a best-effort message
_BETWEEN_ZEROS = 0.01  # [s]


class JointCommandMerger(ManagedNode):
    """The managed shell around one :class:`~hpid_ros.nodes.parts.merger.CommandMerger`.

    An active merger waits for the receiver of its commands, and for as many publishers of
    ``joint_commands`` as it has joints that may not be missing; then it listens, so that
    controllers begin when somebody is there for all of them. Controllers of the same process hand
    their commands to it without a topic between (:meth:`sink`).
    """

    def __init__(
        self,
        name: str = "joint_command_merger",
        joints: Sequence[str] = (),
        is_composed: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self._is_composed = is_composed
        self._wanted = parameters = read_parameters(self, joints)
        is_claiming = claims_joint(self)
        self._output = GroupOutput(
            self,
            parameters.interface,
            f"{parameters.controller}/commands" if parameters.controller else "",
            sender_of(self, is_claiming),
            bool(parameters.controller),
            lambda: self._watch.look(),
        )
        topic = self._output.publisher.topic_name
        self._receiver = Receiver(parameters.controller, parameters.joints, topic)
        self._watch = ReceiverWatch(
            self, self._receiver, self._output, parameters.manager, self._look_around
        )
        what = f"all that is sent on {topic}"
        self._claim = JointClaim(self, is_claiming, ALL_JOINTS, topic, self._lose, what)
        self._health = MergerHealth(self, topic)
        self._stream = MergedStream(
            self, self._output, self._health.delays.note, self._tell_silences
        )
        self._status = StatusPipe(self)
        self._reader = EffortReader()
        self._commanders: Commanders | None = None
        self._commands: Any = None
        self._refusal = self._told = ""
        self._zeros_left = 0
        self._repeating: Timer | None = None
        steady_timer(self, self._health.period, self._report)
        self.start()
        self._health.scheduling = schedule(self)

    def begin(self) -> None:
        """Activate: merge as soon as there is somebody to hear it, and somebody to be heard."""
        self._stop_repeating()
        self._claim.take()
        self._watch.start()

    def leave(self) -> None:
        """Deactivate: zeros for all joints, again and again for a while."""
        self.is_starting = False
        self._stop_merging()
        if self._commands is not None:
            self.destroy_subscription(self._commands)
            self._commands = None
        self._zeros_left = _ZEROS if self._output.has_sent else 0
        self._repeat_zero()
        if self._zeros_left:
            self._repeating = steady_timer(self, _BETWEEN_ZEROS, self._repeat_zero)

    def _repeat_zero(self) -> None:
        if self.is_active:
            return  # again, before the timer's last call
        if self._zeros_left:
            self._zeros_left -= 1
            self._stream.zero()
        if not self._zeros_left:
            self._stop_repeating()
            self._watch.stop()  # which knows whether there is somebody new, until the last zero
            self._claim.release()

    def _stop_repeating(self) -> None:
        """Be done with zeros: all have been sent, or commands follow."""
        self._zeros_left = 0
        self._output.forget()
        if self._repeating is not None:
            self.destroy_timer(self._repeating)
            self._repeating = None

    def _lose(self, error: ClaimError, was_held: bool) -> None:
        """Leave joints that are another's after all: zeros would be in its way."""
        if self.is_starting and not was_held:
            raise error
        self._health.fault(f"deactivated: {error}")
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
        self._tell_change()

    def _start_merging(self) -> None:
        order = self._receiver.joints
        try:
            settings = self._wanted.settings(order)
        except SettingError as error:  # only the controller knew its joints
            self._refusal = str(error)
            return
        self._health.restart()
        merger = self._stream.begin(settings)
        self._commanders = Commanders(self, order, merger.counts, self._wanted.timeout)
        self.is_starting = False
        self._status.send("merging", joints=list(order))

    def _stop_merging(self) -> None:
        self._refusal = ""
        self._stream.end()

    def _listen_when_all_are_there(self, merger: CommandMerger) -> None:
        """Subscribe to commands once every joint that must be there has a publisher."""
        needed = sum(not joint.may_be_missing for joint in merger.settings.joints)
        if self.count_publishers("joint_commands") < needed:
            return
        self._commands = subscribe_raw(self, "joint_commands", self._on_command, ALL_COMMANDS)
        self._status.send("listening")

    def _on_command(self, raw: bytes) -> None:
        try:
            stamp_ns, names, efforts = self._reader.read(raw)
        except MessageError as error:
            self._health.misread_command(str(error))
            return
        commanders, sender = self._commanders, self._reader.sender
        if commanders is None:
            return
        names, efforts = commanders.heed(names, efforts, sender)
        for name, effort in zip(names, efforts, strict=True):
            self._stream.take(name, stamp_ns, effort, is_signed=bool(sender))

    def sink(self, node: Node, joint: str, sender: str) -> Sink:
        """Return the sink of a controller of this process."""
        return self._stream.sink(joint)

    def _tell_change(self) -> None:
        """Report at once when it waits for something else than before."""
        if self._waiting == self._told:
            return
        self._told = self._waiting
        if self._is_unheard:
            self._health.fault(self._told)
        else:
            self.get_logger().info(self._told or f"merging: {', '.join(self._receiver.joints)}")
        self._report()

    def _tell_silences(self, merger: CommandMerger) -> None:
        """Report at once who has fallen silent, or has come back."""
        if merger.has_begun and merger.silent:
            self._health.fault(shown_silent(merger))
        self._report()

    def refuse(self, line: str) -> None:
        """Take note of a request or a transition that failed."""
        self._health.refused_request(line)

    @property
    def _is_unheard(self) -> bool:
        """Whether there is a receiver for which nothing can be done from here."""
        return bool(self._refusal or self._receiver.is_refused or self._receiver.is_deactivated)

    def _report(self) -> None:
        self._health.report(
            Standing(
                self.lifecycle,
                self._waiting if self.is_active else "",
                self.is_active and self._is_unheard,
                self._claim.text,
                self._claim.refusal,
                self._watch.told_by,
                self._rivals() if self.is_active else (),
                self._output.withheld,
            ),
            self._stream.merger,
            self._commanders.conflict() if self._commanders is not None else "",
        )

    def _rivals(self) -> list[str]:
        """Return the nodes that publish beside this one."""
        own = self.get_fully_qualified_name()
        infos = self.get_publishers_info_by_topic(self._output.publisher.topic_name)
        names = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        if own in names:
            names.remove(own)
        return sorted(names)

    def stop_now(self) -> None:
        """Send a zero for every joint, if that has not been done."""
        if self.is_active:
            self.is_active = False
            self.leave()

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

    def check(self) -> float:
        """Send the fallbacks of silent joints, and what else is due."""
        return min(self._stream.check(), self._claim.keep())

    def cut_effort(self) -> bool:
        """Leave all joints without effort."""
        self._stream.cut()
        return True

    def restore_effort(self) -> None:
        """Merge again; the joints come back from zero."""
        self._stream.restore()


USAGE = Usage(
    "joint_command_merger",
    "Merges the commands of joint controllers into one message for all of their joints.",
    "-p joints:=[JOINT, ...]",
    [
        *("joints", "controller", "controller_manager", "command_interface", "straggler_wait"),
        *("command_timeout", "command_timeouts.*", "fallback_efforts.*", "fade_in_time"),
        *("claim", "autostart", "realtime_priority", "cpu_affinity", "status_fd"),
    ],
    ["joint_commands", "/controller_manager/activity (or /diagnostics)"],
    ["~/commands (or joint_command, dynamic_joint_commands, CONTROLLER/commands)", "/diagnostics"],
    ["~/change_state and the others of a managed node"],
)


def main(args: Sequence[str] | None = None) -> int:
    """Run one merger."""
    return executor.run(lambda: [JointCommandMerger()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
