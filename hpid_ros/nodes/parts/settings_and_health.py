"""What a controller is made of: settings, model, certificate, timing, and its health.

Every irregularity is counted and named.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.durations import Durations
from hpid_ros.base.errors import GainError, HpidError, MessageError, SettingError
from hpid_ros.base.names import ALLOW_RELAY
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import of_slide
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.settings import (
    LARGEST_EFFORT,
    LOOP_PARAMETERS,
    MODEL_PARAMETERS,
    PARAMETERS,
    LoopSettings,
    Value,
)
from hpid_ros.messages.joint_state import JointSample, RobotReader
from hpid_ros.nodes.core.middleware import full_name, steady_timer
from hpid_ros.nodes.core.parameters import declare, read
from hpid_ros.nodes.core.status import ERROR, OK, WARN, Diagnostics, log_change
from hpid_ros.nodes.parts.joint_topics import STATES
from hpid_ros.robot.joint_description import UNLIMITED, JointDescription
from hpid_ros.robot.loop_settings import loop_settings
from hpid_ros.robot.on_demand import loop_model
from hpid_ros.stability.certifier import Certifier

if TYPE_CHECKING:
    from hpid_ros.robot.compensation import LoopModel


@dataclass(frozen=True)
class RobotParameters(Record):
    """The robot whose joint is controlled."""

    robot_description: str = quantity(
        "URDF of the robot, XML text or path: limits effort, position and velocity", default=""
    )


def _require_limits(settings: LoopSettings) -> None:
    """Refuse a joint that its description was to limit, and does not."""
    lacks = {
        "effort": settings.effort.largest == LARGEST_EFFORT and "u_clamp_max and u_clamp_min",
        "velocity": math.isinf(settings.motion.fastest) and "velocity_max",
    }
    for limit, parameters in lacks.items():
        if parameters:
            raise SettingError(
                f"robot_description has no {limit} limit for {settings.joint}: give it one, or "
                f"set {parameters}"
            )


_DESCRIBED = {
    "feedforward.viscous_friction": "damping",
    "feedforward.coulomb_friction": "friction",
}


def _refuse_undescribed(parameters: Mapping[str, Any]) -> None:
    for name, described in _DESCRIBED.items():
        if parameters[name] < 0.0:
            raise SettingError(
                f"{name} = -1 takes the {described} in robot_description, which is not given"
            )


def _limits_of(robot: str, joint: str) -> JointDescription:
    """Return a joint of a description; without one, a joint without limits."""
    if not robot:
        return UNLIMITED
    # What reads URDFs is imported where there is one: it takes an XML parser.
    from hpid_ros.robot.description import robot_limits

    return robot_limits(robot, joint)


class ControllerSettings:
    """Makes of a controller's parameters the settings of its loop, within the robot's limits."""

    def __init__(self, node: Node, defaults: Mapping[str, Value] = MappingProxyType({})) -> None:
        self._node = node
        declare(node, [PARAMETERS["joint"]], read_only=["joint"])
        self.robot = read(node, RobotParameters).robot_description
        self._limits = _limits_of(self.robot, str(node.get_parameter("joint").value))
        self.is_slide = self._limits.is_slide
        specs = [spec for name, spec in PARAMETERS.items() if name != "joint"]
        declare(node, specs, MODEL_PARAMETERS, is_slide=self.is_slide, defaults=defaults)
        self._last: tuple[Mapping[str, Value], LoopSettings] | None = None

    def with_changes(self, changes: Sequence[Parameter] = ()) -> LoopSettings:
        """Return the settings that would be active after a change."""
        values = {name: self._node.get_parameter(name).value for name in PARAMETERS}
        values |= {each.name: each.value for each in changes if each.name in LOOP_PARAMETERS}
        if self._last is None or self._last[0] != values:  # checked first, applied afterwards
            settings = loop_settings(values, self._limits, self.robot)
            if self.robot:
                _require_limits(settings)
            else:
                _refuse_undescribed(values)
            self._last = values, settings
        return self._last[1]

    def verdict(
        self, changes: Sequence[Parameter], require: Callable[[LoopSettings], None]
    ) -> SetParametersResult:
        if concern_the_loop(changes):
            try:
                settings = self.with_changes(changes)
                _require_period(settings, self._node.get_parameter("control_period").value)
                require(settings)
            except HpidError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def _require_period(settings: LoopSettings, before: object) -> None:
    period = settings.timing.control_period
    if settings.model.is_decoupling and period != before:
        raise SettingError(
            f"control_period cannot change to {period:g} s with compensation decoupling, whose "
            f"effort filter was made for {before:g} s: start the controller with it"
        )


def concern_the_loop(changes: Sequence[Parameter]) -> bool:
    """Return whether a change is about the loop at all."""
    return any(change.name in LOOP_PARAMETERS for change in changes)


def model_compensation(node: Node, settings: LoopSettings, robot: str) -> ModelCompensation | None:
    """Build the model that a controller's settings ask for, and say in its log what it is."""
    model = loop_model(settings, robot)
    if model is None:
        return None
    node.get_logger().info(model.text)
    return ModelCompensation(model, settings.model.compensation)


class ModelCompensation:
    """Lets a loop answer states with the model's term."""

    def __init__(self, model: LoopModel, kind: str) -> None:
        self._compensator, self._kind = model.compensator, kind
        self.states = model.compensator.states
        self._reader = RobotReader(self.states.joints)

    def answer(self, loop: JointLoop, sample: JointSample, raw: bytes) -> float:
        """Return the effort that answers a state, in [N m].

        A state that the model cannot use is answered with the term of the last one that it
        could, for at most ``state_timeout``; after that the loop gives ``fallback_effort``.
        """
        try:
            robot = self._reader.read(raw)
        except MessageError as error:
            term = self._compensator.hold(sample.stamp_ns, str(error))
        else:
            term = self._compensator.term(sample.stamp_ns, *robot)
        return self._compensator.answer(loop, *sample, term)

    def readings(self) -> Mapping[str, object]:
        """Return what ``/diagnostics`` tells of the model."""
        return {
            "compensation": self._kind,
            "model terms held": self.states.held,
            "states without a model term": self.states.lost,
            "last fault of the model": self.states.last_fault or "none",
        }


_POLL_PERIOD = 0.1  # [s]


@dataclass(frozen=True)
class CertificationParameters(Record):
    """What is made of a degree's certificate."""

    certify: bool = quantity(
        "Find out beside the loop whether its degree is certified", default=True
    )
    require_certificate: bool = quantity(
        "Refuse degrees that are not certified stable", default=False
    )


class Certification:
    """Warns of a degree that is not certified, or refuses it."""

    def __init__(self, node: Node, settings: LoopSettings) -> None:
        asked = read(node, CertificationParameters)
        self._is_on, self._is_required = asked.certify, asked.require_certificate
        self._certifier = Certifier()
        self._settings = settings
        if self._is_required:
            found = self._certifier.wait(settings)
            if not found.is_certified:
                raise GainError(_refusal(settings, found.text))
        elif self._is_on:
            self._certifier.want(settings)
        if self._is_required or self._is_on:
            steady_timer(node, _POLL_PERIOD, self._certifier.poll)

    def require(self, settings: LoopSettings) -> None:
        """Refuse settings that are about to be set, if a certificate is required.

        What is not known yet is refused as well, and begun: the same set succeeds later.
        """
        if not self._is_required:
            return
        found = self._certifier.finding(settings)
        if found.is_certified is None:
            self._certifier.want(settings)
        if not found.is_certified:
            raise GainError(_refusal(settings, found.text))

    def accept(self, settings: LoopSettings) -> None:
        self._settings = settings
        if self._is_on:
            self._certifier.want(settings)

    @property
    def degrees(self) -> str:
        if not self._is_on and not self._is_required:
            return "not asked for"
        return self._certifier.finding(self._settings).text

    @property
    def warning(self) -> str:
        """What to warn of; empty when there is nothing."""
        if self._certifier.finding(self._settings).is_certified is False:
            return f"mu = {self._settings.mu:g} is not certified stable"
        return ""

    def close(self) -> None:
        self._certifier.close()


def _refusal(settings: LoopSettings, degrees: str) -> str:
    if degrees == "being computed":
        return "no certificate yet for these gains: it is being computed, set them again shortly"
    return f"mu = {settings.mu:g} is not certified stable; certified degrees: {degrees}"


class LoopTiming:
    """Wall-clock figures of one controller.

    The period is the time between two states' callbacks; jitter is how far its 99th percentile
    lies above its median. The compute time runs from the bytes of a state in hand to the command
    handed to the middleware.
    """

    def __init__(self) -> None:
        self._periods, self._computes = Durations(), Durations()
        self._note_period, self._note_compute = self._periods.note, self._computes.note
        self.last_ns: int | None = None
        """When the last sample began on a steady clock, in [ns]."""

    def note(self, began_ns: int, ended_ns: int) -> None:
        if self.last_ns is not None:
            self._note_period(began_ns - self.last_ns)
        self.last_ns = began_ns
        self._note_compute(ended_ns - began_ns)

    def interrupt(self) -> None:
        """Take the next sample as the first one: the time until then is no period."""
        self.last_ns = None

    def recent(self) -> dict[str, float]:
        """Return the figures since the last call, with their units, for ``/diagnostics``."""
        period, compute = self._periods.recent(), self._computes.recent()
        return {
            **period.readings("period"),
            "jitter [us]": period.p99 - period.median,
            **compute.readings("compute time"),
        }

    def whole(self) -> dict[str, Any]:
        """Return the figures of the whole run, in [us], for a parent process."""
        return {
            "period": self._periods.whole()._asdict(),
            "compute": self._computes.whole()._asdict(),
        }


_MANY_GAPS = 2  # within a report; one may be a standstill
_LONG_ENOUGH = 0.9  # of the time between two reports, to count in
_NO_LIMIT = 1e6  # as the parameters say it
_MANY_MISSED = 0.5  # of the states of a report
_REFUSAL_REPORTS = 30  # in which a reference that was refused is named, if no good one comes

_ON_FALLBACK = (LoopMode.SILENT, LoopMode.FAULT, LoopMode.CONFLICT)

IN_CONTROL = (LoopMode.HOLDING, LoopMode.FOLLOWING)
"""States of a loop whose law drives the joint."""


class ControllerHealth(Diagnostics):
    """Counts what a controller refused, and publishes its status."""

    period = 1.0  # [s] between two reports

    def __init__(
        self,
        node: Node,
        loop: JointLoop,
        certification: Certification,
        timing: LoopTiming,
        model: ModelCompensation | None = None,
        *,
        is_slide: bool = False,
    ) -> None:
        super().__init__(node, loop.settings.joint)
        self._loop, self._model = loop, model
        self._is_slide = is_slide
        self._certification, self._timing = certification, timing
        self.foreign = self.misread = 0
        self._references = self._refusal_reports = 0
        self._refusal = self._misread_line = ""
        self._samples = 0  # at the last report
        self._missed = self._held = 0
        self.scheduling = ""
        self._gaps, self._slow, self._slowness_at = 0, "", time.monotonic()

    def unit(self, text: str) -> str:
        return of_slide(text) if self._is_slide else text

    def begun(self) -> None:
        """Say once, after the first state, what is active."""
        loop, settings = self._loop, self._loop.settings
        effort, motion = settings.effort, settings.motion
        degree = f" with mu = {settings.mu:g}" if settings.is_homogeneous else ""
        limits = {
            "N m": (effort.u_clamp_min, effort.u_clamp_max),
            "rad": (motion.position_min, motion.position_max),
            "rad/s": (-motion.velocity_max, motion.velocity_max),
        }
        within = [
            f"[{low:g}, {high:g}] {self.unit(unit)}"
            for unit, (low, high) in limits.items()
            if max(-low, high) < _NO_LIMIT
        ]
        log_change(
            self._node,
            f"active: joint {settings.joint}, {settings.law}{degree}, "
            f"{'within ' + ', '.join(within) if within else 'no limits'}; "
            f"{loop.state.mode.value}: {loop.following.position:.6g} {self.unit('rad')}",
        )

    def misread_state(self, line: str) -> None:
        """Note bytes that were no state of this joint."""
        self.misread += 1
        self._misread_line = f"state refused: {line}"
        self.fault(self._misread_line)

    def _misread(self) -> str:
        """Return a warning when all states of the last report were refused."""
        samples, line = self._loop.counts.samples, self._misread_line
        is_all = samples == self._samples
        self._samples, self._misread_line = samples, ""
        return line if is_all else ""

    def conflict(self) -> str:
        """Say where the joint is by two sources, and which nodes publish its states."""
        node = self._node
        topic = node.resolve_topic_name(STATES)
        nodes = sorted({full_name(each) for each in node.get_publishers_info_by_topic(topic)})
        joint, places = self._loop.settings.joint, self.unit(self._loop.sources.conflict)
        return (
            f"states of {joint} come from two sources: {places}; on {topic} publish: "
            f"{', '.join(nodes) or 'nodes that the graph does not know'}"
        )

    def refused_reference(self, line: str) -> None:
        self._references += 1
        self._refusal, self._refusal_reports = f"reference refused: {line}", _REFUSAL_REPORTS
        self.fault(self._refusal)

    def accepted_reference(self) -> None:
        """Warn no more of one that was refused."""
        self._refusal = ""

    def _refused(self) -> str:
        """Return the last reference that was refused, for some reports."""
        if self._loop.dropped:
            self.refused_reference(self._loop.dropped)
            self._loop.dropped = ""
        self._refusal_reports -= 1
        return self._refusal if self._refusal_reports >= 0 else ""

    def relay_begins(self, request: RelayRequest) -> None:
        log_change(
            self._node,
            f"a relay of {request.amplitude:g} {self.unit('N m')} drives the joint for "
            f"{request.cycles:g} cycles, {request.duration:g} s at most",
        )

    def _relay(self) -> str:
        relay = self._loop.relay
        if relay is None:
            return "none"
        course = self.unit(relay.ending) or "under way"
        return f"{course}; {relay.cycles} cycles" + ("" if relay.is_over else "; in force")

    def report(
        self, lifecycle: str, waiting: str, claim: str, refusal: str, standstill: str = ""
    ) -> None:
        loop, counts = self._loop, self._loop.counts
        is_active = lifecycle == "active"
        message, level = loop.state.mode.value, OK
        # each counts from its last call
        recent = self._misread(), self._refused(), self._slowness(), self._model_fault()
        warnings = standstill, self._certification.warning, loop.estimation.warning, *recent
        warning = next(filter(None, warnings), "")
        if not is_active:
            message, level = (f"{lifecycle}: {refusal}", WARN) if refusal else (lifecycle, OK)
        elif loop.state.mode in _ON_FALLBACK:
            if loop.state.mode is LoopMode.CONFLICT:
                message = self.conflict()
            message, level = f"{message}; {warning}" if warning else message, ERROR
        elif loop.state.mode is LoopMode.WAITING or waiting or warning:
            message, level = waiting or warning or message, WARN
        self.publish(
            level,
            message,
            {
                "lifecycle": lifecycle,
                "claim": claim,
                "law": loop.settings.law,
                "degree mu": loop.settings.mu,
                "velocity": loop.estimation.origin,
                "certified degrees": self._certification.degrees,
                "samples": counts.samples,
                "gaps": counts.gaps,
                "missed samples": counts.missed,
                "silences": counts.silences,
                "takeovers": counts.takeovers,
                "position jumps": counts.jumps,
                "state conflicts": counts.conflicts,
                "repeats": counts.repeats,
                "clock resets": counts.resets,
                "saturated samples": counts.saturated,
                "braked samples": loop.law.braked,
                "rejected samples": counts.rejected + self.misread,
                "states of other joints": self.foreign,
                "refused references": self._references,
                "refused requests": self.refused_requests,
                self.unit("effort [N m]"): loop.law.effort,
                self.unit("integral term [N m]"): loop.law.integral,
                self.unit("feedforward [N m]"): loop.feedforward.effort,
                self.unit("error [rad]"): loop.error,
                **self._timing.recent(),
                **(self._model.readings() if self._model else {"compensation": "none"}),
                "relay": self._relay(),
                "relays allowed": self._node.get_parameter(ALLOW_RELAY).value,
                "scheduling": self.scheduling,
                "last fault": self.last_fault,
                "last irregular state": self.unit(loop.last_fault) or "none",
            },
        )

    def _model_fault(self) -> str:
        """Return a warning when the model could not use a state of the last report."""
        if self._model is None:
            return ""
        states = self._model.states
        held, self._held = self._held, states.held
        if self._held > held:
            return f"model terms are held: {states.last_fault}"
        if states.lacks_efforts and self._loop.law.effort:
            return "the efforts of the states are all 0: the model has nothing to go by"
        return ""

    def _slowness(self) -> str:
        """Return a warning when most states of the last second seem lost, or come too late."""
        now = time.monotonic()
        elapsed = now - self._slowness_at
        if elapsed < _LONG_ENOUGH * self.period:  # a timeout is reported in between
            return self._slow
        counts, timing = self._loop.counts, self._loop.settings.timing
        missed, gaps = counts.missed - self._missed, counts.gaps - self._gaps
        self._missed, self._gaps, self._slowness_at = counts.missed, counts.gaps, now
        before, self._slow = self._slow, ""
        if missed >= _MANY_MISSED * elapsed / timing.control_period:
            period = f"control_period = {timing.control_period:g} s"
            self._slow = f"states come more slowly than {period} says"
            if gaps >= _MANY_GAPS:
                self._slow += (
                    f", and than state_timeout = {timing.state_timeout:g} s allows: "
                    f"set both to the robot's"
                )
                if "state_timeout" not in before:
                    self._node.get_logger().warning(self._slow)
        return self._slow
