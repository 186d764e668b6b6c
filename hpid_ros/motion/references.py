"""References as an experiment file says them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, TrajectoryError, unknown_name
from hpid_ros.base.records import Record, Section, from_mapping, quantity, take_record
from hpid_ros.base.schema import json_schema
from hpid_ros.base.units import Vector
from hpid_ros.motion.base_path import FORWARD, BasePath
from hpid_ros.motion.bricks import (
    BrickGoal,
    BrickPlan,
    Placement,
    PlanOptions,
    TaskRobot,
    plan_bricks,
)
from hpid_ros.motion.generators import combined, minimum_jerk, sine, step
from hpid_ros.motion.joint_trajectory import JointTrajectory
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.on_demand import kinematics


@dataclass(frozen=True)
class Waypoints(Record):
    """Positions of each joint at common times."""

    times: tuple[float, ...] = quantity("When the joints are there", "s")
    positions: Mapping[str, tuple[float, ...]] = quantity(
        "For each joint one position for each time", "rad"
    )

    def trajectory(self, kind: str) -> JointTrajectory:
        return (step if kind == "step" else minimum_jerk)(self.times, self.positions)


@dataclass(frozen=True)
class Oscillation(Record):
    """A sine of one joint."""

    amplitude: float = quantity("Of the sine", "rad")
    period: float = quantity("Of the sine", "s", above=0.0)
    offset: float = quantity("About which it swings", "rad", default=0.0)
    phase: float = quantity("At time 0", "rad", default=0.0)


@dataclass(frozen=True)
class Oscillations(Record):
    """A sine for each joint."""

    duration: float = quantity("Of the reference", "s", above=0.0)
    joints: Mapping[str, Oscillation] = quantity("The sine of each joint")

    def trajectory(self, kind: str) -> JointTrajectory:
        signals = {joint: asdict(each) for joint, each in self.joints.items()}
        return sine(self.duration, signals)


@dataclass(frozen=True)
class PathWheels(Record):
    """The wheels of a base, with all their lengths."""

    left_wheel: str = quantity("Joint of the left wheel")
    right_wheel: str = quantity("Joint of the right wheel")
    wheel_radius: float = quantity("Of both wheels", "m", above=0.0)
    wheel_separation: float = quantity("Between their contacts", "m", above=0.0)


@dataclass(frozen=True)
class PathSection(Record):
    """A path of a differential drive, as trajectories of its wheels."""

    base: PathWheels = quantity("The wheels of the base")
    times: tuple[float, ...] = quantity("When the base is at each pose", "s")
    poses: tuple[tuple[float, ...], ...] = quantity("x [m], y [m] and heading [rad] of each")
    directions: str | tuple[str, ...] = quantity(
        "forward or backward, for all legs or one for each", default=FORWARD
    )
    passes: bool = quantity("Whether the base drives through the poses between", default=False)
    velocity_limit: float | None = quantity("Of a wheel", "rad/s", default=None, above=0.0)
    curvature_limit: float | None = quantity("Of the path", "1/m", default=None, above=0.0)

    def trajectory(self, kind: str) -> JointTrajectory:
        legs = self.directions
        path = BasePath(
            self.times,
            self.poses,
            directions=[legs] * (len(self.poses) - 1) if isinstance(legs, str) else legs,
            passes=self.passes,
            curvature_limit=self.curvature_limit or math.inf,
        )
        wheels = asdict(self.base).values()
        return path.wheels(*wheels, velocity_limit=self.velocity_limit or math.inf)


_KINDS: dict[str, type[Waypoints | Oscillations | PathSection]] = {
    "minimum_jerk": Waypoints,
    "step": Waypoints,
    "sine": Oscillations,
    "base_path": PathSection,
}
_COMBINED = "combined"
REFERENCE_KINDS = (*_KINDS, _COMBINED)


def reference_from(values: object, where: str = "reference") -> JointTrajectory:
    """Return the trajectory that a ``reference`` section describes.

    ``kind: minimum_jerk`` and ``kind: step`` are :class:`Waypoints`, ``kind: sine`` is
    :class:`Oscillations`, ``kind: base_path`` is :class:`PathSection`; ``kind: combined`` has
    ``parts``, a list of such sections for different joints.
    """
    section = Section(values, where, TrajectoryError)
    kind = section.text("kind")
    if kind not in REFERENCE_KINDS:
        raise TrajectoryError(
            f"{section.place('kind')}: {unknown_name('kind', kind, REFERENCE_KINDS)}"
        )
    if kind == _COMBINED:
        return _combined(section)
    record = take_record(_KINDS[kind], section)
    section.finish()
    try:
        return record.trajectory(kind)
    except HpidError as error:
        raise TrajectoryError(f"{where}: {error}") from None


def _combined(section: Section) -> JointTrajectory:
    parts = section.take("parts")
    section.finish()
    if not isinstance(parts, list) or not parts:
        raise TrajectoryError(f"{section.place('parts')} must be a list of references")
    place = section.place("parts")
    if any(isinstance(part, Mapping) and part.get("kind") == _COMBINED for part in parts):
        raise TrajectoryError(f"{place} must not hold a combined reference again")
    each = [reference_from(part, f"{place}[{index}]") for index, part in enumerate(parts)]
    try:
        return combined(each)
    except TrajectoryError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None


BRICKS = "bricks"
HAND = "payload"
"""Link that holds a brick where ``scene.gripper`` names none."""
OPENING = 0.078
"""Of the gripper, in [m], where ``scene.gripper`` gives none."""


@dataclass(frozen=True)
class Belief(Record):
    """Where a brick is believed to be; what is left out is as in the scene."""

    position: Vector | None = quantity("Its centre x, y, z in the frame odom", "m", default=None)
    yaw: float | None = quantity("Its turn about z", "rad", default=None)
    approach: float | None = quantity("Heading of the base before it", "rad", default=None)

    def over(self, known: KnownBox) -> Placement:
        """Return the placement that is meant, with what the scene says of it."""
        return Placement(
            known.position if self.position is None else self.position,
            known.yaw if self.yaw is None else self.yaw,
            self.approach,
        )


@dataclass(frozen=True)
class KnownBox(Record):
    """What a plan asks of a brick of the scene."""

    size: Vector = quantity("Edges along its own x, y, z", "m", above=0.0)
    position: Vector = quantity("Its centre in the frame odom", "m")
    yaw: float = quantity("Its turn about z", "rad", default=0.0)


@dataclass(frozen=True)
class CarriedBrick(Record):
    """One brick of a task."""

    brick: str = quantity("Its name in the scene")
    place: Placement = quantity("Where it is put")
    pick: Belief | None = quantity(
        "Where it is taken, if it is believed elsewhere than the scene has it", default=None
    )


@dataclass(frozen=True, kw_only=True)
class BrickTask(PlanOptions):
    """Bricks are carried one after the other."""

    bricks: tuple[CarriedBrick, ...] = quantity(
        "The bricks, in the order in which they are carried"
    )
    arm: tuple[str, ...] = quantity(
        "Joints of the arm; all between the root and the hand if left out", default=()
    )
    folded: Mapping[str, float] = quantity(
        "The arm's positions while the base drives; the initial ones if left out",
        "rad",
        factory=dict,
    )


class PlannedReference(NamedTuple):
    """A reference, and the plan behind it."""

    trajectory: JointTrajectory  # what the joints follow
    plan: BrickPlan | None = None  # the brick task; None for any other kind


def planned_reference(
    document: object, where: str, load_robot: Callable[[RobotSection], RobotDescription]
) -> PlannedReference:
    """Return the reference of a whole document: an experiment, or a file with a reference.

    ``kind: bricks`` is a :class:`BrickTask`, for which ``load_robot`` is asked for the robot of
    the document's section; every other kind is that of :func:`reference_from`.
    """
    values = document.get("reference") if isinstance(document, Mapping) else None
    if not (isinstance(values, Mapping) and values.get("kind") == BRICKS):
        return PlannedReference(reference_from(values, where))
    root = Section(document, "", TrajectoryError)
    # Of scene and robot what a plan needs; the rest is read, and checked, by others.
    scene = root.section("scene", {})
    gripper, boxes = scene.section("gripper", {}), scene.section("bricks", {})
    known = {name: take_record(KnownBox, boxes.section(name)) for name in boxes.items()}
    opening = gripper.number("opening", OPENING, above=0.0)
    hand = gripper.text("link", HAND)
    own = from_mapping(RobotSection, root.take("robot"), "robot", TrajectoryError)
    description = load_robot(own)
    drive = None if own.base is None else own.base.drive(description)
    others = description.start(own.initial_positions)
    robot = TaskRobot(description, drive, others, opening)
    section = Section(values, where, TrajectoryError)
    section.take("kind")
    task = take_record(BrickTask, section)
    section.finish()
    if not task.bricks:
        raise TrajectoryError(f"{section.place('bricks')} must name at least one brick")
    arm = kinematics(description, hand, task.arm or None, others)
    for joint in task.folded:
        if joint not in arm.joints:
            place = section.place("folded")
            raise TrajectoryError(f"{place}: {unknown_name('joint', joint, arm.joints)}")
    folded = task.folded or others
    goals = [
        _goal(goal, f"{section.place('bricks')}[{index}]", known)
        for index, goal in enumerate(task.bricks)
    ]
    try:
        rest = [folded.get(joint, 0.0) for joint in arm.joints]
        plan = plan_bricks(robot, arm, goals, rest, task)
    except HpidError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None
    return PlannedReference(plan.trajectory, plan)


def task_schema() -> dict[str, Any]:
    """Return the JSON Schema of a ``reference`` of any kind."""
    kinds = [_of_kind(name, json_schema(record)) for name, record in _KINDS.items()]
    whole = {
        "type": "object",
        "description": "References of different joints.",
        "properties": {"parts": {"type": "array", "minItems": 1, "items": {"oneOf": kinds}}},
        "required": ["parts"],
        "additionalProperties": False,
    }
    bricks = json_schema(BrickTask)
    return {"oneOf": [*kinds, _of_kind(_COMBINED, whole), _of_kind(BRICKS, bricks)]}


def _of_kind(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a section with its ``kind``."""
    properties = {"kind": {"const": name}, **schema["properties"]}
    return {**schema, "properties": properties, "required": ["kind", *schema.get("required", ())]}


def _goal(goal: CarriedBrick, where: str, known: Mapping[str, KnownBox]) -> BrickGoal:
    if goal.brick not in known:
        raise TrajectoryError(f"{where}.brick: {unknown_name('brick', goal.brick, known)}")
    box = known[goal.brick]
    return BrickGoal(goal.brick, box.size, (goal.pick or Belief()).over(box), goal.place)
