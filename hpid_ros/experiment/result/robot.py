"""The base and the task in a result: what is computed from their recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis.indices.base import BaseFigures, base_figures
from hpid_ros.analysis.indices.task import (
    BrickFigures,
    EndEffectorFigures,
    EndEffectorPath,
    task_notes,
)
from hpid_ros.bags.messages import read_planar, read_poses, read_statuses, read_vectors
from hpid_ros.base.arrays import Numbers
from hpid_ros.experiment.description import Experiment
from hpid_ros.metrics.end_effector import EndEffector, TaskFrame, moving_joints
from hpid_ros.planning import BrickGoal
from hpid_ros.recordings.series import RunSeries
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.odometry import integrated
from hpid_ros.simulation.reports import ODOM, SLIP, TRUTH
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.gripper import (
    ANGLE,
    BRICK_POSES,
    DISTANCE,
    END_EFFECTOR,
    GRASPED,
    GRIP_EVENTS,
    LOST,
    MISSED,
)
from hpid_ros.wire.reports import POSE, Status


def base_results(
    experiment: Experiment, bags: Mapping[str, Path], runs: Sequence[RunSeries]
) -> dict[str, BaseFigures]:
    """Compute the figures of the base of each run; none for a robot without a base."""
    base = experiment.world.base
    if base is None:
        return {}
    return {run.label: _base(experiment.world, base, bags[run.label], run) for run in runs}


def _base(world: WorldSettings, base: DifferentialDrive, bag: Path, run: RunSeries) -> BaseFigures:
    odometry, truth = read_planar(bag, ODOM), read_planar(bag, TRUTH)
    # Each state's messages come together; of a bag that was cut off one may lack its last.
    stamps_ns, at_odometry, at_truth = np.intersect1d(
        odometry.stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True
    )
    _, slips = read_vectors(bag, SLIP)
    left, right, lateral = slips[-1].tolist()
    return base_figures(
        odometry.poses[at_odometry],
        truth.poses[at_truth],
        reference_poses(world, base, run, stamps_ns),
        (left, right, lateral),
    )


def reference_poses(
    world: WorldSettings, base: DifferentialDrive, run: RunSeries, stamps_ns: NDArray[np.int64]
) -> Numbers | None:
    """Return where the base would be if its wheels followed their references and did not slip."""
    series = {each.joint: each for each in run.joints}
    if not all(wheel in series for wheel in base.joints):
        return None
    left, right = (
        np.concatenate(([world.initial_positions.get(wheel, 0.0)], series[wheel].reference))
        for wheel in base.joints
    )
    states_ns = series[base.left].state_stamps_ns
    poses = integrated(base, left, right)[1:]
    return poses[np.clip(np.searchsorted(states_ns, stamps_ns), 0, len(states_ns) - 1)]


_PATH_POINTS = 4000


@dataclass(frozen=True, eq=False)
class TaskResult:
    """The task of each run."""

    end_effectors: Mapping[str, EndEffectorFigures] = field(default_factory=dict)
    bricks: Mapping[str, tuple[BrickFigures, ...]] = field(default_factory=dict)
    paths: tuple[EndEffectorPath, ...] = ()  # the paths of the end effector, for the figure

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
    """Compute the task of each run."""
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
        figures.append(_brick(brick.name, own, errors))
    return tuple(figures)


def _brick(
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
