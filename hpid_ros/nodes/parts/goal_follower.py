"""A goal from its start to success, abort or stop, one at a time.

The controllers are asked for nothing: the code that follows a trajectory in each of them
(:class:`~hpid_ros.control.following.Following`) runs here once more, fed with the same
trajectories and stamps. They differ by when exactly a controller took a trajectory up, which fades
with the glide. What controllers publish of their references is used where they were sent nothing.

All time enters with the stamps of the states. Source of the rules: ``ros2_controllers``,
``joint_trajectory_controller/src/joint_trajectory_controller.cpp``, functions ``update``,
``goal_cancelled_callback`` and ``goal_accepted_callback``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.following import Following
from hpid_ros.control.reference import (
    GRACE_NS,
    LARGEST_POSITION,
    require_timely,
    whole_turns,
)
from hpid_ros.control.sources import SourceBounds, SourceWatch, source_bounds
from hpid_ros.control.supervision import standing_stamps
from hpid_ros.control.velocity import MeasuredVelocity, Unwrapper
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.motion.joint_trajectory import Column, Knot, SplineReference, checked_column
from hpid_ros.nodes.parts.goals import (
    LEAD_NS,
    Braking,
    GoalError,
    GoalRequest,
    GoalResult,
    GroupSettings,
    GroupTrajectory,
    JointFacts,
    ResultCode,
    Tolerance,
    Tolerances,
    coast_down,
    for_all_joints,
    require_inside,
    return_to,
    stop_together,
)

_AGREES_WITHIN = 0.01  # [rad]; a controller whose reference is further off follows something else

_VELOCITY_FILTER = 0.05  # [s], for states without velocities: one count of an encoder is no motion


Error = tuple[float, float]
"""Reference minus measurement: of the position in [rad] or [m], of the velocity per second."""


class Feedback(NamedTuple):
    """How a goal is doing, at the newest state."""

    stamp_ns: int  # [ns] of that state
    since_start_ns: int  # [ns] how long the goal has been under way
    # position, velocity and acceleration of each joint's reference
    desired: tuple[Sequence[float], ...]
    actual: tuple[tuple[float, float], ...]  # measured position and velocity of each joint
    error: tuple[Error, ...]  # their differences, reference minus measured


class _Overdue(NamedTuple):
    """Whose state or reference is missed; nothing if none is."""

    joint: str = ""
    newest_ns: int | None = None  # stamp of the newest one
    reason: str = ""
    timeout_ns: int = 0  # [ns] how old it may be


class _Joint:
    """One joint of the group: its newest state, and its reference."""

    def __init__(
        self, name: str, facts: JointFacts, takeover_time: float, bounds: SourceBounds
    ) -> None:
        self.sources = SourceWatch(bounds)
        self.name, self.unit, self.is_endless = name, facts.unit, facts.is_endless
        self._takeover_time = takeover_time
        self._source = MeasuredVelocity(_VELOCITY_FILTER)
        self._unwrapper = Unwrapper(math.tau) if facts.is_endless else None
        self._following = Following()
        self._following.turn = math.tau if facts.takes_shorter_way else 0.0
        self.restart()

    def restart(self) -> None:
        """Forget everything but the sources: the next state is the first one."""
        self.stamp_ns: int | None = None
        self.reference_ns: int | None = None  # of what its controller published last
        self.position = self.velocity = 0.0
        # Of the active goal:
        self.desired: Sequence[float] = ()  # the reference at the newest state
        self.error: Error = (0.0, 0.0)
        self.has_ended = False
        self.outside_since_ns: int | None = None  # when its controller began to disagree
        self.plan: SplineReference | None = None  # what it asks of the joint
        self._source.reset()
        if self._unwrapper is not None:
            self._unwrapper.reset()
        self._following.follow(None)
        self._following.restart()

    def take(self, stamp_ns: int, position: float, velocity: float | None) -> None:
        before_ns, self.stamp_ns, self.position = self.stamp_ns, stamp_ns, position
        since = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
        steady = position if self._unwrapper is None else self._unwrapper.update(position)
        if velocity is not None and not -LARGEST_POSITION <= velocity <= LARGEST_POSITION:
            velocity = None  # drivers fill in NaN for what they do not measure
        self.velocity = self._source.update(steady, velocity, since)

    @property
    def is_known(self) -> bool:
        """Whether it is known where the reference is."""
        return self._following.has_reference

    def rest(self, position: float) -> None:
        """Let the reference be at a position, at rest."""
        self._following.follow(None)
        self._following.stand(position)

    def follow(self, column: Column, now_ns: int) -> None:
        """Let the reference follow a trajectory from now on; it must be known where it is."""
        self.sample(now_ns)
        self._following.follow(column)
        self.sample(now_ns)

    def sample(self, stamp_ns: int) -> Sequence[float]:
        """Return the reference (position, velocity, acceleration), and go on from there."""
        return self._following.sample(stamp_ns, self._takeover_time, None)

    def peek(self, stamp_ns: int) -> Sequence[float]:
        """Return the same of any instant, and leave everything as it is."""
        return copy(self._following).sample(stamp_ns, self._takeover_time, None)

    def turns_to(self, column: Column, now_ns: int) -> float:
        """Return the whole turns that lead to a trajectory the shorter way, in [rad]."""
        away = self.peek(now_ns)[0] - column.target(now_ns)
        return whole_turns(away, self._following.turn)

    def off(self, position: float, other: float) -> float:
        """Return a difference of positions; that of an endless joint is the shorter way round."""
        off = position - other
        return math.remainder(off, math.tau) if self.is_endless else off

    def compare(self, desired: Sequence[float]) -> None:
        self.desired = desired
        self.error = self.off(desired[0], self.position), desired[1] - self.velocity

    def violation(self, tolerances: Mapping[str, Tolerance]) -> str:
        line = tolerances[self.name].violation(*self.error, self.unit)
        return f"{self.name} is {line}" if line else ""


class _ActiveGoal(NamedTuple):
    """A goal under way."""

    begun_ns: int  # [ns] when it was taken
    start_ns: int  # [ns] when its trajectory starts
    end_ns: int  # [ns] its last point
    tolerances: Tolerances

    def is_late(self, now_ns: int) -> bool:
        """Return whether the time has passed in which the tolerances had to be met."""
        late_ns = round(self.tolerances.goal_time * NANOSECONDS)
        return bool(late_ns) and now_ns > self.end_ns + late_ns


_SETTLES_WITHIN = 0.5  # [s] after takeover_time, for a controller to follow what it was sent
_WALL_GAP, _SIMULATED_GAP = 1.5, 10.0  # [s] that lost states explain, more in a fast simulation
_CROSSES_WITHIN_NS = NANOSECONDS // 10  # for messages of two senders to arrive in either order

CANCELLED = GoalResult(ResultCode.SUCCESSFUL, "cancelled: the joints stop and hold")
"""The result of a goal that its client has cancelled; the code is JTC's."""


class Outcome(NamedTuple):
    """What follows from something that happened."""

    result: GoalResult | None  # how the goal that was active has ended
    trajectory: GroupTrajectory | None  # what is to be published to the controllers now


class GoalFollower:
    """Follows one goal at a time with all joints of a group.

    Every input returns what follows from it, for the caller to publish and to answer.
    """

    def __init__(self, settings: GroupSettings) -> None:
        self.settings = settings
        self.now_ns: int | None = None  # the control clock; None before the first state
        self.unusable = 0  # positions that were not finite
        self.conflict = ""  # which joint has states from two sources; empty if none has
        fixed = settings.fixed
        bounds = source_bounds(
            timeout=fixed.state_timeout, is_simulated=fixed.state_clock == "simulated"
        )
        self._joints = [
            _Joint(name, facts, fixed.takeover_time, bounds)
            for name, facts in zip(settings.joints, settings.facts, strict=True)
        ]
        self._active: _ActiveGoal | None = None
        self._silence = 0.0  # [s] of the wall clock; 0 while states come
        self._repeats = 0  # of states, since the last new one
        self._late_by = 0.0  # [s]; 0 while nothing is to be excused
        self._has_published = False
        self._held_late: set[int] = set()  # joints that are to be stopped once they have states
        self._held_since_ns: int | None = None
        self._late_until_ns = 0
        self._missed = _Overdue()
        self._ahead: set[int] = set()  # joints whose last state was too far ahead

    @property
    def is_active(self) -> bool:
        return self._active is not None

    @property
    def holds_later(self) -> bool:
        """Whether joints are yet to be stopped, once they have states."""
        return bool(self._held_late)

    @property
    def standstill(self) -> str:
        """What is said of states whose stamps stand still; empty while they do not."""
        if not self._silence or self.now_ns is None:
            return ""
        return standing_stamps(self.now_ns, self._repeats)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Joints of which no state has come."""
        return tuple(joint.name for joint in self._joints if joint.stamp_ns is None)

    def reason_against(self) -> str:
        """Return why no goal can be followed now; empty if one can be."""
        if self.conflict:
            return self.conflict
        if self._silence:
            line = f"there has been no new state for {self._silence:.3g} s"
            return f"{line}: {self.standstill}" if self.standstill else line
        return self._overdue().reason

    def begin(self, request: GoalRequest) -> Outcome:
        """Begin with a goal, in place of the one that is followed."""
        settings, joints = self.settings, self._joints
        tolerances = request.require_group(settings)
        if against := self.reason_against():
            raise GoalError(against)
        request.require_positions(settings, [joint.position for joint in joints])
        now_ns = self._now()
        start_ns = request.start(now_ns)
        for joint in joints:
            if not joint.is_known:
                joint.rest(joint.position)
        taken_ns = max(start_ns, now_ns)  # until then they go on with what they follow
        standing = [joint.peek(taken_ns) for joint in joints]
        rest = [self._rest(at, *each[:2]) for at, each in enumerate(standing)]
        nearest = self._nearest(request, start_ns, taken_ns)
        settling = settings.fixed.takeover_time
        trajectory = for_all_joints(
            nearest,
            settings.joints,
            start_ns,
            now_ns,
            standing=standing,
            rest=rest,
            settling=settling,
        )
        added = len(trajectory.times_ns) - len(request.times_ns)
        plans = [
            trajectory.column(at).start(taken_ns, *each[:2]) for at, each in enumerate(standing)
        ]
        for joint, plan in zip(joints, plans, strict=True):
            if joint.name in request.names:
                facts = settings.facts[settings.joints.index(joint.name)]
                require_inside(plan, facts, joint.position, joint.name, added)
        is_replaced = self._active is not None
        self._held_late.clear()  # it takes all joints on
        self._follow(trajectory, now_ns)
        for joint, plan in zip(joints, plans, strict=True):
            joint.compare(joint.peek(now_ns))
            joint.has_ended, joint.outside_since_ns, joint.plan = False, None, plan
        self._active = _ActiveGoal(now_ns, trajectory.stamp_ns, trajectory.end_ns, tolerances)
        replaced = GoalResult(ResultCode.INVALID_GOAL, "replaced by a new goal")
        return Outcome(replaced if is_replaced else None, trajectory)

    def cancel(self) -> Outcome:
        return self._end(CANCELLED)

    def leave(self, reason: str) -> Outcome:
        """End the active goal because its follower ends, and stop.

        Joints whose states have not come back are sent to where they were seen last: else their
        controllers, once they have states, would go on with the trajectory that was aborted. One
        whose controller has published a reference since then is held at that.
        """
        if self.now_ns is None:
            return self._abort(reason)
        seen = [at for at in sorted(self._held_late) if self._joints[at].stamp_ns is not None]
        self._held_late.clear()
        if not seen:
            return self._abort(reason)
        return Outcome(None, self._stop({at: [Knot(0, self._newest(at), 0.0)] for at in seen}))

    def yield_joints(
        self, joints: Collection[str], window_ns: tuple[int, int] | None = None
    ) -> Outcome:
        """End the active goal because another node has sent its joints a trajectory.

        One that has ended, or starts too far ahead, is refused by controllers, and ends nothing.
        A joint follows the newest trajectory. So those joints are left alone, and the others stop.
        Without a goal, those that would have been stopped with the next state are not.
        Where two trajectories were sent at once, each controller may have received them in
        another order: all joints of this group stop.
        """
        if window_ns is not None and self.now_ns is not None:
            try:
                require_timely("the trajectory", window_ns, self.now_ns, GRACE_NS)
            except TrajectoryError:
                return Outcome(None, None)
        others = {at: joint for at, joint in enumerate(self._joints) if joint.name in joints}
        self._held_late -= others.keys()
        if self._active is None and len(others) == len(self._joints):
            self._has_published = False  # nothing that is followed is of this node
        if self._active is None or not others:
            return Outcome(None, None)
        names = ", ".join(joint.name for joint in others.values())
        line = f"another node has sent a trajectory for {names}"
        if self._now() - self._active.begun_ns < _CROSSES_WITHIN_NS:
            return self._abort(f"{line} at the same time: the joints stop")
        for joint in others.values():
            joint.rest(joint.peek(self._now())[0])  # until its controller publishes its own
        return self._abort(line, left_alone=others)

    def note_timeout(self, silence: float) -> Outcome | None:
        """Note that no new state has come for too long."""
        self._silence = silence
        if self._active is None or self.settings.fixed.state_clock == "simulated":
            return None
        # Where the joints are is not known: they stop when states come again.
        self._active = None
        self._hold_later()
        line = f"there was no new state for {silence:.3g} s"
        line = f"{line}: {self.standstill}" if self.standstill else line
        return Outcome(GoalResult(ResultCode.INVALID_GOAL, line), None)

    def allow_late(self, stood: float) -> None:
        """Note that this process stood still: what came meanwhile comes late, and not in order.

        Until a state or a reference had its time to come, it is not missed. The first state that
        comes may still be one from before.
        """
        self._late_by = max(stood, self._late_by)

    def take_state(self, stamp_ns: int, parts: Sequence[JointPart]) -> Outcome | None:
        """Take the joints of one state; where a joint is by two sources nobody can tell."""
        if not parts:
            return None
        usable = [part for part in parts if not self._is_split(stamp_ns, part)]
        if len(usable) < len(parts):
            return self._note_conflict()
        if self.conflict:
            self._note_conflict()
        stamps_ns = [self._joints[part.joint].stamp_ns for part in parts]
        if any(before_ns is not None and stamp_ns < before_ns for before_ns in stamps_ns):
            return self._restart(stamp_ns, parts)
        line = ""
        if self._is_ahead(stamp_ns):
            line = self._believe_jump(stamp_ns, parts[0].joint)
            if not line:
                return None
        elif self._ahead:
            self._ahead.discard(parts[0].joint)
        taken = self._take(stamp_ns, parts)
        if not taken:
            return None
        self._silence, self._repeats = 0.0, 0
        if line and self._active is not None:
            # By the new clock the trajectory is elsewhere, or over: where it was no joint knows.
            self._active = None
            self._hold_later()
            held = self._hold()
            trajectory = None if held is None else held.trajectory
            return Outcome(GoalResult(ResultCode.INVALID_GOAL, line), trajectory)
        if self._late_by:
            self._late_until_ns = stamp_ns + round(self._late_by * NANOSECONDS)
            self._late_by = 0.0
        if self._held_late:
            return self._hold()
        return None if self._active is None else self._look(self._active, stamp_ns, taken)

    def _is_ahead(self, stamp_ns: int) -> bool:
        """Tell whether a stamp is further from the newest one than any pause explains."""
        if self.now_ns is None or self._late_by:
            return False
        gap = _SIMULATED_GAP if self.settings.fixed.state_clock == "simulated" else _WALL_GAP
        gap_ns = max(round(gap * NANOSECONDS), self._state_timeout_ns)
        return stamp_ns > max(self.now_ns, self._late_until_ns) + gap_ns

    def _believe_jump(self, stamp_ns: int, joint: int) -> str:
        """Return a line about a clock that has jumped ahead; a single stamp may be wrong."""
        if joint not in self._ahead:
            self._ahead.add(joint)
            return ""
        self._ahead.clear()
        ahead = (stamp_ns - self._now()) / NANOSECONDS
        return f"the clock of the states jumped ahead by {ahead:.6g} s"

    def _is_split(self, stamp_ns: int, part: JointPart) -> bool:
        at, position, _ = part
        if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
            return False
        return self._joints[at].sources.take(stamp_ns, position)

    def _note_conflict(self) -> Outcome | None:
        """Note which joints have states from two sources; such a goal is aborted.

        Its joints stop where they are found when each has one source again.
        """
        lines = []
        for joint in self._joints:
            if joint.sources.is_split:
                one, other = joint.sources.positions
                places = f"one says {one:.4g} {joint.unit}, one {other:.4g} {joint.unit}"
                lines.append(f"states of {joint.name} come from two sources: {places}")
        self.conflict = "; ".join(lines)
        if not lines or self._active is None:
            return None
        self._active = None
        self._hold_later()
        return Outcome(GoalResult(ResultCode.INVALID_GOAL, self.conflict), None)

    def take_reference(self, at: int, stamp_ns: int, position: float) -> Outcome | None:
        """Take a reference that a controller has published."""
        joint = self._joints[at]
        before_ns, joint.reference_ns = joint.reference_ns, stamp_ns
        if before_ns is not None and stamp_ns < before_ns:
            return None  # the clock has gone back, which the states show, too
        if not joint.is_known:
            joint.rest(position)
            return None
        there, velocity, _ = joint.peek(stamp_ns)
        if self._active is not None:
            return self._watch(joint, stamp_ns, position, joint.off(position, there))
        off = position - there  # whole turns count: the next goal begins where references are
        if abs(off) > _AGREES_WITHIN or (off and velocity == 0.0):
            joint.rest(position)
        return None

    def speed(self, at: int) -> float:
        """Return how fast a joint was at its last state, in [rad/s] or [m/s]."""
        return abs(self._joints[at].velocity)

    def feedback(self) -> Feedback | None:
        active, joints = self._active, self._joints
        if active is None or self.now_ns is None:
            return None
        return Feedback(
            self.now_ns,
            max(self.now_ns - active.start_ns, 0),
            tuple(joint.desired for joint in joints),
            tuple((joint.position, joint.velocity) for joint in joints),
            tuple(joint.error for joint in joints),
        )

    def _now(self) -> int:
        assert self.now_ns is not None  # there are states
        return self.now_ns

    def _take(self, stamp_ns: int, parts: Sequence[JointPart]) -> list[int]:
        """Take what is new of a state, and return whose it is."""
        taken = []
        for at, position, velocity in parts:
            joint = self._joints[at]
            if stamp_ns == joint.stamp_ns:
                self._repeats += 1
                continue
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                self.unusable += 1
                continue
            joint.take(stamp_ns, position, velocity)
            taken.append(at)
        if taken and (self.now_ns is None or stamp_ns > self.now_ns):
            self.now_ns = stamp_ns
        return taken

    @property
    def _state_timeout_ns(self) -> int:
        return round(self.settings.fixed.state_timeout * NANOSECONDS)

    def _overdue(self) -> _Overdue:
        """Return which joint has no state or an old one, or whose controller is silent."""
        timeout_ns = self._state_timeout_ns
        for joint in self._joints:
            if joint.stamp_ns is None or self.now_ns is None:
                return _Overdue(joint.name, None, f"there is no state of {joint.name} yet")
            age_ns = self.now_ns - joint.stamp_ns
            if age_ns > timeout_ns:
                line = f"{joint.name} has had no state for {age_ns / NANOSECONDS:.3g} s"
                return _Overdue(joint.name, joint.stamp_ns, line, timeout_ns)
        timeout_ns = round(self.settings.fixed.reference_timeout * NANOSECONDS)
        for joint in self._joints if timeout_ns else ():
            if joint.reference_ns is None:
                continue
            age_ns = self._now() - joint.reference_ns
            if age_ns > timeout_ns:
                age = age_ns / NANOSECONDS
                line = f"the controller of {joint.name} has published no reference for {age:.3g} s"
                return _Overdue(joint.name, joint.reference_ns, line, timeout_ns)
        return _Overdue()

    def _look(self, active: _ActiveGoal, stamp_ns: int, taken: Sequence[int]) -> Outcome | None:
        """Compare the joints of a state with their references, and with the tolerances."""
        violated: dict[int, str] = {}
        for at in taken:
            joint = self._joints[at]
            followed, plan = joint.sample(stamp_ns), joint.plan
            # Against the goal's own plan, not against what a glide onto it makes of it.
            has_begun = plan is not None and stamp_ns >= active.start_ns
            joint.compare(plan.sample(stamp_ns) if plan is not None and has_begun else followed)
            joint.has_ended = stamp_ns >= active.end_ns
            line = joint.violation(active.tolerances.path)
            if line and has_begun and not joint.has_ended:
                violated[at] = line
        if violated:
            return self._violate(ResultCode.PATH_TOLERANCE_VIOLATED, active, violated)
        overdue = self._overdue()
        if all(joint.has_ended for joint in self._joints):
            lines = [joint.violation(active.tolerances.goal) for joint in self._joints]
            violated = {at: line for at, line in enumerate(lines) if line}
            # Whoever has fallen behind may see the end before it sees that a controller is gone.
            if not violated and not overdue.reason:
                self._active = None
                return Outcome(GoalResult(ResultCode.SUCCESSFUL, "goal reached"), None)
            if violated and active.is_late(self._now()):
                return self._violate(ResultCode.GOAL_TOLERANCE_VIOLATED, active, violated)
        if stamp_ns < self._late_until_ns + overdue.timeout_ns:
            return None
        if not self.misses:
            self._missed = overdue
        return None

    @property
    def misses(self) -> bool:
        """Whether something seems to be overdue: :meth:`confirm` is to be called.

        Where this process has fallen behind it may have come already: so not before all is taken
        that waits now.
        """
        return bool(self._missed.reason)

    def confirm(self) -> Outcome | None:
        """End the active goal if what was missed has not come meanwhile."""
        missed, self._missed = self._missed, _Overdue()
        if self._late_by:  # stood still since: what has not come may still do so
            return None
        overdue = self._overdue() if self._active is not None else _Overdue()
        is_missed = bool(overdue.reason) and overdue[:2] == missed[:2]
        return self._abort(overdue.reason) if is_missed else None

    def _violate(
        self, code: ResultCode, active: _ActiveGoal, violated: Mapping[int, str]
    ) -> Outcome:
        """Abort: joints that are off are held where they are, the others stop."""
        since = (self._now() - active.start_ns) / NANOSECONDS
        whole = (active.end_ns - active.start_ns) / NANOSECONDS
        line = f"{'; '.join(violated.values())}; at {since:.3g} s of {whole:.3g} s"
        return self._end(GoalResult(code, line), violated)

    def _watch(self, joint: _Joint, stamp_ns: int, position: float, off: float) -> Outcome | None:
        """Abort if a controller follows something else for longer than a glide takes."""
        if abs(off) <= _AGREES_WITHIN:
            joint.outside_since_ns = None
            return None
        if joint.outside_since_ns is None:
            joint.outside_since_ns = stamp_ns
        outside = (stamp_ns - joint.outside_since_ns) / NANOSECONDS
        if outside <= self.settings.fixed.takeover_time + _SETTLES_WITHIN:
            return None
        joint.rest(position)
        return self._abort(
            f"the reference of {joint.name}'s controller is at {position:.6g} {joint.unit}, "
            f"{abs(off):.4g} {joint.unit} from this goal: it follows something else, or ends at a "
            "stop"
        )

    def _restart(self, stamp_ns: int, parts: Sequence[JointPart]) -> Outcome | None:
        """Abort because the clock went back; on a simulated one controllers begin again."""
        back = (self._now() - stamp_ns) / NANOSECONDS
        for joint in self._joints:
            joint.restart()
        self.now_ns, self._late_until_ns = None, 0
        was_active, self._active = self._active, None
        if self._has_published:
            self._hold_later()
        self._take(stamp_ns, parts)
        outcome = self._hold() if self._held_late else None
        if was_active is None:
            return outcome
        line = f"the clock of the states went back by {back:.3g} s"
        trajectory = outcome.trajectory if outcome is not None else None
        return Outcome(GoalResult(ResultCode.INVALID_GOAL, line), trajectory)

    def _hold_later(self) -> None:
        """Have all joints stopped where they are found, as that is not known now."""
        self._held_late, self._held_since_ns = set(range(len(self._joints))), None

    def _hold(self) -> Outcome | None:
        """Stop joints from where they are: together, or those that have states in time."""
        now_ns, timeout_ns = self.now_ns, self._state_timeout_ns
        if now_ns is None:
            return None
        if self._held_since_ns is None:
            self._held_since_ns = now_ns
        stamps_ns = {at: self._joints[at].stamp_ns for at in self._held_late}
        found = {
            at
            for at, stamp_ns in stamps_ns.items()
            if stamp_ns is not None and stamp_ns >= max(self._held_since_ns, now_ns - timeout_ns)
        }
        is_late = now_ns - self._held_since_ns > timeout_ns
        if not found or (found != self._held_late and not is_late):
            return None
        self._held_late -= found
        knots = {}
        for at in sorted(found):
            position, velocity = self._settle(at), self._joints[at].velocity
            ahead = position + velocity * LEAD_NS * SECONDS_PER_NANOSECOND
            knots[at] = coast_down(position, velocity, (ahead, velocity), self._braking(at))
        return Outcome(None, self._stop(knots))

    def _settle(self, at: int) -> float:
        """Let a joint's reference rest where the joint was seen last, and return that."""
        joint = self._joints[at]
        position = joint.position
        if joint.is_endless and joint.is_known:  # in the turn in which the reference is
            there = joint.peek(self._now())[0]
            position = there - joint.off(there, position)
        joint.rest(position)
        return position

    def _newest(self, at: int) -> float:
        """Let a joint's reference rest at its controller's newest, or where the joint was seen."""
        joint = self._joints[at]
        if joint.reference_ns is None or joint.reference_ns <= (joint.stamp_ns or 0):
            return self._settle(at)
        position = joint.peek(joint.reference_ns)[0]
        joint.rest(position)
        return position

    def _abort(self, line: str, left_alone: Collection[int] = ()) -> Outcome:
        return self._end(GoalResult(ResultCode.INVALID_GOAL, line), left_alone=left_alone)

    def _end(
        self, result: GoalResult, blocked: Collection[int] = (), left_alone: Collection[int] = ()
    ) -> Outcome:
        """End the active goal and stop all joints but some; those that are blocked are held."""
        if self._active is None:
            return Outcome(None, None)
        self._active, now_ns = None, self._now()
        knots = {}
        for at, joint in enumerate(self._joints):
            if at in left_alone:
                continue
            position, velocity, _ = joint.peek(now_ns)
            if at in blocked:
                target = position - joint.off(position, joint.position)
                knots[at] = return_to(target, position, velocity, self._braking(at))
            else:
                later = joint.peek(now_ns + LEAD_NS)
                knots[at] = coast_down(position, velocity, (later[0], later[1]), self._braking(at))
        return Outcome(result, self._stop(knots) if knots else None)

    def _stop(self, knots: Mapping[int, Sequence[Knot]]) -> GroupTrajectory:
        now_ns = self._now()
        names = [self._joints[at].name for at in knots]
        trajectory = stop_together(names, list(knots.values()), now_ns)
        self._follow(trajectory, now_ns)
        return trajectory

    def _follow(self, trajectory: GroupTrajectory, now_ns: int) -> None:
        self._has_published = True
        joints = {joint.name: joint for joint in self._joints}
        for column, name in enumerate(trajectory.names):
            joints[name].follow(trajectory.column(column), now_ns)

    def _nearest(self, request: GoalRequest, start_ns: int, now_ns: int) -> GoalRequest:
        """Return a goal as whole turns away as its joints are that take the shorter way to it.

        Its points keep their differences: turns within it are turns that are meant.
        """
        away = []
        for at, name in enumerate(request.names):
            column = checked_column(name, at, start_ns, request.times_ns, request.arrays)
            joint = self._joints[self.settings.joints.index(name)]
            away.append(joint.turns_to(column, now_ns))
        if not any(away):
            return request
        arrays = request.arrays
        return replace(request, arrays=arrays._replace(positions=arrays.positions + away))

    def _braking(self, at: int) -> Braking:
        settings, facts = self.settings, self.settings.facts[at]
        return Braking(
            settings.decelerations[at], settings.goals.stop_duration, facts.lower, facts.upper
        )

    def _rest(self, at: int, position: float, velocity: float) -> float:
        """Return where a joint comes to rest that is to hold and glides there."""
        # The glide's velocity then falls steadily: 1 - 3 s^2 + 2 s^3 of what it was.
        facts = self.settings.facts[at]
        rest = position + 0.5 * velocity * self.settings.fixed.takeover_time
        return min(max(rest, facts.lower), facts.upper)
