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
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import TrajectoryError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.planning.motion import ArmMotion, BaseMotion, PlanePose
from hpid_ros.planning.plan import (
    BrickGoal,
    BrickPlan,
    Grip,
    Placement,
    PlanOptions,
    TaskPose,
    TaskRobot,
)
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.kinematics import Kinematics, LinkPose, ReachError
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.trajectory.combining import combined
from hpid_ros.trajectory.spline import segment

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
    """Plan a brick task."""
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
        """Return what was put together."""
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
        for at_x, at_y in (
            (x - ahead * math.cos(heading), y - ahead * math.sin(heading)),
            (x, y),
        ):
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
            arm.line(_seen_from(station, at_it), options.line_speed)
            arm.wait(options.settle)
            self._note(what, goal, at_it)
            self.grips.append(Grip(arm.time_ns, what == "pick", goal.name))
            arm.wait(options.grip_time)
            arm.line(_seen_from(station, above), options.line_speed)
            self._note("lifted" if what == "pick" else "retreated", goal, above)
        except (ReachError, TrajectoryError) as error:
            raise TrajectoryError(f"brick {goal.name!r}, {what}: {error}") from None
        arm.move(self._folded)

    def _note(self, phase: str, goal: BrickGoal, pose: LinkPose) -> None:
        self.poses.append(TaskPose(self._arm_motion.time_ns, phase, goal.name, pose))

    def _solve(self, hand: LinkPose, station: PlanePose, start: Numbers) -> Numbers:
        return self._arm.solve(_seen_from(station, hand), start)

    def _hand(self, where: Placement, quarter: int, height: float) -> LinkPose:
        """Return the hand at a height above a brick's centre, in ``odom``."""
        turn = where.yaw + quarter * math.tau / _QUARTERS
        return LinkPose(np.add(where.position, (0.0, 0.0, height)), about_z(turn) @ _DOWN)


def _seen_from(station: PlanePose, pose: LinkPose) -> LinkPose:
    """Return a pose in ``odom`` as the base at a station sees it."""
    x, y, heading = station
    back = about_z(-heading)
    return LinkPose(back @ (pose.position - [x, y, 0.0]), back @ pose.rotation)


def about_z(angle: float) -> Numbers:
    """Return the rotation matrix of a turn about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
