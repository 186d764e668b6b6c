"""Controls one joint: states in, effort commands out."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from hpid_ros.control import LOOP_PARAMETERS, JointLoop, LoopSettings
from hpid_ros.control.joint_loop import LoopState, Setpoint
from hpid_ros.control.parameters import Value
from hpid_ros.errors import MessageError, TrajectoryError
from hpid_ros.messages import JointReader
from hpid_ros.nodes import executor
from hpid_ros.nodes.certification import Certification
from hpid_ros.nodes.commands import COMMAND_INTERFACES, command_sink
from hpid_ros.nodes.diagnostics import OK, WARN, Diagnostics
from hpid_ros.nodes.introspection import Introspection
from hpid_ros.nodes.loop_timing import LoopTiming
from hpid_ros.nodes.model_parameters import effort_limit, require_no_compensation
from hpid_ros.nodes.parameters import declare, merged, read_only, verdict
from hpid_ros.nodes.qos import NEWEST_STATES, RARE, overridable
from hpid_ros.nodes.scheduling import schedule
from hpid_ros.nodes.status_pipe import StatusPipe
from hpid_ros.nodes.trajectories import from_message
from hpid_ros.nodes.trajectory_subscriptions import TrajectorySubscriptions

_READINESS_PERIOD = 0.02  # [s]
_DIAGNOSTICS_PERIOD = 1.0  # [s]
_LAST_COMMAND_WITHIN = Duration(seconds=0.5)
_MANY_MISSED = 0.5  # of the states of a report


class JointController(executor.ClosingNode):
    """The shell around one :class:`~hpid_ros.control.JointLoop`.

    It subscribes to the states once its commands have somebody to hear them (and, when asked,
    once it has a reference): no integral winds up against silence.

    Args:
        name: Node name.
        options: Passed on to ``rclpy.node.Node``.

    Raises:
        HpidError: The parameters given at start cannot be used as a whole.
    """

    def __init__(self, name: str = "joint_controller", **options: Any) -> None:
        super().__init__(name, **options)
        declare(self, LOOP_PARAMETERS.values(), read_only=["joint"])
        self._limit = effort_limit(self)
        self._loop = JointLoop(self._settings(()))
        self.joint = self._loop.settings.joint
        self._reader = JointReader(self.joint)
        interface = read_only(
            self,
            "command_interface",
            "joint_state",
            f"Message of the commands: {', '.join(COMMAND_INTERFACES)}",
        )
        require_no_compensation(self)
        self._listeners = read_only(
            self, "wait_for_command_subscribers", 1, "Subscribers that commands must have first"
        )
        self._needs_reference = read_only(
            self, "wait_for_reference", False, "Do not start before there is a trajectory"
        )
        self._commands = command_sink(self, self.joint, str(interface))
        self._introspection = Introspection(self, self.joint)
        self._diagnostics = Diagnostics(self, self.joint)
        self._status = StatusPipe(self)
        self._certification = Certification(self, self._loop.settings)
        self._timing = LoopTiming()
        self._misread = self._missed = 0
        self._last_fault = ""
        self._subscribe()
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._retune)
        self._scheduling = schedule(self)

    def _subscribe(self) -> None:
        TrajectorySubscriptions(self, self._on_trajectory)
        self.create_subscription(Float64, "~/setpoint", self._on_setpoint, RARE)
        self._states: Any = None
        self._readiness = self.create_timer(_READINESS_PERIOD, self._start_when_ready)
        self.create_timer(_DIAGNOSTICS_PERIOD, self._report)

    def _start_when_ready(self) -> None:
        if self._commands.publisher.get_subscription_count() < self._listeners:
            return
        if self._needs_reference and not self._loop.has_motion:
            return
        self._readiness.cancel()
        self._states = self.create_subscription(
            JointState,
            "joint_states",
            self._on_state,
            NEWEST_STATES,
            raw=True,
            qos_overriding_options=overridable(),
        )
        self._status.send("listening")

    def _on_state(self, raw: bytes) -> None:
        began_ns = time.perf_counter_ns()
        try:
            sample = self._reader.read(raw)
        except MessageError as error:
            self._misread += 1
            self._fault(str(error))
            return
        if sample is None:
            return
        effort = self._loop.step(*sample)
        self._commands.send(sample.stamp_ns, effort)
        self._timing.note(began_ns, time.perf_counter_ns())
        self._introspection.sample(sample.stamp_ns, self._loop)

    def _on_trajectory(self, message: JointTrajectoryMessage) -> None:
        if self.joint not in message.joint_names:
            return
        try:
            self._loop.follow(from_message(message).column(self.joint))
        except TrajectoryError as error:
            self._fault(f"trajectory refused: {error}")

    def _on_setpoint(self, message: Float64) -> None:
        if not -sys.float_info.max <= message.data <= sys.float_info.max:
            self._fault(f"setpoint refused: it must be finite, not {message.data}")
            return
        self._loop.follow(Setpoint(message.data))

    def _settings(self, changes: Sequence[Parameter]) -> LoopSettings:
        return self._limited(merged(self, LOOP_PARAMETERS, changes))

    def _limited(self, values: Mapping[str, Value]) -> LoopSettings:
        """Return checked settings, their efforts within the robot's limit."""
        settings = LoopSettings.from_parameters(values)
        return replace(
            settings,
            u_clamp_max=min(settings.u_clamp_max, self._limit),
            u_clamp_min=max(settings.u_clamp_min, -self._limit),
        )

    def _check(self, changes: Sequence[Parameter]) -> SetParametersResult:
        if not any(change.name in LOOP_PARAMETERS for change in changes):
            return SetParametersResult(successful=True)
        return verdict(merged(self, LOOP_PARAMETERS, changes), self._require)

    def _require(self, values: Mapping[str, Value]) -> None:
        self._certification.require(self._limited(values))

    def _retune(self, changes: Sequence[Parameter]) -> None:
        if any(change.name in LOOP_PARAMETERS for change in changes):
            settings = self._settings(changes)
            self._loop.retune(settings)
            self._certification.accept(settings)

    def _fault(self, line: str) -> None:
        self._last_fault = line
        self.get_logger().warning(line, throttle_duration_sec=1.0)

    def _report(self) -> None:
        loop, counts = self._loop, self._loop.counts
        message = "waiting for a subscriber of the commands" if self._states is None else ""
        message = message or self._certification.warning or self._slowness()
        is_well = loop.state is not LoopState.FAULT and not message
        self._diagnostics.publish(
            OK if is_well else WARN,
            message or loop.state.value,
            {
                "law": loop.settings.law,
                "degree mu": loop.settings.mu,
                "certified degrees": self._certification.degrees,
                "samples": counts.samples,
                "gaps": counts.gaps,
                "missed samples": counts.missed,
                "repeats": counts.repeats,
                "clock resets": counts.resets,
                "saturated samples": counts.saturated,
                "rejected samples": counts.rejected + self._misread,
                "effort [N m]": loop.effort,
                "integral term [N m]": loop.integral,
                "error [rad]": loop.error,
                **self._timing.recent(),
                "scheduling": self._scheduling,
                "last fault": self._last_fault or "none",
            },
        )

    def _slowness(self) -> str:
        """Return a warning when most states of the last report seem lost."""
        missed = self._loop.counts.missed - self._missed
        self._missed += missed
        settings = self._loop.settings
        if missed < _MANY_MISSED * _DIAGNOSTICS_PERIOD / settings.control_period:
            return ""
        return f"states come more slowly than control_period = {settings.control_period:g} s says"

    def close(self) -> None:
        """Leave the joint without effort: the last command is zero, and reliably heard."""
        if self._loop.stamp_ns is not None:
            self._commands.send(self._loop.stamp_ns, 0.0)
            self._commands.publisher.wait_for_all_acked(_LAST_COMMAND_WITHIN)
        counts = {"samples": self._loop.counts.samples, "missed": self._loop.counts.missed}
        self._status.send("timing", joint=self.joint, **counts, **self._timing.whole())
        self._certification.close()


def main(args: Sequence[str] | None = None) -> int:
    """Run one controller."""
    return executor.run(lambda: [JointController()], args)


if __name__ == "__main__":
    sys.exit(main())
