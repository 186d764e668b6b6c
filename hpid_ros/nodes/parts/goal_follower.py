"""A goal from its start to success, abort or stop, one at a time.

All time enters with the stamps of the states. Source of the rules: ``ros2_controllers``,
``joint_trajectory_controller/src/joint_trajectory_controller.cpp``, functions ``update``,
``goal_cancelled_callback`` and ``goal_accepted_callback``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.motion.joint_trajectory import Knot
from hpid_ros.nodes.parts.goal_joints import (
    AGREES_WITHIN,
    LEAD_NS,
    Braking,
    GroupReferences,
    GroupStates,
    coast_down,
    return_to,
    stop_together,
)
from hpid_ros.nodes.parts.goals import (
    GoalError,
    GoalRequest,
    GroupSettings,
    GroupTrajectory,
    Result,
    ResultCode,
    Tolerance,
    Tolerances,
    for_all_joints,
)

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


class ActiveGoal:
    """A goal under way."""

    def __init__(
        self,
        told: GroupTrajectory,
        tolerances: Tolerances,
        settings: GroupSettings,
        desired: list[Sequence[float]],
        errors: list[Error],
    ) -> None:
        self.start_ns, self.end_ns = told.stamp_ns, told.end_ns
        self.desired, self.errors = desired, errors
        self._names = told.names
        self._units = [facts.unit for facts in settings.facts]
        self._path = [tolerances.path[name] for name in told.names]
        self._goal = [tolerances.goal[name] for name in told.names]
        late_ns = round(tolerances.goal_time * NANOSECONDS)
        self._deadline_ns = self.end_ns + late_ns if late_ns else None
        self._has_ended = [False] * len(told.names)  # by each joint's own state
        self._outside_since_ns: list[int | None] = [None] * len(told.names)

    def compare(self, joint: int, stamp_ns: int, desired: Sequence[float], error: Error) -> str:
        """Take a joint's newest state.

        Args:
            joint: Its place in the group.
            stamp_ns: Of the state in [ns].
            desired: Position, velocity and acceleration of its reference.
            error: Of the joint.

        Returns:
            What of its path tolerance is violated; empty if it is within, and after
            the last point.
        """
        self.desired[joint], self.errors[joint] = desired, error
        self._has_ended[joint] = has_ended = stamp_ns >= self.end_ns
        return "" if has_ended else self._violation(self._path[joint], joint)

    @property
    def has_ended(self) -> bool:
        """Whether every joint has a state after the last point."""
        return all(self._has_ended)

    def unmet(self) -> dict[int, str]:
        """Return what of the goal's tolerances is violated, by joint."""
        lines = {joint: self._violation(each, joint) for joint, each in enumerate(self._goal)}
        return {joint: line for joint, line in lines.items() if line}

    def is_late(self, now_ns: int) -> bool:
        """Return whether the time has passed in which the tolerances had to be met."""
        return self._deadline_ns is not None and now_ns > self._deadline_ns

    def outside(self, joint: int, stamp_ns: int, is_off: bool) -> float:
        """Note whether a controller follows something else; return for how long it has, in [s]."""
        since_ns = self._outside_since_ns[joint]
        if not is_off:
            since_ns = None
        elif since_ns is None:
            since_ns = stamp_ns
        self._outside_since_ns[joint] = since_ns
        return 0.0 if since_ns is None else (stamp_ns - since_ns) / NANOSECONDS

    def when(self, now_ns: int, lines: Iterable[str]) -> str:
        """Return lines with how far the goal has come."""
        since, whole = now_ns - self.start_ns, self.end_ns - self.start_ns
        return f"{'; '.join(lines)}; at {since / NANOSECONDS:.3g} s of {whole / NANOSECONDS:.3g} s"

    def _violation(self, tolerance: Tolerance, joint: int) -> str:
        line = tolerance.violation(*self.errors[joint], self._units[joint])
        return f"{self._names[joint]} is {line}" if line else ""


_SETTLES_WITHIN = 0.5  # [s] beside takeover_time, for a controller to follow what it was told
_CROSSES_WITHIN_NS = NANOSECONDS // 10  # for messages of two senders to arrive in either order

CANCELLED = Result(ResultCode.SUCCESSFUL, "cancelled: the joints stop and hold")
"""The result of a goal that its client has cancelled; the code is JTC's."""


class Outcome(NamedTuple):
    """What follows from something that happened."""

    result: Result | None  # how the active goal has ended
    told: GroupTrajectory | None  # what joints are to be told now; None for nothing


class StartedGoal(NamedTuple):
    """A goal that has begun."""

    told: GroupTrajectory  # what all joints are to be told now
    replaced: Result | None  # how the goal before it has ended; None if there was none


class GoalFollower:
    """Follows one goal at a time with all joints of a group.

    Every input returns what follows from it; the caller tells the joints and the client.
    """

    def __init__(self, settings: GroupSettings) -> None:
        self.settings = settings
        self._states = GroupStates(settings)
        self._references = GroupReferences(settings)
        self._heard_ns: list[int | None] = [None] * len(settings.joints)
        self._active: ActiveGoal | None = None
        self._began_ns = 0
        self._silence = 0.0  # [s] of the wall clock; 0 while states come
        self._late_by = 0.0  # [s]; 0 while nothing is to be excused
        self._has_told = self._is_hold_due = False
        self._late_until_ns = 0

    @property
    def is_active(self) -> bool:
        """Whether a goal is followed."""
        return self._active is not None

    @property
    def now_ns(self) -> int | None:
        """The control clock in [ns]; None before the first state."""
        return self._states.now_ns

    @property
    def unusable(self) -> int:
        """States of joints that were not finite."""
        return self._states.unusable

    def reason_against(self) -> str:
        """Return why no goal can be followed now; empty if one can be."""
        if self._silence:
            return f"there has been no new state for {self._silence:.3g} s"
        return self._states.lack() or self._silent_controller()

    def begin(self, request: GoalRequest) -> StartedGoal:
        """Begin with a goal, in place of the one that is followed."""
        settings = self.settings
        tolerances = request.require_group(settings)
        against = self.reason_against()
        if against:
            raise GoalError(against)
        request.require_positions(settings, self._states.positions)
        now_ns = self._now()
        start_ns = request.start(now_ns)
        joints = range(len(settings.joints))
        for joint in joints:
            if not self._references.is_standing(joint):
                self._references.stand(joint, self._states.positions[joint])
        standing = [self._references.look(joint, now_ns) for joint in joints]
        rest = [self._rest(joint, *standing[joint][:2]) for joint in joints]
        nearest = self._references.nearest(request, start_ns, now_ns)
        told = for_all_joints(nearest, settings.joints, start_ns, now_ns, standing, rest)
        replaced = None
        if self._active is not None:
            replaced = Result(ResultCode.INVALID_GOAL, "replaced by a new goal")
        self._tell(told, now_ns)
        self._began_ns = now_ns
        errors = [self._error(joint, standing[joint]) for joint in joints]
        self._active = ActiveGoal(told, tolerances, settings, standing, errors)
        return StartedGoal(told, replaced)

    def cancel(self) -> Outcome:
        """End the active goal, and stop."""
        return self._end(CANCELLED)

    def leave(self, reason: str) -> Outcome:
        """End the active goal because nobody will look after it any more, and stop."""
        return self._end(Result(ResultCode.INVALID_GOAL, reason))

    def yield_joints(self, joints: Collection[str]) -> Outcome:
        """End the active goal because somebody else has told its joints something; stop the rest.

        A joint follows what it was told last. So that is left alone, and the joints that were not
        told anything do not go on by themselves. Where both were told at once, each controller may
        have heard them in another order: all joints of this group stop.
        """
        others = [joint for joint in self.settings.joints if joint in joints]
        if self._active is None or not others:
            return Outcome(None, None)
        line = f"another node has sent a trajectory for {', '.join(others)}"
        if self._now() - self._began_ns < _CROSSES_WITHIN_NS:
            line += " at the same time: the joints stop"
            return self._end(Result(ResultCode.INVALID_GOAL, line))
        left = {self.settings.joints.index(joint) for joint in others}
        for joint in left:
            position = self._references.look(joint, self._now())[0]
            self._references.stand(joint, position)  # until its controller tells where it is
        return self._end(Result(ResultCode.INVALID_GOAL, line), left_alone=left)

    def note_timeout(self, silence: float) -> Outcome | None:
        """Note that no new state has come for too long."""
        self._silence = silence
        if self._active is None or self.settings.is_simulated:
            return None
        # Where the joints are is not known: they are told to hold when states come again.
        self._active, self._is_hold_due = None, True
        line = f"there was no new state for {silence:.3g} s"
        return Outcome(Result(ResultCode.INVALID_GOAL, line), None)

    def allow_late(self, stood: float) -> None:
        """Note that nobody called for a while: what came meanwhile comes late, and not in order.

        Until states and references had time to come, none of them is missed. The first state that
        comes may still be one from before.
        """
        self._late_by = max(stood, self._late_by)

    def take_state(self, stamp_ns: int, parts: Sequence[JointPart]) -> Outcome | None:
        """Take the joints of one state."""
        taken = self._states.take(stamp_ns, parts)
        if taken is None:
            return self._restart(stamp_ns, parts)
        if not taken:
            return None
        self._silence = 0.0
        if self._late_by:
            patience = max(self.settings.state_timeout, self.settings.reference_timeout)
            self._late_until_ns = stamp_ns + round((self._late_by + patience) * NANOSECONDS)
            self._late_by = 0.0
        if self._is_hold_due:
            return self._hold()
        if self._active is None:
            return None
        return self._look(self._active, stamp_ns, taken)

    def take_reference(self, joint: int, stamp_ns: int, position: float) -> Outcome | None:
        """Take what a controller tells of its reference."""
        before_ns = self._heard_ns[joint]
        self._heard_ns[joint] = stamp_ns
        if before_ns is not None and stamp_ns < before_ns:
            return None  # the clock has gone back; the states will tell
        if not self._references.is_standing(joint):
            self._references.stand(joint, position)
            return None
        there, velocity, _ = self._references.look(joint, stamp_ns)
        if self._active is not None:
            off = self._difference(joint, position, there)
            return self._watch(self._active, joint, stamp_ns, position, off)
        off = position - there  # whole turns count: the next goal begins where references are
        if abs(off) > AGREES_WITHIN or (off and velocity == 0.0):
            self._references.stand(joint, position)
        return None

    def speed(self, joint: int) -> float:
        """Return how fast a joint was at its last state, in [rad/s] or [m/s]."""
        return abs(self._states.velocities[joint])

    def feedback(self) -> Feedback | None:
        """Return how the active goal is doing; None without one."""
        active, states = self._active, self._states
        if active is None or states.now_ns is None:
            return None
        joints = range(len(self.settings.joints))
        return Feedback(
            states.now_ns,
            max(states.now_ns - active.start_ns, 0),
            tuple(active.desired),
            tuple((states.positions[joint], states.velocities[joint]) for joint in joints),
            tuple(active.errors),
        )

    def _now(self) -> int:
        now_ns = self._states.now_ns
        assert now_ns is not None  # there are states
        return now_ns

    def _look(self, active: ActiveGoal, stamp_ns: int, taken: list[int]) -> Outcome | None:
        """Compare the joints of a state with their references, and with the tolerances."""
        violated: dict[int, str] = {}
        for joint in taken:
            desired = self._references.sample(joint, stamp_ns)
            line = active.compare(joint, stamp_ns, desired, self._error(joint, desired))
            if line:
                violated[joint] = line
        if violated:
            return self._violate(ResultCode.PATH_TOLERANCE_VIOLATED, active, violated)
        if active.has_ended:
            violated = active.unmet()
            if not violated:
                self._active = None
                return Outcome(Result(ResultCode.SUCCESSFUL, "goal reached"), None)
            if active.is_late(self._now()):
                return self._violate(ResultCode.GOAL_TOLERANCE_VIOLATED, active, violated)
        if stamp_ns < self._late_until_ns:
            return None
        against = self._states.lack() or self._silent_controller()
        return self._end(Result(ResultCode.INVALID_GOAL, against)) if against else None

    def _violate(self, code: ResultCode, active: ActiveGoal, violated: dict[int, str]) -> Outcome:
        """Abort: whoever is off is held where it is, the others stop."""
        return self._end(Result(code, active.when(self._now(), violated.values())), violated)

    def _watch(
        self, active: ActiveGoal, joint: int, stamp_ns: int, position: float, off: float
    ) -> Outcome | None:
        """Abort if a controller follows something else for longer than a glide takes."""
        outside = active.outside(joint, stamp_ns, abs(off) > AGREES_WITHIN)
        if outside <= self.settings.takeover_time + _SETTLES_WITHIN:
            return None
        name, unit = self.settings.joints[joint], self.settings.facts[joint].unit
        line = (
            f"the reference of {name}'s controller is at {position:.6g} {unit}, "
            f"{abs(off):.4g} {unit} from this goal: it follows something else, or ends at a stop"
        )
        self._references.stand(joint, position)
        return self._end(Result(ResultCode.INVALID_GOAL, line))

    def _silent_controller(self) -> str:
        """Return whose controller tells its reference no more."""
        timeout_ns = round(self.settings.reference_timeout * NANOSECONDS)
        now_ns = self._states.now_ns
        if not timeout_ns or now_ns is None:
            return ""
        for joint, heard_ns in zip(self.settings.joints, self._heard_ns, strict=True):
            if heard_ns is not None and now_ns - heard_ns > timeout_ns:
                silence = (now_ns - heard_ns) / NANOSECONDS
                return f"the controller of {joint} has told no reference for {silence:.3g} s"
        return ""

    def _restart(self, stamp_ns: int, parts: Sequence[JointPart]) -> Outcome | None:
        """Abort because the clock went back; what controllers were told starts again there."""
        back = (self._now() - stamp_ns) / NANOSECONDS
        self._states.restart()
        self._references.restart()
        self._heard_ns, self._late_until_ns = [None] * len(self._heard_ns), 0
        was_active, self._active = self._active, None
        self._is_hold_due = self._has_told
        self._states.take(stamp_ns, parts)
        outcome = self._hold() if self._is_hold_due else None
        if was_active is None:
            return outcome
        line = f"the clock of the states went back by {back:.3g} s"
        told = outcome.told if outcome is not None else None
        return Outcome(Result(ResultCode.INVALID_GOAL, line), told)

    def _hold(self) -> Outcome | None:
        """Stop all joints from where they are measured, once that is known of all of them."""
        states = self._states
        if states.lack():
            return None
        self._is_hold_due, now_ns = False, self._now()
        knots = {}
        for joint, braking in enumerate(self._brakings()):
            position, velocity = self._measured(joint, now_ns), states.velocities[joint]
            self._references.stand(joint, position)
            ahead = position + velocity * LEAD_NS * SECONDS_PER_NANOSECOND
            knots[joint] = coast_down(position, velocity, (ahead, velocity), braking)
        return Outcome(None, self._stop(knots))

    def _measured(self, joint: int, now_ns: int) -> float:
        """Return where a joint is, in the turn in which its reference is if that is known."""
        position = self._states.positions[joint]
        is_endless = self.settings.facts[joint].is_endless
        if not is_endless or not self._references.is_standing(joint):
            return position
        there = self._references.look(joint, now_ns)[0]
        return there - self._difference(joint, there, position)

    def _end(
        self,
        result: Result,
        blocked: Collection[int] = (),
        left_alone: Collection[int] = (),
    ) -> Outcome:
        """End the active goal and stop all joints but some; those that are blocked are held."""
        active, self._active = self._active, None
        if active is None:
            return Outcome(None, None)
        now_ns = self._now()
        knots = {}
        for joint, braking in enumerate(self._brakings()):
            if joint in left_alone:
                continue
            position, velocity, _ = self._references.look(joint, now_ns)
            if joint in blocked:
                target = position - active.errors[joint][0]
                knots[joint] = return_to(target, position, velocity, braking)
            else:
                later = self._references.look(joint, now_ns + LEAD_NS)
                knots[joint] = coast_down(position, velocity, (later[0], later[1]), braking)
        return Outcome(result, self._stop(knots) if knots else None)

    def _stop(self, knots: Mapping[int, Sequence[Knot]]) -> GroupTrajectory:
        now_ns = self._now()
        names = [self.settings.joints[joint] for joint in knots]
        told = stop_together(names, list(knots.values()), now_ns)
        self._tell(told, now_ns)
        return told

    def _tell(self, told: GroupTrajectory, now_ns: int) -> None:
        self._has_told = True
        self._references.follow(told, now_ns)

    def _brakings(self) -> list[Braking]:
        settings = self.settings
        return [
            Braking(deceleration, settings.stop_duration, facts.lower, facts.upper)
            for deceleration, facts in zip(settings.decelerations, settings.facts, strict=True)
        ]

    def _rest(self, joint: int, position: float, velocity: float) -> float:
        """Return where a joint comes to rest that is told to hold and glides there."""
        # The glide's velocity then falls steadily: 1 - 3 s^2 + 2 s^3 of what it was.
        facts = self.settings.facts[joint]
        rest = position + 0.5 * velocity * self.settings.takeover_time
        return min(max(rest, facts.lower), facts.upper)

    def _error(self, joint: int, desired: Sequence[float]) -> Error:
        off = self._difference(joint, desired[0], self._states.positions[joint])
        return off, desired[1] - self._states.velocities[joint]

    def _difference(self, joint: int, position: float, other: float) -> float:
        """Return a difference of positions; that of an endless joint is the shorter way round."""
        off = position - other
        return math.remainder(off, math.tau) if self.settings.facts[joint].is_endless else off
