"""A goal, checked: settings, tolerances, the trajectory of all joints of the group, and stops.

Source: ``control_msgs/action/FollowJointTrajectory``, the constants of its result.

A tolerance of zero is not enforced. Source: ``ros2_controllers``,
``joint_trajectory_controller/include/joint_trajectory_controller/tolerances.hpp``, and
``control_msgs/msg/JointTolerance`` for what 0 and -1 mean in a goal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import (
    EndedError,
    HpidError,
    SettingError,
    TrajectoryError,
    unknown_name,
)
from hpid_ros.base.records import ParameterSpec, Record, from_parameters, parameters_of, quantity
from hpid_ros.base.text import names_text
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.control.reference import LARGEST_POSITION, require_timely
from hpid_ros.control.settings import StateClock, Value
from hpid_ros.messages.bounds import LIVE
from hpid_ros.messages.joint_trajectory import decode_trajectory
from hpid_ros.motion.joint_trajectory import (
    Column,
    Integers,
    Knot,
    PointArrays,
    SplineReference,
    approach,
    checked_column,
)


class ResultCode(IntEnum):
    """``error_code`` of a result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class GoalResult(NamedTuple):
    """How a goal ended."""

    code: ResultCode  # what a program looks at
    text: str  # what a person reads, one line


class GoalError(TrajectoryError):
    """A goal that is not obeyed."""

    def __init__(self, text: str, code: ResultCode = ResultCode.INVALID_GOAL) -> None:
        super().__init__(text)
        self.code = code

    @property
    def result(self) -> GoalResult:
        return GoalResult(self.code, str(self))


_EPSILON = 1.2e-7  # of float32: what is called -1 may have been rounded on the way


class Tolerance(NamedTuple):
    """How far a joint may be from its reference; 0 is not enforced."""

    position: float = 0.0  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]

    def violation(self, position: float, velocity: float, unit: str) -> str:
        """Return what is violated by an error; empty if it is within the tolerance."""
        if 0.0 < self.position < abs(position):
            return (
                f"{abs(position):.4g} {unit} from its reference, "
                f"its tolerance is {self.position:g} {unit}"
            )
        if 0.0 < self.velocity < abs(velocity):
            return (
                f"{abs(velocity):.4g} {unit}/s off the velocity of its reference, "
                f"its tolerance is {self.velocity:g} {unit}/s"
            )
        return ""


@dataclass(frozen=True)
class Tolerances:
    """All tolerances of a goal."""

    path: Mapping[str, Tolerance]  # while the trajectory lasts, by joint
    goal: Mapping[str, Tolerance]  # after its last point, by joint
    goal_time: float = 0.0  # [s] how much later than that they must be met; 0 waits for ever

    def asked(self, path: Iterable[Any], goal: Iterable[Any], goal_time: float) -> Tolerances:
        """Return these with what a goal asks for instead, in ``JointTolerance`` messages."""
        return replace(
            self,
            path=_laid_over(self.path, path, "path_tolerance"),
            goal=_laid_over(self.goal, goal, "goal_tolerance"),
            goal_time=_resolved(self.goal_time, goal_time, "goal_time_tolerance", "s"),
        )


def _laid_over(
    defaults: Mapping[str, Tolerance], asked: Iterable[Any], name: str
) -> Mapping[str, Tolerance]:
    merged = dict(defaults)
    for each in asked:
        if each.name not in defaults:
            line = f"{name}: {unknown_name('joint', each.name, defaults)}"
            raise GoalError(line, ResultCode.INVALID_JOINTS)
        where = f"{name} of {each.name}"
        default = merged[each.name]
        _resolved(0.0, each.acceleration, f"{where}: acceleration", "rad/s^2 or m/s^2")
        merged[each.name] = Tolerance(
            _resolved(default.position, each.position, f"{where}: position", "rad or m"),
            _resolved(default.velocity, each.velocity, f"{where}: velocity", "rad/s or m/s"),
        )
    return merged


def _resolved(default: float, asked: float, where: str, unit: str) -> float:
    if asked == 0.0:
        return default
    if abs(asked + 1.0) <= _EPSILON:
        return 0.0
    if not (math.isfinite(asked) and asked > 0.0):
        raise GoalError(
            f"{where} must be positive, 0 for the default or -1 for none, not {asked:g} {unit}"
        )
    return asked


@dataclass(frozen=True)
class GoalParameters(Record):
    """What may change while the node runs: for the next goal, and for stops of the present one."""

    allow_partial_joints_goal: bool = quantity(
        "Take goals that name some joints only", default=False
    )
    allow_nonzero_velocity_at_trajectory_end: bool = quantity(
        "Take goals whose last point has a velocity; the reference rests there all the same",
        default=False,
    )
    goal_time: float = quantity(
        "How much later than its last point a goal's tolerances must be met [s]; 0 waits for ever",
        default=0.0,
        least=0.0,
        key="constraints.goal_time",
    )
    stopped_velocity_tolerance: float = quantity(
        "Velocity at which a joint counts as stopped at the end of a goal [rad/s]; 0 is any",
        default=0.01,
        least=0.0,
        key="constraints.stopped_velocity_tolerance",
    )
    stop_duration: float = quantity(
        "How long a joint without max_deceleration_on_cancel takes to stop",
        "s",
        default=0.5,
        least=0.01,
        most=100.0,
        key="constraints.stop_duration",
    )


@dataclass(frozen=True)
class FixedParameters(Record):
    """What is fixed when the node starts."""

    action_monitor_rate: float = quantity(
        "Rate of the feedback [Hz], of the wall clock", default=20.0, least=0.1, most=1000.0
    )
    state_timeout: float = quantity(
        "A goal is aborted, and none is taken, when a joint has had no state for so long",
        "s",
        default=0.5,
        least=0.01,
        most=10.0,
    )
    state_clock: StateClock = quantity(
        "What stamps the states: wall, or simulated, which can be paused without an abort",
        default="wall",
    )
    takeover_time: float = quantity(
        "That of the controllers [s], which they glide for", default=0.5, least=0.0, most=100.0
    )
    reference_timeout: float = quantity(
        "A goal is aborted when a controller that has told its ~/reference tells none for so "
        "long [s], by the stamps; 0 does not look",
        default=0.5,
        least=0.0,
        most=100.0,
    )


@dataclass(frozen=True)
class JointParameters(Record):
    """What is asked of one joint of a group; it may change as the goals' parameters may."""

    trajectory: float = quantity(
        "How far the joint may be from its reference during a goal [rad]; 0 is any",
        default=0.0,
        least=0.0,
    )
    goal: float = quantity(
        "How far it may be from its reference at the end of a goal [rad]; 0 is any",
        default=0.0,
        least=0.0,
    )
    max_deceleration_on_cancel: float = quantity(
        "Deceleration with which it stops when a goal is cancelled or aborted [rad/s^2]; 0 "
        "stops it within constraints.stop_duration",
        default=0.0,
        least=0.0,
    )


GOAL_PARAMETERS = parameters_of(GoalParameters)
FIXED_PARAMETERS = parameters_of(FixedParameters)


def joint_parameters(joint: str) -> Mapping[str, ParameterSpec]:
    own = parameters_of(JointParameters).items()
    specs = [replace(spec, name=f"constraints.{joint}.{name}") for name, spec in own]
    return {spec.name: spec for spec in specs}


class JointFacts(NamedTuple):
    """What is known of a joint; "rad" reads "m" where it is prismatic."""

    lower: float = -math.inf  # [rad] lowest position; -inf for none
    upper: float = math.inf  # [rad] highest position; inf for none
    is_endless: bool = False  # whether it turns without end, so that whole turns are no error
    # whether goals lead it the shorter way round to their first point
    takes_shorter_way: bool = False
    unit: str = "rad"  # of its position, rad or m
    fastest: float = math.inf  # [rad/s] its velocity limit; inf for none


def require_joints(
    joints: Sequence[str], wrapping: Sequence[str] = (), counting: Sequence[str] = ()
) -> None:
    if not joints or len(set(joints)) != len(joints) or "" in joints:
        raise SettingError(f"the parameter joints must name each joint once, not {list(joints)}")
    for parameter, named in (("angle_wraparound", wrapping), ("multi_turn", counting)):
        for joint in named:
            if joint not in joints:
                line = unknown_name("joint", joint, joints)
                raise SettingError(f"the parameter {parameter}: {line}")
    for joint in wrapping:
        if joint in counting:
            raise SettingError(f"{joint} is in angle_wraparound and in multi_turn: take one")


@dataclass(frozen=True)
class GroupSettings:
    """Settings of a group of joints; "rad" reads "m" where a joint is prismatic."""

    joints: tuple[str, ...]  # their names, each once
    facts: tuple[JointFacts, ...]  # what is known of each, in the same order
    tolerances: Tolerances  # of goals that ask for no others
    decelerations: tuple[float, ...]  # [rad/s^2] with which each stops; 0 for none of its own
    goals: GoalParameters
    fixed: FixedParameters

    @classmethod
    def from_parameters(
        cls, joints: Sequence[str], facts: Mapping[str, JointFacts], values: Mapping[str, Value]
    ) -> GroupSettings:
        require_joints(joints)
        goals = from_parameters(GoalParameters, _among(GOAL_PARAMETERS, values))
        fixed = from_parameters(FixedParameters, _among(FIXED_PARAMETERS, values))
        own = [_of_joint(joint, values) for joint in joints]
        pairs = list(zip(joints, own, strict=True))
        tolerances = Tolerances(
            {joint: Tolerance(each.trajectory) for joint, each in pairs},
            {
                joint: Tolerance(each.goal, goals.stopped_velocity_tolerance)
                for joint, each in pairs
            },
            goals.goal_time,
        )
        return cls(
            tuple(joints),
            tuple(facts.get(joint, JointFacts()) for joint in joints),
            tolerances,
            tuple(each.max_deceleration_on_cancel for each in own),
            goals,
            fixed,
        )


def _among(names: Iterable[str], values: Mapping[str, Value]) -> dict[str, Value]:
    return {name: values[name] for name in names if name in values}


def _of_joint(joint: str, values: Mapping[str, Value]) -> JointParameters:
    specs = joint_parameters(joint).items()
    return JointParameters(
        **{spec.path: spec.checked(values.get(name, 0.0)) for name, spec in specs}
    )


_EFFORTS = PointArrays._fields.index("efforts")
_AT_REST = 1.2e-7  # [rad/s, m/s], float32's epsilon, as JTC takes it
_FASTER = 1.1  # planners hold velocity limits at their points, and splines between them less so
_ROUNDED = 1e-6  # [rad, m]; limits are written with few digits, and planned with more
# One point may be put before those of a goal.
_BOUNDS = LIVE._replace(points=LIVE.points - 1, mixed_points=LIVE.mixed_points - 1)


@dataclass(frozen=True, eq=False)
class GoalRequest:
    """A goal as it was asked for."""

    names: tuple[str, ...]  # its joints, each once
    stamp_ns: int  # [ns] when it starts; 0 means now
    times_ns: Integers  # [ns] time from start of each point, shape (points,)
    arrays: PointArrays  # the numbers of the points, each of shape (points, joints)
    path_tolerance: tuple[Any, ...] = ()  # what it asks for while it lasts: JointTolerance
    goal_tolerance: tuple[Any, ...] = ()  # what it asks for at its end
    goal_time_tolerance: float = 0.0  # [s] 0 is the default, -1 waits for ever

    @classmethod
    def of(cls, raw: bytes, *tolerances: Any) -> GoalRequest:
        """Return the request of a ``JointTrajectory`` in CDR."""
        try:
            came = decode_trajectory(raw, _BOUNDS)
            names = came.names
            if not names or len(set(names)) != len(names):
                line = f"a goal must name each of its joints once, not {names_text(names)}"
                raise GoalError(line, ResultCode.INVALID_JOINTS)
            came.require()
        except GoalError:
            raise
        except HpidError as error:
            raise GoalError(str(error)) from None
        return cls(names, came.stamp_ns, came.times_ns, came.arrays, *tolerances)

    def require_group(self, settings: GroupSettings) -> Tolerances:
        """Refuse what is not for these joints, and return the tolerances that hold."""
        for joint in self.names:
            if joint not in settings.joints:
                line = unknown_name("joint", joint, settings.joints)
                raise GoalError(line, ResultCode.INVALID_JOINTS)
        lacking = [joint for joint in settings.joints if joint not in self.names]
        if lacking and not settings.goals.allow_partial_joints_goal:
            raise GoalError(
                f"the goal lacks {', '.join(lacking)}; it must name all joints unless "
                f"allow_partial_joints_goal is true",
                ResultCode.INVALID_JOINTS,
            )
        last = self.arrays.velocities[-1]
        if not settings.goals.allow_nonzero_velocity_at_trajectory_end:
            for joint, velocity in zip(self.names, last.tolist(), strict=True):
                if abs(velocity) > _AT_REST:  # NaN, where there is none, is not
                    unit = settings.facts[settings.joints.index(joint)].unit
                    raise GoalError(
                        f"the last point must be at rest, not {joint} at {velocity:g} {unit}/s, "
                        f"unless allow_nonzero_velocity_at_trajectory_end is true"
                    )
        return settings.tolerances.asked(
            self.path_tolerance, self.goal_tolerance, self.goal_time_tolerance
        )

    def require_positions(self, settings: GroupSettings, positions: Sequence[float]) -> None:
        """Refuse what leads a joint beyond the positions that the robot's description allows.

        A joint that is beyond them may be led back: points may be as far out as it is.
        """
        for at, name in enumerate(self.names):
            joint = settings.joints.index(name)
            facts, here = settings.facts[joint], positions[joint]
            path = self.arrays.positions[:, at]
            low = min(facts.lower - _ROUNDED, here)
            high = max(facts.upper + _ROUNDED, here)
            beyond = np.flatnonzero((path < low) | (path > high))
            if len(beyond):
                point = int(beyond[0])
                value, unit = float(path[point]), facts.unit
                raise GoalError(
                    f"point {point} leads {name} to {value:g} {unit}, its limits are "
                    f"{facts.lower:g} and {facts.upper:g} {unit}"
                )

    def start(self, now_ns: int) -> int:
        """Return the instant at which the goal starts, in [ns]."""
        if self.stamp_ns == 0:
            # One nanosecond ago: for every controller it is under way, whichever state it is at.
            return max(now_ns - 1, 1)
        window_ns = self.stamp_ns, self.stamp_ns + int(self.times_ns[-1])
        try:
            require_timely("the goal", window_ns, now_ns)
        except EndedError as error:
            raise GoalError(str(error), ResultCode.OLD_HEADER_TIMESTAMP) from None
        except TrajectoryError as error:
            raise GoalError(str(error)) from None
        return self.stamp_ns


@dataclass(frozen=True, eq=False)
class GroupTrajectory:
    """A trajectory for the joints of a group, within the numbers that controllers take."""

    names: tuple[str, ...]  # the joints
    stamp_ns: int  # [ns] when it starts; never 0
    times_ns: Integers  # [ns] time from start of each point, shape (points,)
    arrays: PointArrays  # the numbers of the points, each of shape (points, joints)

    def __post_init__(self) -> None:
        """Bound the numbers: controllers would refuse a stop from beyond, and go on."""
        for values in self.arrays:
            np.clip(values, -LARGEST_POSITION, LARGEST_POSITION, out=values)

    @property
    def end_ns(self) -> int:
        return self.stamp_ns + int(self.times_ns[-1])

    def column(self, joint: int) -> Column:
        name = self.names[joint]
        return checked_column(name, joint, self.stamp_ns, self.times_ns, self.arrays)


def require_inside(
    plan: SplineReference, facts: JointFacts, here: float, name: str, added: int
) -> None:
    """Refuse what leads a joint beyond its limits between two points, or on the way to the first.

    A joint that is beyond them may be led back. So many points were put before those of the goal.
    """
    low, high = min(facts.lower - _ROUNDED, here), max(facts.upper + _ROUNDED, here)
    fastest = facts.fastest * _FASTER
    for place, lowest, highest, speed in plan.swings():
        index = place - added
        way = f"between point {index - 1} and point {index}"
        way = way if index > 0 else "on its way to point 0"
        unit = facts.unit
        if lowest < low or highest > high:
            value = lowest if lowest < low else highest
            raise GoalError(
                f"{way} the spline leads {name} to {value:.4g} {unit}, its limits are "
                f"{facts.lower:g} and {facts.upper:g} {unit}"
            )
        if speed > fastest:
            raise GoalError(
                f"{way} the spline moves {name} at {speed:.4g} {unit}/s, its limit is "
                f"{facts.fastest:g} {unit}/s"
            )


def for_all_joints(
    request: GoalRequest,
    joints: Sequence[str],
    start_ns: int,
    now_ns: int,
    *,
    standing: Sequence[Sequence[float]],
    rest: Sequence[float],
    settling: float,
) -> GroupTrajectory:
    """Return the trajectory of all joints for a goal, which may name some of them only.

    The others rest. One that starts later is sent as it is: until then controllers go on with
    what they follow. Of any other the first point is never in the future: where the goal's own is,
    one is put before it, at which the joints are where their references stand now. So the goal
    is under way for every controller, whenever it takes it up, and none of them jumps: it glides.
    A joint that is too fast for a spline to the first point that swings beyond neither end comes
    to rest first, within ``settling`` [s].
    """
    named = [joints.index(name) for name in request.names]
    times_ns = request.times_ns
    arrays = []
    for order, given in enumerate(request.arrays):
        values = np.zeros((len(times_ns), len(joints)))
        values[:] = rest if order == 0 else 0.0
        values[:, named] = given
        values[np.isnan(given[:, 0])] = np.nan
        arrays.append(values)
    before_ns = max(now_ns - 1, 0) - start_ns
    if start_ns <= now_ns and times_ns[0] > before_ns:
        here = np.array([rest, np.zeros(len(joints)), np.zeros(len(joints))])
        for joint in named:
            here[:, joint] = standing[joint][:3]
        rows = [(before_ns, here), *_settled(before_ns, here, times_ns, arrays, settling)]
        times_ns = np.concatenate([[time_ns for time_ns, _ in rows], times_ns])
        for order, values in enumerate(arrays):
            # Efforts are until the goal's first point as there, as a spline has it.
            first = [values[0] if order == _EFFORTS else row[order] for _, row in rows]
            first = [np.where(np.isnan(values[0]), np.nan, row) for row in first]
            arrays[order] = np.vstack([*first, values])
    return GroupTrajectory(tuple(joints), start_ns, times_ns, PointArrays(*arrays))


def _settled(
    before_ns: int, here: Numbers, times_ns: Integers, arrays: Sequence[Numbers], settling: float
) -> list[tuple[int, Numbers]]:
    """Return the point at which joints that are too fast have come to rest, if there are any."""
    to_first_ns = int(times_ns[0]) - before_ns
    duration_ns = min(round(settling * NANOSECONDS), to_first_ns // 2)
    if np.isnan(arrays[1][0]).any() or duration_ns <= 0:
        return []  # straight lines swing nowhere
    there = np.empty_like(here)
    is_any_fast = False
    for joint in range(here.shape[1]):
        rows = here[:, joint].tolist(), [float(each[0, joint]) for each in arrays[:3]]
        has_all = not math.isnan(rows[1][2])
        start, end = (
            Knot(time_ns, row[0], row[1], row[2] if has_all else None)
            for time_ns, row in zip((0, to_first_ns), rows, strict=True)
        )
        position, velocity = rows[0][:2]
        if approach(start, end).velocity == velocity:
            there[:, joint] = Column("", (start, end), 1).start(1, None).sample(1 + duration_ns)
            continue
        way = 0.5 * velocity * duration_ns * SECONDS_PER_NANOSECOND
        there[:, joint] = position + way, 0.0, 0.0
        is_any_fast = True
    return [(before_ns + duration_ns, there)] if is_any_fast else []


# How joints stop. One that follows goes on as it would have for a moment, so that whenever its
# controller takes the stop up it is where the stop says, and then decelerates constantly: a
# segment that is a cubic like any other. One that does not follow (something blocks it) is held
# where it is: its reference returns there.

LEAD_NS = NANOSECONDS // 20
"""Time until controllers have taken a stop up; as long joints go on as they did, in [ns]."""

_RESERVE = 0.9  # of a deceleration; the rest is for the glide from where a controller really was
_GRID_NS = NANOSECONDS // 1000  # stops last whole milliseconds, so that knots do not crowd
_GRID = _GRID_NS * SECONDS_PER_NANOSECOND


class Braking(NamedTuple):
    """How a joint may be stopped; "rad" reads "m" where it is prismatic."""

    deceleration: float  # [rad/s^2] at most so much; 0 for none: then duration decides
    duration: float  # [s] how long a joint without a deceleration takes
    lower: float = -math.inf  # [rad] lowest position
    upper: float = math.inf  # [rad] highest position


def coast_down(
    position: float, velocity: float, later: tuple[float, float], braking: Braking
) -> list[Knot]:
    """Return knots of a joint that goes on for LEAD_NS and then stops by constant deceleration.

    Near a limit of its positions it decelerates more: it never passes it. A joint that is beyond
    a limit is brought back to it.
    """
    now, then = _inside(Knot(0, position, velocity), braking), Knot(LEAD_NS, *later)
    was_inside = now.position == position  # else it does not go on from where it was
    may_go_on = was_inside and _inside(then, braking) == then
    speed = abs(then.velocity or 0.0)
    if may_go_on and 0.5 * speed * _stopping_time(speed, braking) <= _room(then, braking):
        return [now, *_brake(then, braking)]
    return _brake(now, braking)


def _brake(start: Knot, braking: Braking) -> list[Knot]:
    """Return a knot, and the one at which the joint has stopped, within the positions."""
    velocity = start.velocity or 0.0
    speed, room = abs(velocity), _room(start, braking)
    if speed == 0.0:
        return [start]
    duration = _stopping_time(speed, braking)
    if 0.5 * speed * duration > room:
        duration_ns = max(int(2.0 * room / speed / _GRID), 1) * _GRID_NS
    else:
        duration_ns = math.ceil(duration / _GRID) * _GRID_NS
    distance = min(0.5 * speed * duration_ns * SECONDS_PER_NANOSECOND, room)
    if distance < speed * duration_ns * SECONDS_PER_NANOSECOND / 3.0:  # the cubic would swing back
        return [Knot(start.time_ns, start.position + math.copysign(room, velocity), 0.0)]
    end = start.position + math.copysign(distance, velocity)
    return [start, Knot(start.time_ns + duration_ns, end, 0.0)]


def _stopping_time(speed: float, braking: Braking) -> float:
    if braking.deceleration:
        return speed / (_RESERVE * braking.deceleration)
    return braking.duration


def _room(knot: Knot, braking: Braking) -> float:
    """Return how far a joint may go in the direction in which it moves."""
    is_up = (knot.velocity or 0.0) > 0.0
    return max(braking.upper - knot.position if is_up else knot.position - braking.lower, 0.0)


def return_to(target: float, position: float, velocity: float, braking: Braking) -> list[Knot]:
    """Return knots of a reference that comes to rest where the joint is.

    The time is such that the cubic to there nowhere accelerates more than the joint may.
    """
    duration = braking.duration
    if braking.deceleration:
        # Least T with 6 |d| + 4 |v| T <= a T^2, which bounds the acceleration at both ends.
        a, v, d = braking.deceleration, abs(velocity), abs(target - position)
        duration = (2.0 * v + math.sqrt(4.0 * v * v + 6.0 * a * d)) / a
    duration_ns = max(math.ceil(duration / _GRID), 1) * _GRID_NS
    return [Knot(0, position, velocity), Knot(duration_ns, target, 0.0)]


def stop_together(
    names: Sequence[str], knots: Sequence[Sequence[Knot]], now_ns: int
) -> GroupTrajectory:
    """Return the trajectory that stops all joints, each by knots of its own.

    The cubics of one joint are split where others have knots; a part of a cubic is the same cubic.
    """
    stamp_ns = max(now_ns - 1, 1)  # under way for every controller
    times = sorted({knot.time_ns for each in knots for knot in each})
    positions, velocities = (np.zeros((len(times), len(names))) for _ in range(2))
    for joint, each in enumerate(knots):
        reference = Column(names[joint], each, 1).start(1, each[0].position)
        for row, time_ns in enumerate(times):
            at = next((knot for knot in each if knot.time_ns == time_ns), None)
            sample = at[1:3] if at is not None else reference.sample(1 + time_ns)[:2]
            positions[row, joint], velocities[row, joint] = sample
    none = np.full_like(positions, np.nan)
    times_ns = np.array(times, dtype=np.int64)
    arrays = PointArrays(positions, velocities, none, none)
    return GroupTrajectory(tuple(names), stamp_ns, times_ns, arrays)


def _inside(knot: Knot, braking: Braking) -> Knot:
    """Return a knot within the positions; one at a limit does not go further."""
    inside = min(max(knot.position, braking.lower), braking.upper)
    velocity = knot.velocity or 0.0
    goes_out = velocity > 0.0 if inside == braking.upper else velocity < 0.0
    is_at_limit = inside in (braking.upper, braking.lower)
    return Knot(knot.time_ns, inside, 0.0 if is_at_limit and goes_out else velocity)
