"""What a run's bag says of its task: the end effector, and the bricks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hpid_ros.analysis import RunSeries
from hpid_ros.analysis.task_figures import (
    BrickFigures,
    EndEffectorFigures,
    EndEffectorPath,
    task_notes,
)
from hpid_ros.bags.task_messages import POSE, Status, read_poses, read_statuses
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.end_effector import EndEffector, TaskFrame, moving_joints
from hpid_ros.planning import BrickGoal
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.gripper import GRASPED, LOST, MISSED
from hpid_ros.simulation.task_values import (
    ANGLE,
    BRICK_POSES,
    DISTANCE,
    END_EFFECTOR,
    GRIP_EVENTS,
)

_PATH_POINTS = 4000


@dataclass(frozen=True, eq=False)
class TaskResult:
    """The task of each run.

    Attributes:
        end_effectors: By label; empty for a robot whose end effector no driven joint moves.
        bricks: By label; empty without bricks.
        paths: The paths of the end effector, for the figure.
    """

    end_effectors: Mapping[str, EndEffectorFigures] = field(default_factory=dict)
    bricks: Mapping[str, tuple[BrickFigures, ...]] = field(default_factory=dict)
    paths: tuple[EndEffectorPath, ...] = ()

    def as_mapping(self) -> dict[str, object]:
        """Return ``end_effector`` and ``bricks``, each by run; without what there is not."""
        mapping: dict[str, object] = {}
        if self.end_effectors:
            mapping["end_effector"] = {
                label: each.as_mapping() for label, each in self.end_effectors.items()
            }
        if self.bricks:
            mapping["bricks"] = {
                label: {brick.name: brick.as_mapping() for brick in each}
                for label, each in self.bricks.items()
            }
        return mapping

    @property
    def notes(self) -> list[str]:
        """Lines that belong below the table of a brick task; none for any other."""
        return task_notes(tuple(self.end_effectors.items()), tuple(self.bricks.items()))


def task_result(
    experiment: Experiment, bags: Mapping[str, Path], runs: Sequence[RunSeries]
) -> TaskResult:
    """Compute the task of each run.

    Args:
        experiment: What was run.
        bags: The bag of each run.
        runs: The runs, read from them.

    Raises:
        BagError: A bag cannot be read.
    """
    frame = _frame(experiment)
    end_effectors, bricks, paths = {}, {}, []
    for run in runs:
        bag = bags[run.label]
        if frame is not None:
            end_effector = EndEffector(frame, run)
            truth = read_poses(bag, END_EFFECTOR, POSE)
            end_effectors[run.label] = end_effector.figures(truth)
            paths.append(end_effector.path(_PATH_POINTS))
        if experiment.world.workplace.bricks:
            bricks[run.label] = brick_figures(experiment, bag)
    return TaskResult(end_effectors, bricks, tuple(paths))


def brick_figures(experiment: Experiment, bag: Path) -> tuple[BrickFigures, ...]:
    """Return what became of each brick.

    What the gripper did is on ``grip_events``; where the bricks lie at the end is the last
    message on ``brick_poses``.

    Args:
        experiment: What was run.
        bag: The bag of one run.

    Raises:
        BagError: The bag cannot be read.
    """
    events = read_statuses(bag, GRIP_EVENTS)
    poses = read_poses(bag, BRICK_POSES)
    goals = {goal.name: goal for goal in experiment.plan.goals} if experiment.plan else {}
    figures = []
    for index, brick in enumerate(experiment.world.workplace.bricks):
        own = [event for event in events if event.name == brick.name]
        errors: tuple[float | None, float | None] = (None, None)
        goal = goals.get(brick.name)
        if goal is not None and poses is not None:
            position, orientation = poses.positions[-1, index], poses.orientations[-1, index]
            errors = _from_place(goal, position.tolist(), orientation.tolist())
        figures.append(_figures(brick.name, own, errors))
    return tuple(figures)


def _figures(
    name: str, events: Sequence[Status], errors: tuple[float | None, float | None]
) -> BrickFigures:
    outcomes = [event.message.partition(":")[0] for event in events]
    closing = [
        event
        for event, outcome in zip(events, outcomes, strict=True)
        if outcome in (GRASPED, MISSED)
    ]
    reasons = [event.message.partition(": ")[2] for event in events if event.level]
    return BrickFigures(
        name=name,
        grasped=GRASPED in outcomes,
        distance=float(closing[0].values[DISTANCE]) if closing else None,
        angle=float(closing[0].values[ANGLE]) if closing else None,
        lost=LOST in outcomes,
        position_error=errors[0],
        orientation_error=errors[1],
        reason=reasons[0] if reasons else "",
    )


def _from_place(
    goal: BrickGoal, position: Sequence[float], orientation: Sequence[float]
) -> tuple[float, float]:
    """Return distance in [m] and angle in [rad] between a brick and its place."""
    half = goal.place.yaw / 2.0
    x, y, z, w = orientation
    # The quaternion from the place to the brick, (place)^-1 brick, place being about z.
    c, s = math.cos(half), math.sin(half)
    vector = math.hypot(c * x + s * y, c * y - s * x, c * z - s * w)
    angle = 2.0 * math.atan2(vector, abs(c * w + s * z))
    return math.dist(position, goal.place.position), angle


def _frame(experiment: Experiment) -> TaskFrame | None:
    """Return the robot and its end effector; None where no driven joint moves that."""
    world = experiment.world
    description = RobotDescription.load(world.robot_description)
    if not moving_joints(description, experiment.end_effector).intersection(world.joints):
        return None
    return TaskFrame(description, experiment.end_effector, world.base, world.initial_positions)
