"""Controls one joint: states in, effort commands out."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.errors import ClaimError, MessageError, SettingError
from hpid_ros.base.names import ALLOW_RELAY
from hpid_ros.base.records import Record, names_of, parameters_of, quantity
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import LATCHED_WITHIN, Motion
from hpid_ros.control.settings import LoopSettings, Value
from hpid_ros.control.supervision import SupervisedLoop
from hpid_ros.messages.joint_state import JointReader
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import NEWEST_STATES, RARE, steady_timer, subscribe_raw
from hpid_ros.nodes.core.parameters import declare, read
from hpid_ros.nodes.core.process import Scheduling, schedule
from hpid_ros.nodes.core.status import StatusParameters, StatusPipe, log_change
from hpid_ros.nodes.core.waiting import (
    PUBLISHER,
    SeenJoints,
    Wait,
    Waiting,
    described,
    fits,
    other_side,
    topic_view,
    unseen,
)
from hpid_ros.nodes.parts.claims import ClaimParameters, JointClaim, claims_joint
from hpid_ros.nodes.parts.command_interfaces import JOINT_STATE_INTERFACE, OF_CONTROLLERS
from hpid_ros.nodes.parts.joint_topics import (
    SINKS,
    STATES,
    Commands,
    SharedTopics,
    Sinks,
    sender_of,
)
from hpid_ros.nodes.parts.lifecycle import (
    ControllerStop,
    ManagedNode,
    ManagedParameters,
    StopParameters,
)
from hpid_ros.nodes.parts.references import (
    TRAJECTORY,
    ControllerReferences,
    Introspection,
    IntrospectionParameters,
)
from hpid_ros.nodes.parts.settings_and_health import (
    IN_CONTROL,
    Certification,
    CertificationParameters,
    ControllerHealth,
    ControllerSettings,
    LoopTiming,
    RobotParameters,
    concern_the_loop,
    model_compensation,
)

_READINESS_PERIOD = 0.02  # [s]
_INACTIVE = "the controller is not active"


@dataclass(frozen=True)
class ControllerParameters(Record):
    """What a controller does with its commands, and waits for."""

    command_interface: str = quantity(
        f"Message of the commands: {', '.join(OF_CONTROLLERS)}", default=JOINT_STATE_INTERFACE
    )
    wait_for_command_subscribers: int = quantity(
        "Subscribers that commands must have first", default=1, least=0
    )
    wait_for_reference: bool = quantity("Do not start before there is a trajectory", default=False)
    state_watchdog: bool = quantity(
        "Give fallback_effort when no new state has come for state_timeout of wall time",
        default=True,
    )


@dataclass(frozen=True)
class RelayParameters(Record):
    """Whether a relay may drive the joint; it may change while the node runs."""

    allow_relay: bool = quantity(
        "Whether ~/relay is obeyed: a relay drives the joint within its effort limits",
        default=False,
    )


class JointController(ManagedNode):
    """The managed shell around one :class:`~hpid_ros.control.JointLoop`.

    An active controller subscribes to the states once its commands have a subscriber (and, when
    asked, once it has a reference): no integral winds up without effect. It begins by holding the
    joint where it is. While it is active no other controller may be.
    """

    def __init__(
        self,
        name: str = "joint_controller",
        sinks: Sinks = SINKS,
        shared: SharedTopics | None = None,
        waiting: Waiting | None = None,
        defaults: Mapping[str, Value] = MappingProxyType({}),
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self._tuning = ControllerSettings(self, defaults)
        self._loop = JointLoop(self._tuning.with_changes())
        self.joint = self._loop.settings.joint
        self._reader = JointReader(self.joint)
        asked = read(self, ControllerParameters)
        if asked.command_interface not in sinks:
            allowed = ", ".join(sinks)
            raise SettingError(
                f"command_interface must be one of {allowed}, not {asked.command_interface!r}"
            )
        make_sink = sinks[asked.command_interface]
        self._model = model_compensation(self, self._loop.settings, self._tuning.robot)
        self._least_subscribers = asked.wait_for_command_subscribers
        self._needs_reference = asked.wait_for_reference
        declare(self, parameters_of(RelayParameters).values())
        is_claiming = claims_joint(self)
        sender = sender_of(self, is_claiming)
        self._commands = Commands(make_sink(self, self.joint, sender))
        topic = self._commands.publisher.topic_name
        self._claim = JointClaim(self, is_claiming, self.joint, topic, self._lose)
        self._introspection = Introspection(self, self.joint, self._model is not None)
        self._status = StatusPipe(self)
        self._certification = Certification(self, self._loop.settings)
        self._timing = LoopTiming()
        self._supervised = SupervisedLoop(self._loop, self._timed_out, self._end_stop)
        self._watchdog = self._supervised.watchdog
        self._watchdog_timer: Any = None
        self._has_watchdog = asked.state_watchdog
        self._stopping = ControllerStop(self, self._supervised, self._commands, self._left)
        self._health = ControllerHealth(
            self,
            self._loop,
            self._certification,
            self._timing,
            self._model,
            is_slide=self._tuning.is_slide,
        )
        self._shared = shared if shared and shared.has_same(self, STATES) else None
        self._states: Any = None
        self._is_listening = self._is_timeout_reported = self._is_conflict_reported = False
        self._readiness: Any = None
        self._is_simulated = False  # whether the states said so, and its clock was taken
        self._has_refused_clock = False
        self._seen = SeenJoints()
        self._waiting = waiting or Waiting(self)
        self._waiting.add(self._awaited)
        self._references: ControllerReferences | None = None
        self._standstill = ""  # what is said of stamps that stand still
        self._begun_at: float | None = None  # when the first state came since the activation
        steady_timer(self, self._health.period, self._report)
        self.add_on_set_parameters_callback(self._verdict)
        self.add_post_set_parameters_callback(self._retune)
        self.start()
        self._health.scheduling = schedule(self)

    def prepare(self) -> None:
        """Configure: subscribe to references."""
        self._stopping.end()
        self._loop.release()
        for warning in (self._loop.estimation.warning, self._loop.settings.floor_warning):
            if warning:
                self.get_logger().warning(warning)
        self._references = ControllerReferences(
            self,
            self.joint,
            self._follow,
            self._relay,
            self._health.refused_reference,
            lambda: "" if self.is_active or self._needs_reference else _INACTIVE,
        )

    def _end_stop(self) -> None:
        """Cut a damping stop short: the loop has the joint again."""
        self._stopping.end()

    def dispose(self) -> None:
        """Undo :meth:`prepare`; a damping ramp goes on to its end."""
        if not self._stopping.is_damping:
            self._stop_listening()
        if self._references is not None:
            self._references.close()
        self._references = None
        self._needs_reference = False

    def begin(self) -> None:
        """Activate: hold the joint where it is as soon as the commands have a subscriber."""
        self._stopping.end()
        self._claim.take()
        self._stop_listening()
        self._supervised.begin()
        if self._shared:
            self._shared.expect(self)
        self._readiness = steady_timer(self, _READINESS_PERIOD, self._start_when_ready)
        self._waiting.begin()

    def leave(self) -> None:
        """Deactivate: the last command is zero, and a later activation starts again."""
        self._needs_reference = self.is_starting = False
        if self._references is not None:
            self._references.discard()
        self._stopping.begin()

    def _left(self) -> None:
        self._stop_listening()
        self._claim.release()

    def _lose(self, error: ClaimError, was_held: bool) -> None:
        """Leave a joint that is another's after all: a damping ramp would be in its way."""
        if self.is_starting and not was_held:
            raise error
        self._health.warn(f"deactivated: {error}")
        if self.is_active:
            self.trigger_deactivate()
        self._stopping.end()
        self._report()

    def _stop_listening(self) -> None:
        """Drop the states, and any motion but one that is waited for."""
        self._watchdog.forget()
        self._begun_at = None
        self._is_timeout_reported = self._is_conflict_reported = False
        for timer in (self._watchdog_timer, self._readiness):
            if timer is not None:
                self.destroy_timer(timer)
        self._watchdog_timer = self._readiness = None
        if self._shared:
            self._shared.leave(self)
        elif self._states is not None:
            self.destroy_subscription(self._states)
            self._states = None
        if self._needs_reference:
            self._loop.reset()
        else:
            self._loop.release()
        if self._model is not None:
            self._model.states.reset()
        self._is_listening = False
        self._timing.interrupt()

    def _start_when_ready(self) -> None:
        if self._readiness is None or self._is_listening:
            return
        if not self._claim.settle() or self._waits_for():
            return
        self._readiness.cancel()
        self.is_starting = False
        self._is_listening = True
        if self._shared:
            self._shared.listen(self, self._on_state)
        else:
            self._states = subscribe_raw(self, STATES, self._on_state, NEWEST_STATES)
        self._status.send("listening")

    def _waits_for(self) -> str:
        """Return what is missing for the states to be listened to; empty if nothing."""
        if not self._claim.is_settled:
            return "waiting for other claims of the joint"
        if self._commands.subscribers() < self._least_subscribers:
            return "waiting for a subscriber of the commands"
        if self._needs_reference and self._loop.following.motion is None:
            return "waiting for a reference"
        return ""

    def _awaited(self) -> Wait | None:
        """Return what an active controller waits for, for the log."""
        if not self.is_active or self._readiness is None:
            return None
        if self._is_listening:
            topic = self.resolve_topic_name(STATES)
            wait = Wait("states", "come", topic, self._states_found, (self.joint,))
        elif not self._waits_for():
            return None
        elif not self._claim.is_settled:
            wait = Wait("other claims of the joint", "are settled", "", lambda _: "")
        elif self._commands.subscribers() < self._least_subscribers:
            topic = self._commands.publisher.topic_name
            what = "a subscriber of the commands"
            wait = Wait(what, "is there", topic, self._subscribers_found, (self.joint,))
        else:
            topic = self.resolve_topic_name(TRAJECTORY)
            wait = Wait("a reference", "is there", topic, self._reference_found, (self.joint,))
        return wait._replace(has_come=lambda: self.is_active)

    def _states_found(self, joints: Sequence[str]) -> str:
        states = self._shared.states if self._shared else self._states
        if states is None:  # others that share it are not ready
            return ""
        view = other_side(self, states)
        line = described(view)
        if rejected := self._loop.counts.rejected + self._health.misread:
            reason = self._loop.last_fault or self._health.last_fault
            return f"{line}; {rejected} have come that cannot be used, the last: {reason}"
        others = unseen(joints, self._seen.names())
        if not others and fits(view):
            others = "nothing has come"
        return f"{line}{'; ' * bool(others)}{others}"

    def _subscribers_found(self, joints: Sequence[str]) -> str:
        line = described(other_side(self, self._commands.publisher))
        least = self._least_subscribers
        return f"{line}; wait_for_command_subscribers is {least}" if least > 1 else line

    def _reference_found(self, joints: Sequence[str]) -> str:
        topic = self.resolve_topic_name(TRAJECTORY)
        view = topic_view(self, topic, PUBLISHER, JointTrajectory, RARE)
        return described(view) + ("; none for this joint has come" if fits(view) else "")

    def _on_state(self, raw: bytes) -> None:
        began_ns, cuts = time.perf_counter_ns(), self._commands.cuts
        self._supervised.note_past_timeout(began_ns)
        if self._is_left():  # it was on its way
            return
        try:
            sample = self._reader.read(raw)
        except MessageError as error:
            self._health.misread_state(str(error))
            return
        if sample is None:
            self._health.foreign += 1
            self._seen.newest = raw
            return
        if self._reader.is_simulated is not self._is_simulated:
            self._note_robot()
        model = self._model
        by_model = None if model is None else partial(model.answer, self._loop, sample, raw)
        effort = self._supervised.answer(*sample, began_ns, by_model)
        if self._is_left():  # the state came too late for a damping stop
            return
        self._commands.send(sample.stamp_ns, effort, cuts)
        if self._readiness is not None:
            self._note_first_states()
        if self._loop.state.mode is LoopMode.CONFLICT and not self._is_conflict_reported:
            self._is_conflict_reported = True
            self._health.error(self._health.conflict())
            self._report()
        self._timing.note(began_ns, time.perf_counter_ns())
        self._introspection.sample(sample.stamp_ns, self._loop)

    def _note_robot(self) -> None:
        """Go by the clock of the robot of which the states tell.

        That of a simulated one is put back by a reset. Where a real robot's states have come, one
        that says that it is simulated is another source, and takes no watchdog from the joint.
        """
        if not self._is_simulated:
            if self._loop.settings.timing.is_simulated:
                return
            if self._loop.state.stamp_ns is not None:
                if not self._has_refused_clock:
                    self._has_refused_clock = True
                    self.get_logger().warning(
                        "states of a simulated robot have come after those of another one: they "
                        "are another source, and state_clock stays wall"
                    )
                return
            self._set_clock("simulated")
            self.get_logger().info(
                "the states are those of a simulated robot: state_clock is simulated"
            )
        else:
            self._set_clock("wall")
            self.get_logger().warning(
                "the states are not those of a simulated robot any more: state_clock is wall"
            )

    def _set_clock(self, clock: str) -> None:
        self._is_simulated = clock == "simulated"
        self.set_parameters([Parameter("state_clock", value=clock)])

    def _is_left(self) -> bool:
        return not self._is_listening

    def _note_first_states(self) -> None:
        """Watch for a state timeout from the first state; a usable one completes the start."""
        self._watch_states(self._loop.settings.timing.state_timeout)
        if self._loop.state.stamp_ns is not None:
            self._begun_at = time.monotonic()
            self.destroy_timer(self._readiness)
            self._readiness = None
            self._health.begun()

    def _watch_states(self, timeout: float) -> None:
        """Check for a state timeout on two threads, as no state calls the loop then.

        That of the supervisor gives the effort, which no callback may delay (:meth:`check`); that
        of the executor tells the loop.
        """
        if not self._has_watchdog or timeout == self._watchdog.timeout:
            return
        if self._watchdog_timer is not None:
            self.destroy_timer(self._watchdog_timer)
        self._watchdog.timeout = timeout
        self._watchdog_timer = steady_timer(
            self,
            self._watchdog.period,
            lambda: self._supervised.look(time.perf_counter_ns()),
        )
        if self.supervisor is not None:
            self.supervisor.check_again()

    def _has_timed_out(self) -> bool:
        return self._watchdog.is_silent(time.perf_counter_ns())

    def _timed_out(self, silence: float, effort: float) -> None:
        """Report a state timeout; :meth:`check` gives the effort, whatever this thread does."""
        self._is_timeout_reported = True
        unit = self._health.unit("N m")
        line = f"no new state for {silence:.3g} s: the effort is {effort:g} {unit}"
        self._standstill = self._find_standstill()
        self._health.warn(f"{line}; {self._standstill}" if self._standstill else line)
        self._report()

    def _find_standstill(self) -> str:
        """Return in words that states come whose stamps stand still; empty if they do not."""
        timeout = self._loop.settings.timing.state_timeout
        return self._watchdog.standstill(time.perf_counter_ns(), timeout)

    def _follow(self, motion: Motion, is_latched: bool) -> None:
        begun_at = self._begun_at
        has_just_begun = begun_at is None or time.monotonic() - begun_at < LATCHED_WITHIN
        carries_on = is_latched and has_just_begun and self._loop.following.motion is None
        self._loop.receive(motion, carries_on=carries_on)
        self._health.accepted_reference()

    def _relay(self, request: RelayRequest | None) -> None:
        if request is None:
            self._loop.end_relay("it was told to end")
            return
        if not self.get_parameter(ALLOW_RELAY).value:
            raise SettingError(f"relays are not allowed: {ALLOW_RELAY} is false")
        if not self.is_active:
            raise SettingError(_INACTIVE)
        self._loop.begin_relay(request)
        self._health.relay_begins(request)
        self._report()

    def _verdict(self, changes: Sequence[Parameter]) -> SetParametersResult:
        return self._tuning.verdict(changes, self._certification.require)

    def _retune(self, changes: Sequence[Parameter]) -> None:
        if any(each.name == ALLOW_RELAY and not each.value for each in changes):
            self._loop.end_relay("relays are not allowed any more")
        if not concern_the_loop(changes):
            return
        settings = self._tuning.with_changes(changes)
        if settings.floor_warning and not self._loop.settings.floor_warning:
            log_change(self, settings.floor_warning, is_warning=True)
        self._loop.retune(settings)
        if self._model is not None:
            self._model.states.retune(settings)
        if self._is_listening and self.is_active:
            self._watch_states(settings.timing.state_timeout)
        self._certification.accept(settings)

    def refuse(self, line: str) -> None:
        self._health.refuse(line)

    def refuse_message(self, topic: str, reason: str) -> None:
        """Give the fallback for a state that could not be answered."""
        super().refuse_message(topic, reason)
        if topic == STATES:
            self._commands.fall_back(self._supervised.timeout_effort, lambda: True)

    def _report(self) -> None:
        if self._is_timeout_reported and self._loop.state.mode is not LoopMode.SILENT:
            self._is_timeout_reported = False
            log_change(self, "states come again: the joint is controlled")
        before, self._standstill = self._standstill, self._find_standstill()
        if self._standstill and not before:
            self._health.warn(self._standstill)
        if self._is_conflict_reported and self._loop.state.mode in IN_CONTROL:
            self._is_conflict_reported = False
            log_change(self, "states come from one source again: the joint is controlled")
        if self._references is not None:
            self._references.look()
        waiting = "" if self._is_listening else self._waits_for()
        claim = self._claim
        self._health.report(self.lifecycle, waiting, claim.text, claim.refusal, self._standstill)

    def begin_stop(self) -> Future | None:
        """Begin to leave the joint; the process goes on until that is done."""
        self._leave()
        return self._stopping.ended()

    def stop_now(self) -> None:
        """Leave the joint without effort, if it has not been left."""
        if self.is_active or self._stopping.is_damping:
            self.is_active = False
            self._stopping.now()

    def check(self) -> float:
        """Give the effort for a state timeout, and publish the claim where it is due."""
        self._commands.fall_back(self._supervised.timeout_effort, self._has_timed_out)
        now_ns = time.perf_counter_ns()
        return min(self._watchdog.time_left(now_ns), self._claim.keep())

    def cut_effort(self) -> bool:
        self._commands.cut()
        return True

    def wait_until_cut(self, within: float) -> None:
        """Wait until the zero has been acknowledged."""
        self._commands.publisher.wait_for_all_acked(Duration(seconds=within))

    def restore_effort(self) -> None:
        self._supervised.note_release(time.perf_counter_ns())
        self._commands.restore()

    def close(self) -> None:
        """Wait until the last command has been acknowledged."""
        self._stopping.wait_until_acknowledged()
        counts = {"samples": self._loop.counts.samples, "missed": self._loop.counts.missed}
        self._status.send("timing", joint=self.joint, **counts, **self._timing.whole())
        self._certification.close()

    def destroy_node(self) -> None:
        """Destroy the node, and the process that certifies, also if it has not begun."""
        super().destroy_node()
        self._certification.close()


CONTROLLER_RECORDS: tuple[type[Record], ...] = (
    LoopSettings,
    ControllerParameters,
    ClaimParameters,
    RobotParameters,
    ManagedParameters,
    StopParameters,
    CertificationParameters,
    RelayParameters,
    IntrospectionParameters,
    Scheduling,
    StatusParameters,
)
"""What a controller's parameters are declared by."""

USAGE = Usage(
    "joint_controller",
    "Controls one joint: states in, effort commands out.",
    "-p joint:=JOINT",
    names_of(*CONTROLLER_RECORDS),
    ["joint_states", "joint_trajectory", "~/setpoint", "~/relay"],
    [
        "joint_commands (or ~/commands, ~/command)",
        "~/reference",
        "~/terms",
        "~/estimate",
        "/diagnostics",
    ],
    ["~/change_state and the others of a managed node"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [JointController()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
