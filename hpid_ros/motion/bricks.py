"""The brick task: base and arm fetch bricks one after the other and put them elsewhere.

For each brick the base drives to a standoff before it with the arm folded; the hand moves above
the brick, down to it in a straight line, closes, goes straight up; the arm folds, the base backs
off, turns and drives to the standoff before the brick's place; the hand goes above it, straight
down, opens, goes straight up; the arm folds. The base stands while the arm moves and the other
way round. Obstacles are not looked at: a support that is in the way will be met.

The hand points straight down; of the four quarter turns in which it can take a box, those in
which the brick is not wider than the opening are tried, and the one nearest to the folded arm is
taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from hpid_ros.base.errors import ReachError, TrajectoryError
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND, Numbers, Vector
from hpid_ros.motion.base_path import BACKWARD, FORWARD, BasePath
from hpid_ros.motion.generators import combined
from hpid_ros.motion.joint_trajectory import JointTrajectory, TrajectoryPoint, segment
from hpid_ros.robot.description import LinkPose, RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive

if TYPE_CHECKING:
    from hpid_ros.robot.kinematics import Kinematics


@dataclass(frozen=True)
class TaskRobot:
    """The robot that does a task."""

    description: RobotDescription  # the robot
    base: DifferentialDrive | None = None  # its base; None where the root does not move
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    opening: float = math.inf  # [m] widest brick that its hand can take


@dataclass(frozen=True)
class PlanOptions(Record):
    """How a brick task is done."""

    standoff: float = quantity(
        "Distance of the base's origin from a brick, or from its place, when the arm takes or "
        "puts it",
        "m",
        default=0.42,
        above=0.0,
    )
    back_off: float = quantity(
        "How far the base drives backwards before it turns away", "m", default=0.2, least=0.0
    )
    clearance: float = quantity(
        "How far above a brick the straight line to it begins", "m", default=0.12, above=0.0
    )
    release_gap: float = quantity(
        "How far above its place a brick is let go", "m", default=0.003, least=0.0
    )
    settle: float = quantity(
        "Wait before the fingers close or open, for the errors to die out",
        "s",
        default=1.5,
        least=0.0,
    )
    grip_time: float = quantity(
        "Wait after the fingers have closed or opened", "s", default=0.3, least=0.0
    )
    arm_speed: float = quantity(
        "Largest joint speed, as a share of the joint's limit", default=0.35, above=0.0, most=1.0
    )
    line_speed: float = quantity(
        "Largest speed of the hand on a straight line", "m/s", default=0.1, above=0.0
    )
    drive_speed: float = quantity("Largest speed of the base", "m/s", default=0.25, above=0.0)
    turn_speed: float = quantity(
        "Largest turning speed of the base", "rad/s", default=0.6, above=0.0
    )


@dataclass(frozen=True)
class Placement(Record):
    """Where a brick is put."""

    position: Vector = quantity("Its centre x, y, z in the frame odom", "m")
    yaw: float = quantity("Its turn about z", "rad", default=0.0)
    approach: float | None = quantity(
        "Heading of the base before it; straight from where it is if left out", "rad", default=None
    )


@dataclass(frozen=True)
class BrickGoal:
    """A brick, where it is, and where it shall be."""

    name: str  # name of the brick
    size: Vector  # [m] edges along its own x, y, z
    pick: Placement  # where it is
    place: Placement  # where it shall be


class Grip(NamedTuple):
    """The gripper closes or opens."""

    time_ns: int  # [ns] from the start
    is_closed: bool  # whether it closes
    brick: str  # name of the brick that it is for


class TaskPose(NamedTuple):
    """Where the hand is to be, in the frame ``odom``."""

    time_ns: int  # [ns] when, from the start
    phase: str  # above pick, pick, lifted, above place, place or retreated
    brick: str  # name of the brick
    pose: LinkPose  # the hand


@dataclass(frozen=True)
class BrickPlan:
    """A whole brick task."""

    trajectory: JointTrajectory  # of all joints, the wheels first
    grips: tuple[Grip, ...]  # when the gripper closes and opens
    poses: tuple[TaskPose, ...]  # what the hand has to reach, in order
    goals: tuple[BrickGoal, ...]  # the bricks, in order

    @property
    def duration(self) -> float:
        """Time of the last point, in [s]."""
        return self.trajectory.points[-1].time_from_start_ns * 1e-9


PEAK = 1.875  # largest speed of a minimum-jerk motion over its mean speed
_SHORTEST_REACH = 0.2  # [s]
_TICK_NS = 1_000_000  # every piece ends at a whole millisecond
_PIECE = 0.05  # [s] of a straight line between two solutions of the inverse kinematics
_LARGEST_JUMP = 0.3  # [rad] between two neighbouring solutions on a line
_DIGITS = 10  # of a knot: what is beyond is rounding of the solver, and differs by machine


class MotionRow(NamedTuple):
    """All joints at one instant."""

    time_ns: int  # [ns] from the start
    positions: Numbers  # [rad]
    velocities: Numbers  # [rad/s]
    accelerations: Numbers  # [rad/s^2]


class ArmMotion:
    """A motion that begins and ends every piece at rest."""

    def __init__(self, arm: Kinematics, start: npt.ArrayLike, speed: float) -> None:
        self._arm = arm
        joints = arm.description.select(arm.joints)
        for joint in joints:
            if math.isinf(joint.velocity):
                raise TrajectoryError(
                    f"{joint.name} has no velocity limit: robot.joints.{joint.name}.velocity "
                    "must give one"
                )
        self._speeds = speed * np.array([joint.velocity for joint in joints])
        self.time_ns = 0
        self._rows = [self._at_rest(np.asarray(start, dtype=float))]

    @property
    def positions(self) -> Numbers:
        """Where the arm stands at the end, in [rad]."""
        return self._rows[-1].positions

    def wait(self, seconds: float) -> None:
        """Stay."""
        if seconds > 0.0:
            self.time_ns += _whole(seconds)
            self._rows.append(self._at_rest(self.positions))

    def move(self, target: Numbers) -> None:
        distance = np.abs(target - self.positions)
        if not distance.any():
            return
        self.time_ns += _whole(max(_SHORTEST_REACH, float(np.max(PEAK * distance / self._speeds))))
        self._rows.append(self._at_rest(target))

    def line(self, target: LinkPose, speed: float) -> None:
        """Move the link along a straight line with least jerk, its axes unchanged."""
        start = self._arm.pose(self.positions).position
        length = float(np.linalg.norm(target.position - start))
        if length == 0.0:
            return
        duration_ns = _whole(max(_SHORTEST_REACH, PEAK * length / speed))
        count = max(4, math.ceil(duration_ns / NANOSECONDS / _PIECE))
        shares = np.linspace(0.0, 1.0, count + 1)
        times_ns = [round(share * duration_ns) for share in shares]
        solutions = [self.positions]
        for share in shares[1:]:
            way = share**3 * (10.0 + share * (-15.0 + 6.0 * share))
            point = LinkPose(start + way * (target.position - start), target.rotation)
            solutions.append(self._arm.solve(point, solutions[-1]).round(_DIGITS))
            if np.abs(solutions[-1] - solutions[-2]).max() > _LARGEST_JUMP:
                raise TrajectoryError(
                    f"{self._arm.link} cannot follow a straight line to "
                    f"{target.position.round(3).tolist()} m: the joints would have to jump"
                )
        self._add_spline(times_ns, solutions)

    def trajectory(self) -> JointTrajectory:
        points = tuple(
            TrajectoryPoint(row.time_ns, *(tuple(values.tolist()) for values in row[1:]))
            for row in self._rows
        )
        return JointTrajectory(self._arm.joints, points)

    def _add_spline(self, times_ns: list[int], solutions: list[Numbers]) -> None:
        """Go smoothly through solutions, at rest at both ends.

        A spline of fifth degree with its knots at the solutions is, between two of them, the one
        polynomial that the trajectory's quintic segments make of both ends' derivatives.
        """
        from scipy.interpolate import make_interp_spline  # slow to import, and only needed here

        still = np.zeros_like(solutions[0])
        ends = [(1, still), (2, still)]
        times = np.array(times_ns) / NANOSECONDS
        spline = make_interp_spline(times, np.array(solutions), k=5, bc_type=(ends, ends))
        values = [spline(times, nu=order).round(_DIGITS) for order in range(3)]
        for index in range(1, len(times_ns) - 1):
            row = MotionRow(self.time_ns + times_ns[index], *(each[index] for each in values))
            self._rows.append(row._replace(positions=solutions[index]))
        self.time_ns += times_ns[-1]
        self._rows.append(self._at_rest(solutions[-1]))

    def _at_rest(self, positions: Numbers) -> MotionRow:
        still = np.zeros_like(positions)
        return MotionRow(self.time_ns, positions, still, still)


def _whole(seconds: float) -> int:
    """Return a time in [ns], rounded up to a whole tick."""
    return math.ceil(round(seconds * NANOSECONDS) / _TICK_NS) * _TICK_NS


_SHORTEST_DRIVE = 0.4  # [s]
_NEAR = 1e-6  # [m, rad]: nothing to do

PlanePose = tuple[float, float, float]
"""x [m], y [m], heading [rad] in the frame ``odom``."""


class BaseMotion:
    """A path that begins at the origin of ``odom`` and rests at the end of every piece."""

    def __init__(self, drive_speed: float, turn_speed: float) -> None:
        self._drive_speed, self._turn_speed = drive_speed, turn_speed
        self.pose: PlanePose = (0.0, 0.0, 0.0)
        self._poses = [self.pose]
        self._times_ns = [0]
        self._directions: list[str] = []

    @property
    def time_ns(self) -> int:
        """Where the motion ends so far, in [ns]."""
        return self._times_ns[-1]

    def wait_until(self, time_ns: int) -> None:
        """Stay until a moment, in [ns]."""
        if time_ns > self.time_ns:
            self._add(self.pose, time_ns)

    def turn(self, heading: float) -> None:
        """Turn in place, the shorter way round."""
        x, y, before = self.pose
        angle = math.remainder(heading - before, math.tau)
        if abs(angle) > _NEAR:
            self._add((x, y, before + angle), self._after(abs(angle) / self._turn_speed))

    def drive(self, distance: float) -> None:
        x, y, heading = self.pose
        if abs(distance) > _NEAR:
            there = (x + distance * math.cos(heading), y + distance * math.sin(heading), heading)
            direction = FORWARD if distance > 0.0 else BACKWARD
            self._add(there, self._after(abs(distance) / self._drive_speed), direction)

    def trajectory(self, base: DifferentialDrive, velocity_limit: float) -> JointTrajectory:
        if len(self._poses) == 1:
            self._add(self.pose, self.time_ns + NANOSECONDS)
        times = [time_ns / NANOSECONDS for time_ns in self._times_ns]
        path = BasePath(times, self._poses, directions=self._directions)
        wheels = (*base.joints, base.radius, base.separation)
        return path.wheels(*wheels, velocity_limit=velocity_limit)

    def _after(self, seconds: float) -> int:
        """Return when a piece of this mean duration ends, in [ns], at a whole millisecond."""
        milliseconds = math.ceil(round(max(_SHORTEST_DRIVE, PEAK * seconds) * 1e6) / 1e3)
        return self.time_ns + milliseconds * 1_000_000

    def _add(self, pose: PlanePose, time_ns: int, direction: str = FORWARD) -> None:
        self.pose = pose
        self._poses.append(pose)
        self._times_ns.append(time_ns)
        self._directions.append(direction)


_LOOKS = np.linspace(0.0, 1.0, 21)  # in each segment
_SLACK = 1e-9  # of a limit, for rounding


def check_limits(trajectory: JointTrajectory, description: RobotDescription) -> None:
    """Refuse a trajectory that passes a joint's limits of position or velocity."""
    for joint in description.select(trajectory.joint_names):
        for start, end in pairwise(trajectory.column(joint.name).knots):
            c = segment(start, end)
            t = _LOOKS * (end.time_ns - start.time_ns) * SECONDS_PER_NANOSECOND
            position = np.polynomial.polynomial.polyval(t, c)
            rate = np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(c))
            at = f"{joint.name} at {start.time_ns * SECONDS_PER_NANOSECOND:.3f} s"
            unit = "m" if joint.is_slide else "rad"
            if position.min() < joint.lower - _SLACK or position.max() > joint.upper + _SLACK:
                raise TrajectoryError(
                    f"{at} would be at {position.min():.4g} to {position.max():.4g} {unit}, "
                    f"its limits are {joint.lower:g} and {joint.upper:g} {unit}"
                )
            fastest = float(np.abs(rate).max())
            if fastest > joint.velocity + _SLACK:
                raise TrajectoryError(
                    f"{at} would move at {fastest:.4g} {unit}/s, its limit is "
                    f"{joint.velocity:g} {unit}/s: lower arm_speed, line_speed or drive_speed"
                )


_QUARTERS = 4
_DOWN = np.diag([1.0, -1.0, -1.0])  # a hand whose z points down and whose x points ahead


def plan_bricks(
    robot: TaskRobot,
    arm: Kinematics,
    goals: Sequence[BrickGoal],
    folded: npt.ArrayLike,
    options: PlanOptions | None = None,
) -> BrickPlan:
    if not goals:
        raise TrajectoryError("a brick task must have at least one brick, not none")
    planner = _Planner(robot, arm, np.asarray(folded, dtype=float), options or PlanOptions())
    for goal in goals:
        planner.carry(goal)
    trajectory = planner.trajectory()
    check_limits(trajectory, robot.description)
    return BrickPlan(trajectory, tuple(planner.grips), tuple(planner.poses), tuple(goals))


class _Planner:
    """Puts a task together brick by brick."""

    def __init__(
        self, robot: TaskRobot, arm: Kinematics, folded: Numbers, options: PlanOptions
    ) -> None:
        self._robot, self._arm, self._folded, self._options = robot, arm, folded, options
        start = [robot.initial_positions.get(joint, 0.0) for joint in arm.joints]
        self._arm_motion = ArmMotion(arm, start, options.arm_speed)
        self._base_motion = BaseMotion(options.drive_speed, options.turn_speed)
        self._is_at_brick = False
        self.grips: list[Grip] = []
        self.poses: list[TaskPose] = []

    def carry(self, goal: BrickGoal) -> None:
        """Fetch one brick and put it down."""
        quarter = self._choose_quarter(goal)
        self._go(goal.pick)
        self._reach_down(goal, "pick", quarter)
        self._go(goal.place)
        self._reach_down(goal, "place", quarter)

    def trajectory(self) -> JointTrajectory:
        arm, base = self._arm_motion, self._robot.base
        if base is None:
            return arm.trajectory()
        self._base_motion.wait_until(arm.time_ns)
        wheels = self._robot.description.select(base.joints)
        limit = min(wheel.velocity for wheel in wheels)
        return combined([self._base_motion.trajectory(base, limit), arm.trajectory()])

    def _choose_quarter(self, goal: BrickGoal) -> int:
        """Return the quarter turn of the hand against the brick that costs the least motion."""
        opening = self._robot.opening
        fitting = [k for k in range(_QUARTERS) if goal.size[(k + 1) % 2] <= opening]
        if not fitting:
            raise TrajectoryError(
                f"brick {goal.name!r} is {min(goal.size[:2]):g} m wide, more than the gripper's "
                f"opening of {opening:g} m"
            )
        pick = self._station(self._base_motion.pose, goal.pick, self._is_at_brick)
        place = self._station(pick, goal.place, True)
        costs = {}
        for what, where, station in (("pick", goal.pick, pick), ("place", goal.place, place)):
            for quarter in tuple(fitting):
                try:
                    costs[what, quarter] = self._cost(where, station, quarter)
                except ReachError as error:
                    refusal = f"brick {goal.name!r}, {what}: {error}"
                    fitting.remove(quarter)
            if not fitting:
                raise TrajectoryError(refusal)
        return min(fitting, key=lambda k: round(costs["pick", k] + costs["place", k], 6))

    def _cost(self, where: Placement, station: PlanePose, quarter: int) -> float:
        """Return how far the joints are from the folded arm above a brick, in [rad]."""
        above = self._hand(where, quarter, self._options.clearance)
        return float(np.abs(self._solve(above, station, self._folded) - self._folded).sum())

    def _station(self, before: PlanePose, where: Placement, backs_off: bool) -> PlanePose:
        """Return where the base stands to reach something; it may back off before."""
        if self._robot.base is None:
            return (0.0, 0.0, 0.0)
        x, y, _ = where.position
        heading = where.approach
        if heading is None:
            back = self._options.back_off if backs_off else 0.0
            from_x = before[0] - back * math.cos(before[2])
            from_y = before[1] - back * math.sin(before[2])
            heading = math.atan2(y - from_y, x - from_x)
        reach = self._options.standoff
        return (x - reach * math.cos(heading), y - reach * math.sin(heading), heading)

    def _go(self, where: Placement) -> None:
        """Fold the arm and drive the base to the standoff before something."""
        arm, base = self._arm_motion, self._base_motion
        arm.move(self._folded)
        if self._robot.base is None:
            return
        x, y, heading = self._station(base.pose, where, self._is_at_brick)
        base.wait_until(arm.time_ns)
        if self._is_at_brick:
            base.drive(-self._options.back_off)
        # In line with what is approached before the last, straight piece.
        ahead = self._options.back_off if where.approach is not None else 0.0
        for at_x, at_y in ((x - ahead * math.cos(heading), y - ahead * math.sin(heading)), (x, y)):
            way_x, way_y = at_x - base.pose[0], at_y - base.pose[1]
            distance = math.hypot(way_x, way_y)
            if distance > 1e-6:
                base.turn(math.atan2(way_y, way_x))
                base.drive(distance)
        base.turn(heading)
        arm.wait((base.time_ns - arm.time_ns) * 1e-9)
        self._is_at_brick = True

    def _reach_down(self, goal: BrickGoal, what: str, quarter: int) -> None:
        """Reach down in a straight line, close or open, and go up again."""
        arm, options = self._arm_motion, self._options
        where = goal.pick if what == "pick" else goal.place
        gap = 0.0 if what == "pick" else options.release_gap
        above = self._hand(where, quarter, options.clearance)
        at_it = self._hand(where, quarter, gap)
        station = self._base_motion.pose
        try:
            arm.move(self._solve(above, station, self._folded).round(10))
            self._note(f"above {what}", goal, above)
            arm.line(self._seen_from(station, at_it), options.line_speed)
            arm.wait(options.settle)
            self._note(what, goal, at_it)
            self.grips.append(Grip(arm.time_ns, what == "pick", goal.name))
            arm.wait(options.grip_time)
            arm.line(self._seen_from(station, above), options.line_speed)
            self._note("lifted" if what == "pick" else "retreated", goal, above)
        except (ReachError, TrajectoryError) as error:
            raise TrajectoryError(f"brick {goal.name!r}, {what}: {error}") from None
        arm.move(self._folded)

    def _note(self, phase: str, goal: BrickGoal, pose: LinkPose) -> None:
        self.poses.append(TaskPose(self._arm_motion.time_ns, phase, goal.name, pose))

    def _solve(self, hand: LinkPose, station: PlanePose, start: Numbers) -> Numbers:
        return self._arm.solve(self._seen_from(station, hand), start)

    def _hand(self, where: Placement, quarter: int, height: float) -> LinkPose:
        """Return the hand at a height above a brick's centre, in ``odom``."""
        turn = where.yaw + quarter * math.tau / _QUARTERS
        return LinkPose(np.add(where.position, (0.0, 0.0, height)), about_z(turn) @ _DOWN)

    def _seen_from(self, station: PlanePose, pose: LinkPose) -> LinkPose:
        """Return a pose in ``odom`` as the base at a station sees it."""
        x, y, heading = station
        height = 0.0 if self._robot.base is None else self._robot.base.height
        back = about_z(-heading)
        return LinkPose(back @ (pose.position - [x, y, height]), back @ pose.rotation)


def about_z(angle: float) -> Numbers:
    """Return the rotation matrix of a turn about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
