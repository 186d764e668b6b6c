"""A brick task as an experiment file says it, beside every other kind of reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, TrajectoryError, unknown_name
from hpid_ros.documents.sections import Section
from hpid_ros.planning.plan import BrickGoal, BrickPlan, Placement, PlanOptions, TaskRobot
from hpid_ros.robot.configuration import amended_by
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.trajectory import JointTrajectory
from hpid_ros.trajectory import reference_from as trajectory_from

BRICKS = "bricks"
HAND = "payload"
"""Link that holds a brick where ``scene.gripper`` names none."""


class PlannedReference(NamedTuple):
    """A reference, and the plan behind it.

    Attributes:
        trajectory: What the joints follow.
        plan: The brick task; None for any other kind.
    """

    trajectory: JointTrajectory
    plan: BrickPlan | None = None


class KnownScene(NamedTuple):
    """What a plan knows of the scene.

    Attributes:
        bricks: Size and place of each brick, by name.
        hand: Link that holds a brick.
        opening: Widest brick that it can take, in [m]; None where nothing says so.
    """

    bricks: Mapping[str, tuple[tuple[float, float, float], Placement]]
    hand: str = HAND
    opening: float | None = None


def planned_reference(
    document: object, where: str, load_robot: Callable[[str], RobotDescription]
) -> PlannedReference:
    """Return the reference of a whole document: an experiment, or a file with a reference.

    Args:
        document: The document. For ``kind: bricks`` its sections ``robot`` (``description``,
            ``base``, ``initial_positions``) and ``scene`` are read too.
        where: Place of ``reference``, for the messages.
        load_robot: Returns the robot of what ``robot.description`` says.

    Raises:
        HpidError: A key is missing or unknown, the robot cannot be read, or the numbers make no
            reference.
    """
    section = document.get("reference") if isinstance(document, Mapping) else None
    if not (isinstance(section, Mapping) and section.get("kind") == BRICKS):
        return PlannedReference(trajectory_from(section, where))
    root = Section(document, "", TrajectoryError)
    robot = _task_robot(root.section("robot"), load_robot)
    return reference_from(section, where, robot, _known_scene(root.section("scene", {})))


def reference_from(
    values: object, where: str, robot: TaskRobot, scene: KnownScene
) -> PlannedReference:
    """Return the reference that a section describes.

    ``kind: bricks`` has ``bricks``, a list of ``brick`` (a name of the scene), ``place`` and, if
    the brick is believed elsewhere than the scene has it, ``pick``, each with ``position`` (its
    centre x, y, z [m]), ``yaw`` [rad] and ``approach`` (heading of the base [rad]); ``folded``,
    the arm's positions [rad] while the base drives (the initial ones); ``arm``, its joints (all
    between the root and the hand); and any of
    :class:`~hpid_ros.planning.plan.PlanOptions`. Every other kind is that of
    :func:`hpid_ros.trajectory.reference_from`.

    Args:
        values: The section.
        where: Its place in the document, for the messages.
        robot: The robot that does the task.
        scene: What is known of the bricks.

    Raises:
        TrajectoryError: A key is missing or unknown, or the task cannot be done.
    """
    section = Section(values, where, TrajectoryError)
    if section.text("kind") != BRICKS:
        return PlannedReference(trajectory_from(values, where))
    # Pinocchio takes a moment to import, and other references do without.
    from hpid_ros.planning.bricks import plan_bricks
    from hpid_ros.robot.kinematics import Kinematics

    names = section.take("arm", None)
    if names is not None and not isinstance(names, list):
        raise TrajectoryError(f"{section.place('arm')} must be a list of joints, not {names!r}")
    others = robot.initial_positions
    arm = Kinematics(robot.description, scene.hand, names, others)
    folded = dict(others)
    if "folded" in section:
        own = section.section("folded")
        folded = {joint: own.number(joint) for joint in own.items()}
        for joint in folded:
            if joint not in arm.joints:
                raise TrajectoryError(f"{own.where}: {unknown_name('joint', joint, arm.joints)}")
    goals = [
        _goal(entry, scene) for entry in _entries(section.take("bricks"), section.place("bricks"))
    ]
    options = _options(section, scene)
    section.finish()
    try:
        rest = [folded.get(joint, 0.0) for joint in arm.joints]
        plan = plan_bricks(robot, arm, goals, rest, options)
    except HpidError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None
    return PlannedReference(plan.trajectory, plan)


def _goal(entry: Section, scene: KnownScene) -> BrickGoal:
    name = entry.text("brick")
    if name not in scene.bricks:
        raise TrajectoryError(
            f"{entry.place('brick')}: {unknown_name('brick', name, scene.bricks)}"
        )
    size, pick = scene.bricks[name]
    if "pick" in entry:
        pick = _placement(entry.section("pick"), pick)
    place = _placement(entry.section("place"), None)
    entry.finish()
    return BrickGoal(name, size, pick, place)


def _placement(section: Section, default: Placement | None) -> Placement:
    """Return a placement; what is left out is as in the default."""
    if default is None or "position" in section:
        position = _triple(section, "position")
    else:
        position = default.position
    yaw = section.number("yaw", 0.0 if default is None else default.yaw)
    approach = section.number("approach") if "approach" in section else None
    section.finish()
    return Placement(position, yaw, approach)


def _options(section: Section, scene: KnownScene) -> PlanOptions:
    names = [each.name for each in fields(PlanOptions) if each.name != "opening"]
    values = {name: section.number(name) for name in names if name in section}
    if scene.opening is not None:
        values["opening"] = scene.opening
    try:
        return PlanOptions(**values)
    except TrajectoryError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None


def _task_robot(section: Section, load_robot: Callable[[str], RobotDescription]) -> TaskRobot:
    """Return the robot; what else its section says is read, and checked, by others."""
    description = amended_by(section, load_robot(section.text("description")))
    positions = section.section("initial_positions", {})
    initial = {joint: positions.number(joint) for joint in positions.items()}
    if "base" not in section:
        return TaskRobot(description, None, initial)
    base = section.section("base")
    lengths = [
        base.number(key, above=0.0) if key in base else None
        for key in ("wheel_radius", "wheel_separation")
    ]
    left, right = base.text("left_wheel"), base.text("right_wheel")
    return TaskRobot(
        description, DifferentialDrive.of(description, left, right, *lengths), initial
    )


def _known_scene(section: Section) -> KnownScene:
    """Return what a plan needs of the scene; the rest is read, and checked, by others."""
    gripper, bricks = section.section("gripper", {}), section.section("bricks", {})
    known = {}
    for name in bricks.items():
        brick = bricks.section(name)
        place = Placement(_triple(brick, "position"), brick.number("yaw", 0.0))
        known[name] = (_triple(brick, "size"), place)
    opening = gripper.number("opening", above=0.0) if "opening" in gripper else None
    return KnownScene(known, gripper.text("link", HAND), opening)


def _triple(section: Section, key: str) -> tuple[float, float, float]:
    values = section.take(key)
    is_list = isinstance(values, list) and len(values) == 3
    if not is_list or not all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    ):
        raise TrajectoryError(f"{section.place(key)} must be three numbers [m], not {values!r}")
    return float(values[0]), float(values[1]), float(values[2])


def _entries(values: Any, place: str) -> list[Section]:
    if not isinstance(values, list) or not values:
        raise TrajectoryError(f"{place} must be a list of bricks, not {values!r}")
    return [
        Section(value, f"{place}[{index}]", TrajectoryError) for index, value in enumerate(values)
    ]
