"""A goal from its start to success, abort or stop, one at a time.

The controllers are asked for nothing: the code that follows a trajectory in each of them
(:class:`~hpid_ros.control.reference.Following`) runs here once more, fed with the same
trajectories and stamps. They differ by when exactly a controller took a trajectory up, which fades
with the glide. What controllers publish of their references is used where they were sent nothing.

All time enters with the stamps of the states. Source of the rules: ``ros2_controllers``,
``joint_trajectory_controller/src/joint_trajectory_controller.cpp``, functions ``update``,
``goal_cancelled_callback`` and ``goal_accepted_callback``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.reference import LARGEST_POSITION, Following, whole_turns
from hpid_ros.control.velocity import MeasuredVelocity, Unwrapper
from hpid_ros.messages.joint_state import JointPart
from hpid_ros.motion.joint_trajectory import Knot, checked_column
from hpid_ros.nodes.parts.goals import (
    LEAD_NS,
    Braking,
    GoalError,
    GoalRequest,
    GroupSettings,
    GroupTrajectory,
    Result,
    ResultCode,
    Tolerance,
    Tolerances,
    coast_down,
    for_all_joints,
    return_to,
    stop_together,
)

_AGREES_WITHIN = 0.01  # [rad]; a controller whose reference is further off follows something else

_VELOCITY_FILTER = 0.05  # [s], for states without velocities: one count of an encoder is no motion


class GroupStates:
    """The newest state of each joint."""

    def __init__(self, settings: GroupSettings) -> None:
        self._joints = settings.joints
        self._timeout = settings.fixed.state_timeout
        self._sources = [MeasuredVelocity(_VELOCITY_FILTER) for _ in settings.joints]
        self._unwrappers = [
            Unwrapper(math.tau) if facts.is_endless else None for facts in settings.facts
        ]
        self.unusable = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next state is the first one."""
        count = len(self._joints)
        self.now_ns: int | None = None
        self.stamps_ns: list[int | None] = [None] * count
        self.positions, self.velocities = [0.0] * count, [0.0] * count
        for source in self._sources:
            source.reset()
        for unwrapper in self._unwrappers:
            if unwrapper is not None:
                unwrapper.reset()

    def take(self, stamp_ns: int, parts: Sequence[JointPart]) -> list[int] | None:
        """Take the joints of one message."""
        for part in parts:
            before_ns = self.stamps_ns[part.joint]
            if before_ns is not None and stamp_ns < before_ns:
                return None
        taken = []
        for joint, position, velocity in parts:
            before_ns = self.stamps_ns[joint]
            if stamp_ns == before_ns:
                continue  # a repeat
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                self.unusable += 1
                continue
            since = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
            unwrapper = self._unwrappers[joint]
            steady = position if unwrapper is None else unwrapper.update(position)
            if velocity is not None and not -LARGEST_POSITION <= velocity <= LARGEST_POSITION:
                velocity = None  # drivers fill in NaN for what they do not measure
            self.stamps_ns[joint] = stamp_ns
            self.positions[joint] = position
            self.velocities[joint] = self._sources[joint].update(steady, velocity, since)
            taken.append(joint)
        if taken and (self.now_ns is None or stamp_ns > self.now_ns):
            self.now_ns = stamp_ns
        return taken

    def lack(self) -> str:
        """Return which joint has no state, or an old one; empty if all are there."""
        for joint, stamp_ns in zip(self._joints, self.stamps_ns, strict=True):
            if stamp_ns is None or self.now_ns is None:
                return f"there is no state of {joint} yet"
            age = (self.now_ns - stamp_ns) / NANOSECONDS
            if age > self._timeout:
                return f"{joint} has had no state for {age:.3g} s"
        return ""


class GroupReferences:
    """The references of all joints of a group."""

    def __init__(self, settings: GroupSettings) -> None:
        self._joints, self._takeover_time = settings.joints, settings.fixed.takeover_time
        self._following = [Following() for _ in settings.joints]
        for following, facts in zip(self._following, settings.facts, strict=True):
            following.turn = math.tau if facts.takes_shorter_way else 0.0

    def restart(self) -> None:
        for following in self._following:
            following.follow(None)
            following.restart()

    def rest(self, joint: int, position: float) -> None:
        """Let a joint's reference be at a position, at rest."""
        self._following[joint].follow(None)
        self._following[joint].stand(position)

    def is_known(self, joint: int) -> bool:
        """Return whether it is known where a joint's reference is."""
        return self._following[joint].is_standing

    def nearest(self, request: GoalRequest, start_ns: int, now_ns: int) -> GoalRequest:
        """Return a goal as whole turns away as its joints are that take the shorter way to it.

        Its points keep their differences: turns within it are turns that are meant.
        """
        away = [self._turns_to(at, request, start_ns, now_ns) for at in range(len(request.names))]
        if not any(away):
            return request
        arrays = request.arrays
        return replace(request, arrays=arrays._replace(positions=arrays.positions + away))

    def _turns_to(self, at: int, request: GoalRequest, start_ns: int, now_ns: int) -> float:
        """Return the turns between a joint of a goal and where its reference is, in [rad]."""
        joint = self._joints.index(request.names[at])
        turn = self._following[joint].turn
        if not turn:
            return 0.0
        column = checked_column(request.names[at], at, start_ns, request.times_ns, request.arrays)
        return whole_turns(self.peek(joint, now_ns)[0] - column.target(now_ns), turn)

    def follow(self, trajectory: GroupTrajectory, now_ns: int) -> None:
        """Let the joints of a trajectory follow it from now on; they must be standing."""
        for at, name in enumerate(trajectory.names):
            following = self._following[self._joints.index(name)]
            following.sample(now_ns, self._takeover_time, None)
            following.follow(trajectory.column(at))
            following.sample(now_ns, self._takeover_time, None)

    def sample(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return a joint's reference (position, velocity, acceleration), and go on from there."""
        return self._following[joint].sample(stamp_ns, self._takeover_time, None)

    def peek(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return the same of any instant, and leave everything as it is."""
        return copy(self._following[joint]).sample(stamp_ns, self._takeover_time, None)


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
        trajectory: GroupTrajectory,
        tolerances: Tolerances,
        settings: GroupSettings,
        desired: list[Sequence[float]],
        errors: list[Error],
    ) -> None:
        self.start_ns, self.end_ns = trajectory.stamp_ns, trajectory.end_ns
        self.desired, self.errors = desired, errors
        self._names = trajectory.names
        self._units = [facts.unit for facts in settings.facts]
        self._path = [tolerances.path[name] for name in trajectory.names]
        self._goal = [tolerances.goal[name] for name in trajectory.names]
        late_ns = round(tolerances.goal_time * NANOSECONDS)
        self._deadline_ns = self.end_ns + late_ns if late_ns else None
        self._has_ended = [False] * len(trajectory.names)  # by each joint's own state
        self._outside_since_ns: list[int | None] = [None] * len(trajectory.names)

    def compare(self, joint: int, stamp_ns: int, desired: Sequence[float], error: Error) -> str:
        """Take a joint's newest state, and return what it violates of its path tolerance."""
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


_SETTLES_WITHIN = 0.5  # [s] after takeover_time, for a controller to follow what it was sent
_CROSSES_WITHIN_NS = NANOSECONDS // 10  # for messages of two senders to arrive in either order

CANCELLED = Result(ResultCode.SUCCESSFUL, "cancelled: the joints stop and hold")
"""The result of a goal that its client has cancelled; the code is JTC's."""


class Outcome(NamedTuple):
    """What follows from something that happened."""

    result: Result | None  # how the goal that was active has ended
    trajectory: GroupTrajectory | None  # what is to be published to the controllers now


class GoalFollower:
    """Follows one goal at a time with all joints of a group.

    Every input returns what follows from it, for the caller to publish and to answer.
    """

    def __init__(self, settings: GroupSettings) -> None:
        self.settings = settings
        self._states = GroupStates(settings)
        self._references = GroupReferences(settings)
        self._references_ns: list[int | None] = [None] * len(settings.joints)
        self._active: ActiveGoal | None = None
        self._began_ns = 0
        self._silence = 0.0  # [s] of the wall clock; 0 while states come
        self._late_by = 0.0  # [s]; 0 while nothing is to be excused
        self._has_published = self._is_hold_due = False
        self._late_until_ns = 0

    @property
    def is_active(self) -> bool:
        return self._active is not None

    @property
    def now_ns(self) -> int | None:
        """The control clock in [ns]; None before the first state."""
        return self._states.now_ns

    @property
    def unusable(self) -> int:
        return self._states.unusable

    def reason_against(self) -> str:
        """Return why no goal can be followed now; empty if one can be."""
        if self._silence:
            return f"there has been no new state for {self._silence:.3g} s"
        return self._states.lack() or self._lost_controller()

    def begin(self, request: GoalRequest) -> Outcome:
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
            if not self._references.is_known(joint):
                self._references.rest(joint, self._states.positions[joint])
        standing = [self._references.peek(joint, now_ns) for joint in joints]
        rest = [self._rest(joint, *standing[joint][:2]) for joint in joints]
        nearest = self._references.nearest(request, start_ns, now_ns)
        trajectory = for_all_joints(nearest, settings.joints, start_ns, now_ns, standing, rest)
        is_replaced = self._active is not None
        self._follow(trajectory, now_ns)
        self._began_ns = now_ns
        errors = [self._error(joint, standing[joint]) for joint in joints]
        self._active = ActiveGoal(trajectory, tolerances, settings, standing, errors)
        replaced = Result(ResultCode.INVALID_GOAL, "replaced by a new goal")
        return Outcome(replaced if is_replaced else None, trajectory)

    def cancel(self) -> Outcome:
        return self._end(CANCELLED)

    def leave(self, reason: str) -> Outcome:
        """End the active goal because its follower ends, and stop."""
        return self._end(Result(ResultCode.INVALID_GOAL, reason))

    def yield_joints(self, joints: Collection[str]) -> Outcome:
        """End the active goal because another node has sent its joints a trajectory.

        A joint follows the newest trajectory. So those joints are left alone, and the others stop.
        Where two trajectories were sent at once, each controller may have received them in
        another order: all joints of this group stop.
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
            position = self._references.peek(joint, self._now())[0]
            self._references.rest(joint, position)  # until its controller publishes its own
        return self._end(Result(ResultCode.INVALID_GOAL, line), left_alone=left)

    def note_timeout(self, silence: float) -> Outcome | None:
        """Note that no new state has come for too long."""
        self._silence = silence
        if self._active is None or self.settings.fixed.state_clock == "simulated":
            return None
        # Where the joints are is not known: they stop when states come again.
        self._active, self._is_hold_due = None, True
        line = f"there was no new state for {silence:.3g} s"
        return Outcome(Result(ResultCode.INVALID_GOAL, line), None)

    def allow_late(self, stood: float) -> None:
        """Note that this process stood still: what came meanwhile comes late, and not in order.

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
            fixed = self.settings.fixed
            patience = max(fixed.state_timeout, fixed.reference_timeout)
            self._late_until_ns = stamp_ns + round((self._late_by + patience) * NANOSECONDS)
            self._late_by = 0.0
        if self._is_hold_due:
            return self._hold()
        if self._active is None:
            return None
        return self._look(self._active, stamp_ns, taken)

    def take_reference(self, joint: int, stamp_ns: int, position: float) -> Outcome | None:
        """Take a reference that a controller has published."""
        before_ns = self._references_ns[joint]
        self._references_ns[joint] = stamp_ns
        if before_ns is not None and stamp_ns < before_ns:
            return None  # the clock has gone back, which the states show, too
        if not self._references.is_known(joint):
            self._references.rest(joint, position)
            return None
        there, velocity, _ = self._references.peek(joint, stamp_ns)
        if self._active is not None:
            off = self._difference(joint, position, there)
            return self._watch(self._active, joint, stamp_ns, position, off)
        off = position - there  # whole turns count: the next goal begins where references are
        if abs(off) > _AGREES_WITHIN or (off and velocity == 0.0):
            self._references.rest(joint, position)
        return None

    def speed(self, joint: int) -> float:
        """Return how fast a joint was at its last state, in [rad/s] or [m/s]."""
        return abs(self._states.velocities[joint])

    def feedback(self) -> Feedback | None:
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
        against = self._states.lack() or self._lost_controller()
        return self._end(Result(ResultCode.INVALID_GOAL, against)) if against else None

    def _violate(self, code: ResultCode, active: ActiveGoal, violated: dict[int, str]) -> Outcome:
        """Abort: joints that are off are held where they are, the others stop."""
        return self._end(Result(code, active.when(self._now(), violated.values())), violated)

    def _watch(
        self, active: ActiveGoal, joint: int, stamp_ns: int, position: float, off: float
    ) -> Outcome | None:
        """Abort if a controller follows something else for longer than a glide takes."""
        outside = active.outside(joint, stamp_ns, abs(off) > _AGREES_WITHIN)
        if outside <= self.settings.fixed.takeover_time + _SETTLES_WITHIN:
            return None
        name, unit = self.settings.joints[joint], self.settings.facts[joint].unit
        line = (
            f"the reference of {name}'s controller is at {position:.6g} {unit}, "
            f"{abs(off):.4g} {unit} from this goal: it follows something else, or ends at a stop"
        )
        self._references.rest(joint, position)
        return self._end(Result(ResultCode.INVALID_GOAL, line))

    def _lost_controller(self) -> str:
        """Return whose controller publishes its reference no more; empty if all do."""
        timeout_ns = round(self.settings.fixed.reference_timeout * NANOSECONDS)
        now_ns = self._states.now_ns
        if not timeout_ns or now_ns is None:
            return ""
        for joint, reference_ns in zip(self.settings.joints, self._references_ns, strict=True):
            if reference_ns is not None and now_ns - reference_ns > timeout_ns:
                age = (now_ns - reference_ns) / NANOSECONDS
                return f"the controller of {joint} has published no reference for {age:.3g} s"
        return ""

    def _restart(self, stamp_ns: int, parts: Sequence[JointPart]) -> Outcome | None:
        """Abort because the clock went back; what controllers follow starts again there."""
        back = (self._now() - stamp_ns) / NANOSECONDS
        self._states.restart()
        self._references.restart()
        self._references_ns, self._late_until_ns = [None] * len(self._references_ns), 0
        was_active, self._active = self._active, None
        self._is_hold_due = self._has_published
        self._states.take(stamp_ns, parts)
        outcome = self._hold() if self._is_hold_due else None
        if was_active is None:
            return outcome
        line = f"the clock of the states went back by {back:.3g} s"
        trajectory = outcome.trajectory if outcome is not None else None
        return Outcome(Result(ResultCode.INVALID_GOAL, line), trajectory)

    def _hold(self) -> Outcome | None:
        """Stop all joints from where they are measured, once that is known of all of them."""
        states = self._states
        if states.lack():
            return None
        self._is_hold_due, now_ns = False, self._now()
        knots = {}
        for joint, braking in enumerate(self._brakings()):
            position, velocity = self._measured(joint, now_ns), states.velocities[joint]
            self._references.rest(joint, position)
            ahead = position + velocity * LEAD_NS * SECONDS_PER_NANOSECOND
            knots[joint] = coast_down(position, velocity, (ahead, velocity), braking)
        return Outcome(None, self._stop(knots))

    def _measured(self, joint: int, now_ns: int) -> float:
        """Return where a joint is, in the turn in which its reference is if that is known."""
        position = self._states.positions[joint]
        is_endless = self.settings.facts[joint].is_endless
        if not is_endless or not self._references.is_known(joint):
            return position
        there = self._references.peek(joint, now_ns)[0]
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
            position, velocity, _ = self._references.peek(joint, now_ns)
            if joint in blocked:
                target = position - active.errors[joint][0]
                knots[joint] = return_to(target, position, velocity, braking)
            else:
                later = self._references.peek(joint, now_ns + LEAD_NS)
                knots[joint] = coast_down(position, velocity, (later[0], later[1]), braking)
        return Outcome(result, self._stop(knots) if knots else None)

    def _stop(self, knots: Mapping[int, Sequence[Knot]]) -> GroupTrajectory:
        now_ns = self._now()
        names = [self.settings.joints[joint] for joint in knots]
        trajectory = stop_together(names, list(knots.values()), now_ns)
        self._follow(trajectory, now_ns)
        return trajectory

    def _follow(self, trajectory: GroupTrajectory, now_ns: int) -> None:
        self._has_published = True
        self._references.follow(trajectory, now_ns)

    def _brakings(self) -> list[Braking]:
        settings = self.settings
        return [
            Braking(deceleration, settings.goals.stop_duration, facts.lower, facts.upper)
            for deceleration, facts in zip(settings.decelerations, settings.facts, strict=True)
        ]

    def _rest(self, joint: int, position: float, velocity: float) -> float:
        """Return where a joint comes to rest that is to hold and glides there."""
        # The glide's velocity then falls steadily: 1 - 3 s^2 + 2 s^3 of what it was.
        facts = self.settings.facts[joint]
        rest = position + 0.5 * velocity * self.settings.fixed.takeover_time
        return min(max(rest, facts.lower), facts.upper)

    def _error(self, joint: int, desired: Sequence[float]) -> Error:
        off = self._difference(joint, desired[0], self._states.positions[joint])
        return off, desired[1] - self._states.velocities[joint]

    def _difference(self, joint: int, position: float, other: float) -> float:
        """Return a difference of positions; that of an endless joint is the shorter way round."""
        off = position - other
        return math.remainder(off, math.tau) if self.settings.facts[joint].is_endless else off
