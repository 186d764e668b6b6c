"""A brick task as an experiment file says it, beside every other kind of reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, TrajectoryError, unknown_name
from hpid_ros.documents.descriptions import json_schema
from hpid_ros.documents.records import Record, quantity, take_record
from hpid_ros.documents.sections import Section
from hpid_ros.planning.plan import BrickGoal, BrickPlan, Placement, PlanOptions, TaskRobot
from hpid_ros.robot.configuration import RobotSection
from hpid_ros.robot.description import RobotDescription
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.trajectory import reference_from as trajectory_from
from hpid_ros.trajectory.configuration import of_kind, reference_schema

BRICKS = "bricks"
HAND = "payload"
"""Link that holds a brick where ``scene.gripper`` names none."""


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Target(Record):
    """Where a brick is put."""

    position: Triple = quantity("Its centre x, y, z in the frame odom", "m")
    yaw: float = quantity("Its turn about z", "rad", default=0.0)
    approach: float | None = quantity(
        "Heading of the base before it; straight from where it is if left out", "rad", default=None
    )


@dataclass(frozen=True)
class Belief(Record):
    """Where a brick is believed to be; what is left out is as in the scene."""

    position: Triple | None = quantity("Its centre x, y, z in the frame odom", "m", default=None)
    yaw: float | None = quantity("Its turn about z", "rad", default=None)
    approach: float | None = quantity("Heading of the base before it", "rad", default=None)

    def over(self, known: Placement) -> Placement:
        """Return the placement that is meant, with what the scene says of it."""
        return Placement(
            known.position if self.position is None else self.position,
            known.yaw if self.yaw is None else self.yaw,
            self.approach,
        )


@dataclass(frozen=True)
class KnownBox(Record):
    """What a plan asks of a brick of the scene."""

    size: Triple = quantity("Edges along its own x, y, z", "m", above=0.0)
    position: Triple = quantity("Its centre in the frame odom", "m")
    yaw: float = quantity("Its turn about z", "rad", default=0.0)


@dataclass(frozen=True)
class CarriedBrick(Record):
    """One brick of a task."""

    brick: str = quantity("Its name in the scene")
    place: Target = quantity("Where it is put")
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


class KnownScene(NamedTuple):
    """What a plan knows of the scene."""

    # size and place of each brick, by name
    bricks: Mapping[str, tuple[tuple[float, float, float], Placement]]
    hand: str = HAND  # link that holds a brick
    opening: float = math.inf  # [m] widest brick that it can take


def planned_reference(
    document: object, where: str, load_robot: Callable[[str], RobotDescription]
) -> PlannedReference:
    """Return the reference of a whole document: an experiment, or a file with a reference."""
    section = document.get("reference") if isinstance(document, Mapping) else None
    if not (isinstance(section, Mapping) and section.get("kind") == BRICKS):
        return PlannedReference(trajectory_from(section, where))
    root = Section(document, "", TrajectoryError)
    scene = _known_scene(root.section("scene", {}))
    robot = _task_robot(root.section("robot"), load_robot, scene.opening)
    return reference_from(section, where, robot, scene)


def reference_from(
    values: object, where: str, robot: TaskRobot, scene: KnownScene
) -> PlannedReference:
    """Return the reference that a section describes.

    ``kind: bricks`` is a :class:`BrickTask`; every other kind is that of
    :func:`hpid_ros.trajectory.reference_from`.
    """
    section = Section(values, where, TrajectoryError)
    if section.text("kind") != BRICKS:
        return PlannedReference(trajectory_from(values, where))
    # Pinocchio takes a moment to import, and other references do without.
    from hpid_ros.planning.bricks import plan_bricks
    from hpid_ros.robot.kinematics import Kinematics

    task = take_record(BrickTask, section)
    section.finish()
    if not task.bricks:
        raise TrajectoryError(f"{section.place('bricks')} must name at least one brick")
    others = robot.initial_positions
    arm = Kinematics(robot.description, scene.hand, task.arm or None, others)
    for joint in task.folded:
        if joint not in arm.joints:
            place = section.place("folded")
            raise TrajectoryError(f"{place}: {unknown_name('joint', joint, arm.joints)}")
    folded = task.folded or others
    goals = [
        _goal(goal, f"{section.place('bricks')}[{index}]", scene)
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
    return reference_schema(of_kind(BRICKS, json_schema(BrickTask)))


def _goal(goal: CarriedBrick, where: str, scene: KnownScene) -> BrickGoal:
    if goal.brick not in scene.bricks:
        raise TrajectoryError(f"{where}.brick: {unknown_name('brick', goal.brick, scene.bricks)}")
    size, known = scene.bricks[goal.brick]
    pick = known if goal.pick is None else goal.pick.over(known)
    place = goal.place
    return BrickGoal(goal.brick, size, pick, Placement(place.position, place.yaw, place.approach))


def _task_robot(
    section: Section, load_robot: Callable[[str], RobotDescription], opening: float
) -> TaskRobot:
    """Return the robot that a section describes, with a hand of some opening, in [m]."""
    robot = take_record(RobotSection, section)
    section.finish()
    description = robot.load(load_robot)
    drive = None if robot.base is None else robot.base.drive(description)
    return TaskRobot(description, drive, robot.initial_positions, opening)


def _known_scene(section: Section) -> KnownScene:
    """Return what a plan needs of the scene; the rest is read, and checked, by others."""
    gripper, bricks = section.section("gripper", {}), section.section("bricks", {})
    known = {}
    for name in bricks.items():
        brick = bricks.section(name)
        known[name] = _known_brick(brick)
    opening = gripper.number("opening", above=0.0) if "opening" in gripper else math.inf
    return KnownScene(known, gripper.text("link", HAND), opening)


def _known_brick(section: Section) -> tuple[Triple, Placement]:
    box = take_record(KnownBox, section)
    return box.size, Placement(box.position, box.yaw)
