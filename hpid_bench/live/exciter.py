"""Carries one plan of an excitation out, watches over it, and brings the joints to rest.

It commands no joint: it publishes a trajectory to the controllers, and, when a limit is reached,
when anything comes in between or when it is asked to end, another one on which they stop and
hold. With ``held_within`` it begins when somebody presses a button, and stops when the button is
released. A goal of :class:`~hpid_ros.nodes.parts.goal_follower.GoalFollower` carries the plan out:
it knows the path tolerance, timeouts, other senders, and how joints are stopped.
"""

from __future__ import annotations

import json
import math
import os
import select
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.task import Future
from sensor_msgs.msg import JointState

from hpid_ros.base.errors import HpidError, MessageError, SettingError
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_state import EffortReader, decode_joint_state
from hpid_ros.motion.excitation import ExcitationPlan, PlannedJoint
from hpid_ros.motion.joint_trajectory import PointArrays
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.middleware import (
    ALL_COMMANDS,
    NEWEST_REFERENCE,
    NEWEST_STATES,
    steady_timer,
    subscribe_raw,
)
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import StatusPipe, log_change
from hpid_ros.nodes.parts.goal_follower import GoalFollower, Outcome
from hpid_ros.nodes.parts.goal_graph import GroupTopics
from hpid_ros.nodes.parts.goals import GoalRequest, GroupSettings, JointFacts, ResultCode

_LOOK_PERIOD = 0.05  # [s]
_READY_WITHIN = 15.0  # [s]


@dataclass(frozen=True)
class OrderParameters(Record):
    plan_file: str = quantity("JSON file that hpid has written", default="")


class MovingNode(executor.ClosingNode):
    """A process that moves joints once all is there, and tells its parent how that ended."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        file = read(self, OrderParameters).plan_file
        try:
            self.order: dict[str, Any] = dict(json.loads(Path(file).read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise SettingError(f"plan_file {file!r} cannot be read: {error}") from None
        self.status = StatusPipe(self)
        self._waits_since = time.monotonic()
        self._states = subscribe_raw(self, "joint_states", self.take_state, NEWEST_STATES)
        steady_timer(self, _LOOK_PERIOD, self.look)

    def take_state(self, raw: bytes) -> None:
        """Take a message of the joints' states."""

    def look(self) -> None:
        """Do what is to be done now; called many times a second."""

    def lacking(self) -> str:
        """Return what is missing before anything may move; empty if all is there."""
        infos = self.get_subscriptions_info_by_topic(self._states.topic_name)
        if self.order["recorder"] in {info.node_name for info in infos}:
            return ""
        return "the recorder has not subscribed to joint_states yet"

    def is_ready(self) -> bool:
        """Return whether nothing is missing; after a while that is a failure."""
        lacking = self.lacking()
        if lacking and time.monotonic() - self._waits_since > _READY_WITHIN:
            self.fail(lacking)
        return not lacking

    def fail(self, reason: str) -> None:
        """End without having moved anything."""
        self.status.send("failed", reason=reason)
        self.request_stop(executor.FAILED)


_AT_ONCE = 65536


class DeadMan:
    """Whether the button is held. The end of input says that the writer is gone."""

    def __init__(self, within: float) -> None:
        self._within = within
        self.is_gone = False
        self._input = sys.stdin.fileno()
        self._last = -float("inf")

    def is_held(self) -> bool:
        """Return whether it is held; to be asked more often than a byte must come."""
        now = time.monotonic()
        if self._has_come():
            self._last = now
        return not self.is_gone and now - self._last < self._within

    def forget(self) -> None:
        """Take it for not held until a byte comes."""
        self._has_come()
        self._last = -float("inf")

    def _has_come(self) -> bool:
        has_come = False
        while not self.is_gone and select.select([self._input], [], [], 0.0)[0]:
            try:
                count = len(os.read(self._input, _AT_ONCE))
            except OSError:  # nobody gave it any input
                count = 0
            has_come |= count > 0
            self.is_gone = count == 0
        return has_come


_EFFORT_SHARE = 0.95  # of an effort limit: there the controller does what it can, and no more
_EFFORT_PATIENCE = NANOSECONDS // 20
_BEYOND = 1e-3  # [rad] that noise may take a joint beyond a limit
_STATE_TIMEOUT = 0.5  # [s]


class Watch:
    """Looks at states and efforts of the joints of a plan."""

    def __init__(self, plan: ExcitationPlan) -> None:
        self._joints = plan.joints
        self._loaded_since_ns: list[int | None] = [None] * len(plan.joints)

    def see(
        self,
        stamp_ns: int,
        motions: Sequence[tuple[float, float]],
        efforts: Sequence[float | None],
    ) -> str:
        """Return which limit is reached; empty if none is."""
        for number, planned in enumerate(self._joints):
            line = _motion_beyond(planned, *motions[number])
            line = line or self._effort_beyond(number, stamp_ns, efforts[number])
            if line:
                return f"{planned.bounds.joint} {line}"
        return ""

    def _effort_beyond(self, number: int, stamp_ns: int, effort: float | None) -> str:
        least, largest = self._joints[number].bounds.efforts
        is_within = effort is None or _EFFORT_SHARE * least < effort < _EFFORT_SHARE * largest
        since_ns = self._loaded_since_ns[number]
        if is_within or since_ns is None:
            self._loaded_since_ns[number] = None if is_within else stamp_ns
            return ""
        if stamp_ns - since_ns < _EFFORT_PATIENCE:
            return ""
        unit = "N" if self._joints[number].bounds.is_slide else "N m"
        return f"needs {effort:.4g} {unit}, its limits are {least:.4g} and {largest:.4g} {unit}"


def _motion_beyond(planned: PlannedJoint, position: float, velocity: float) -> str:
    bounds = planned.bounds
    if not bounds.lower - _BEYOND <= position <= bounds.upper + _BEYOND:
        return (
            f"is at {position:.4g} {bounds.unit}, its limits are {bounds.lower:.4g} and "
            f"{bounds.upper:.4g} {bounds.unit}"
        )
    if abs(velocity) > planned.velocity_stop:
        return (
            f"moves at {abs(velocity):.4g} {bounds.unit}/s, it is stopped above "
            f"{planned.velocity_stop:.4g} {bounds.unit}/s"
        )
    return ""


def group_settings(
    plan: ExcitationPlan, takeover_time: float, reference_timeout: float, *, is_simulated: bool
) -> GroupSettings:
    """Return what the goal of a plan is followed under."""
    facts = {
        each.bounds.joint: JointFacts(
            each.bounds.lower, each.bounds.upper, each.bounds.is_endless, unit=each.bounds.unit
        )
        for each in plan.joints
    }
    values: dict[str, float | str] = {
        "state_timeout": _STATE_TIMEOUT,
        "reference_timeout": reference_timeout,
        "takeover_time": takeover_time,
        "state_clock": "simulated" if is_simulated else "wall",
    }
    for each in plan.joints:
        name = f"constraints.{each.bounds.joint}"
        values[f"{name}.trajectory"] = each.tolerance
        values[f"{name}.max_deceleration_on_cancel"] = _deceleration(each)
    return GroupSettings.from_parameters(plan.names, facts, values)


def _deceleration(joint: PlannedJoint) -> float:
    """Return at how much a joint stops, in [rad/s^2] (or m).

    As its motion needs it, and for a slow motion more, within half of what its load leaves.
    """
    bounds = joint.bounds
    spare = min(bounds.efforts[1] - bounds.load, bounds.load - bounds.efforts[0])
    quick = joint.peaks.velocity / _STOPS_IN
    if math.isfinite(spare):
        quick = min(quick, 0.5 * spare / bounds.inertia)
    return max(joint.peaks.acceleration, quick)


def goal_of(
    plan: ExcitationPlan, standing: Sequence[float], ends: Sequence[float] | None = None
) -> GoalRequest:
    """Return the goal that carries a plan out, from where the joints' references stand.

    Where it is given where they shall end, they end there: what they are off at the start, the
    controllers glide over.
    """
    times_ns = np.rint(plan.times * NANOSECONDS).astype(np.int64)
    none = np.full_like(plan.positions, np.nan)
    positions = plan.positions + standing
    if ends is not None:
        positions = plan.positions - plan.positions[-1] + ends
    arrays = PointArrays(positions, plan.velocities, plan.accelerations, none)
    return GoalRequest(plan.names, 0, times_ns, arrays)


_STOPS_IN = 0.5  # [s] from the largest velocity
_PRESSED_WITHIN = 60.0  # [s] from when it is ready
_MOVED = 0.05  # [rad] from where a joint was when its excitation was planned
_AT_REST = 0.02  # [rad/s]
_RESTS_WITHIN = 3.0  # [s] from the request to stop
_STATES_WITHIN = 30.0  # [s] for states to come again, so that joints can be told to hold


class Exciter(MovingNode):
    """The shell around one goal and one watch."""

    def __init__(self) -> None:
        super().__init__("hpid_exciter")
        order = self.order
        self._plan = plan = ExcitationPlan.from_mapping(order["plan"])
        self._ends: list[float] | None = order.get("ends_at")
        self._began_at: list[float] = []  # references of the joints when they began to move
        within = order["held_within"]
        self._button = None if within is None else DeadMan(float(within))
        watched_within = order.get("watched_within")
        self._parent = None if watched_within is None else DeadMan(float(watched_within))
        self._has_said_ready = self._has_begun = False
        references = {
            each.bounds.joint: f"{each.bounds.controller}/reference" for each in plan.joints
        }
        self._follower = GoalFollower(
            group_settings(
                plan,
                float(order["takeover_time"]),
                float(order["reference_timeout"]),
                is_simulated=bool(order["is_simulated"]),
            )
        )
        self._watch = Watch(plan)
        self._standing: dict[str, float] = {}
        self._commanded: dict[str, float] = {}
        self._measured: dict[str, float] = {}
        for topic in references.values():
            self.create_subscription(
                JointState, topic, self._on_reference, NEWEST_REFERENCE, raw=True
            )
        self._efforts = EffortReader()
        subscribe_raw(self, "joint_commands", self._on_command, ALL_COMMANDS)
        self._topics = GroupTopics(
            self,
            self._follower,
            ["joint_states"],
            references,
            act=self._act,
            fault=lambda line: self.get_logger().warning(line, throttle_duration_sec=1.0),
            warn=lambda line: log_change(self, line, is_warning=True),
            note_conflict=lambda line: self.get_logger().error(line) if line else None,
        )
        self._reason, self._ended = "", 0.0
        self._resting: Future | None = None

    def _on_reference(self, raw: bytes) -> None:
        fields = _decoded(raw)
        if fields is not None and len(fields.names) == len(fields.position) == 1:
            self._standing[fields.names[0]] = fields.position[0]

    def take_state(self, raw: bytes) -> None:
        """Take the efforts that were measured; the follower's own subscription takes the rest."""
        if not self._commanded:  # commands are what the limits are of
            fields = _decoded(raw)
            if fields is not None and len(fields.names) == len(fields.effort):
                self._measured.update(zip(fields.names, fields.effort, strict=True))

    def _on_command(self, raw: bytes) -> None:
        try:
            _, names, efforts = self._efforts.read(raw)
        except MessageError:
            return
        self._commanded.update(zip(names, efforts, strict=True))

    def _act(self, outcome: Outcome | None) -> None:
        """Tell controllers what follows from something; look at the limits if nothing does."""
        if outcome is None and self._follower.is_active:
            self._look_at_limits()
            return
        if outcome is None:
            return
        if outcome.trajectory is not None:
            self._topics.publish(outcome.trajectory)
        if outcome.result is not None and not self._resting:
            is_done = outcome.result.code == ResultCode.SUCCESSFUL
            self._rest("" if is_done else outcome.result.text)

    def _look_at_limits(self) -> None:
        feedback = self._follower.feedback()
        if feedback is None:
            return
        efforts = [self._effort(joint) for joint in self._plan.names]
        line = self._watch.see(feedback.stamp_ns, feedback.actual, efforts)
        if line:
            since = feedback.since_start_ns * 1e-9
            self._act(self._follower.leave(f"{line}; at {since:.3g} s"))

    def _effort(self, joint: str) -> float | None:
        effort = self._commanded.get(joint, self._measured.get(joint, math.nan))
        return effort if math.isfinite(effort) else None

    def _rest(self, reason: str) -> None:
        """Wait until the joints are at rest, and end then."""
        self._reason, self._ended = reason, time.monotonic()
        self._resting = Future()

    def look(self) -> None:
        """Begin when all is ready, go on while the button is held, end when joints rest."""
        if self._resting is not None:
            patience = _STATES_WITHIN if self._follower.holds_later else _RESTS_WITHIN
            if self._is_at_rest() or time.monotonic() - self._ended > patience:
                self._finish(self._resting)
            return
        is_watched = self._parent is None or self._parent.is_held()
        if not self._has_begun:
            if is_watched:
                self._begin_when_ready()
            return
        if self._button is not None and not self._button.is_held():
            self._act(self._follower.leave("the button was released"))
        if not is_watched:
            self._act(self._follower.leave("the command that watches it was stopped"))
        feedback = self._follower.feedback()
        if feedback is not None:
            self.status.send("at", seconds=feedback.since_start_ns * 1e-9)

    def _is_at_rest(self) -> bool:
        """Return whether all joints rest; those that nobody could tell to stop may not."""
        if self._follower.holds_later or time.monotonic() - self._ended < 2.0 * _LOOK_PERIOD:
            return False
        joints = range(len(self._plan.joints))
        return all(self._follower.speed(joint) < _AT_REST for joint in joints)

    def _finish(self, resting: Future) -> None:
        if not resting.done():
            event = "stopped" if self._reason else "done"
            self._tell_end(event, is_at_rest=self._is_at_rest())
            resting.set_result(None)
            self.request_stop(executor.FAILED if self._reason else 0)

    def _tell_end(self, event: str, *, is_at_rest: bool) -> None:
        self.status.send(
            event, reason=self._reason, is_at_rest=is_at_rest, began_at=self._began_at
        )

    def _begin_when_ready(self) -> None:
        button = self._button
        if button is not None and not button.is_held() and button.is_gone:
            self._leave_unmoved("the button was released before anything moved")
            return
        if not self.is_ready() or (button is not None and not self._is_pressed(button)):
            return
        try:
            standing = [self._standing[joint] for joint in self._plan.names]
            self._require_unmoved(standing)
            begun = self._follower.begin(goal_of(self._plan, standing, self._ends))
        except HpidError as error:
            self.fail(str(error))
            return
        self._has_begun, self._began_at = True, standing
        self._act(begun)
        self.status.send("begun")

    def _is_pressed(self, button: DeadMan) -> bool:
        """Say once that all is ready, and return whether the button has been pressed since."""
        if not self._has_said_ready:
            self._has_said_ready, self._waits_since = True, time.monotonic()
            button.forget()
            self.status.send("ready")
        if button.is_held():
            return True
        if time.monotonic() - self._waits_since > _PRESSED_WITHIN:
            self._leave_unmoved(f"nobody pressed the button within {_PRESSED_WITHIN:g} s")
        return False

    def _leave_unmoved(self, reason: str) -> None:
        """End, with every joint as it was."""
        self._reason = reason
        self.request_stop(executor.FAILED)

    def lacking(self) -> str:
        """Return what is missing before the joints may move; empty if all is there."""
        against = self._follower.reason_against()
        if against:
            return against
        for planned in self._plan.joints:
            if planned.bounds.joint not in self._standing:
                return (
                    f"{planned.bounds.controller} publishes no ~/reference: it must be active, "
                    f"with an introspection_rate other than 0"
                )
        controllers = {each.bounds.controller for each in self._plan.joints}
        deaf = controllers - self._topics.subscribers()
        if deaf:
            return (
                f"{', '.join(sorted(deaf))} do not subscribe to this joint_trajectory (namespace "
                f"or remapping)"
            )
        return super().lacking()

    def _require_unmoved(self, standing: Sequence[float]) -> None:
        """Refuse joints that are not where they were when this was planned."""
        for planned, reference in zip(self._plan.joints, standing, strict=True):
            bounds = planned.bounds
            off = reference - bounds.position
            if bounds.is_endless:
                off = math.remainder(off, math.tau)
            if abs(off) > max(_MOVED, planned.tolerance):
                raise SettingError(
                    f"{bounds.joint} was at {bounds.position:.4g} {bounds.unit} when this was "
                    f"planned, and its reference is at {reference:.4g} {bounds.unit} now"
                )

    def begin_stop(self) -> Future | None:
        self.stop_now()
        return self._resting

    def stop_now(self) -> None:
        self._act(self._follower.leave("it was interrupted"))

    def close(self) -> None:
        """Wait until the last trajectory has been heard, and say how it ended if nobody has."""
        self._topics.wait_until_acknowledged()
        if self._resting is None or not self._resting.done():
            is_at_rest = not self._has_begun or self._is_at_rest()
            self._tell_end("stopped", is_at_rest=is_at_rest)


def _decoded(raw: bytes) -> Any:
    try:
        return decode_joint_state(raw)
    except MessageError:
        return None


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [Exciter()], args)


if __name__ == "__main__":
    sys.exit(main())
