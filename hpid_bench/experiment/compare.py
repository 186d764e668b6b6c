"""Running an experiment: all of its controllers compared, or one of them alone.

From the bags of the runs come numbers, tables, figures and the report.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.graph_run import GraphOptions, run_on_graph, run_trial
from hpid_bench.experiment.in_process import (
    Progress,
    RunReport,
    run_without_ros,
    write_run_files,
)
from hpid_bench.experiment.result_folder import EXPERIMENT, ResultFolder, versions
from hpid_bench.report.table import table_text
from hpid_ros.base.errors import ExperimentError, require_known
from hpid_ros.base.text import shown
from hpid_ros.base.units import Numbers
from hpid_ros.messages.messages import BagMessages
from hpid_ros.messages.quality_lines import unfollowed_lines, unfollowed_mapping
from hpid_ros.messages.reports import POSE
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.storage import Storage
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.gain_signals import gain_notes, gains_of_runs
from hpid_ros.metrics.measure import Measuring, measure
from hpid_ros.metrics.task import (
    BaseFigures,
    BrickFigures,
    EndEffector,
    EndEffectorFigures,
    EndEffectorPath,
    TaskFrame,
    base_figures,
    moving_joints,
    task_notes,
)
from hpid_ros.metrics.texts import table_csv
from hpid_ros.motion.bricks import BrickGoal
from hpid_ros.robot.differential_drive import DifferentialDrive, integrated
from hpid_ros.simulation.gripper import (
    ANGLE,
    BRICK_POSES,
    DISTANCE,
    END_EFFECTOR,
    GRASPED,
    GRIP_EVENTS,
    LOST,
    MISSED,
)
from hpid_ros.simulation.reports import ODOM, SLIP, TRUTH
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.stability.gain_check import certificates

_PATH_POINTS = 4000
_log = logging.getLogger(__name__)


def _base_figures(
    world: WorldSettings, base: DifferentialDrive, bag: BagMessages, run: RunSeries
) -> BaseFigures:
    odometry, truth = bag.planar(ODOM), bag.planar(TRUTH)
    # Each state's messages come together; of a bag that was cut off one may lack its last.
    stamps_ns, at_odometry, at_truth = np.intersect1d(
        odometry.stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True
    )
    _, slips = bag.vectors(SLIP)
    left, right, lateral = slips[-1].tolist()
    return base_figures(
        odometry.poses[at_odometry],
        truth.poses[at_truth],
        _reference_poses(world, base, run, stamps_ns),
        (left, right, lateral),
    )


def _reference_poses(
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


def brick_figures(experiment: Experiment, bag: BagMessages) -> tuple[BrickFigures, ...]:
    """Return what became of each brick, by what the gripper did and where they lie at the end."""
    events, poses = bag.statuses(GRIP_EVENTS), bag.poses(BRICK_POSES)
    goals = {goal.name: goal for goal in experiment.plan.goals} if experiment.plan else {}
    figures = []
    for index, brick in enumerate(experiment.world.workplace.bricks):
        own = [event for event in events if event.name == brick.name]
        errors: tuple[float | None, float | None] = (None, None)
        goal = goals.get(brick.name)
        if goal is not None and poses is not None:
            position, orientation = poses.positions[-1, index], poses.orientations[-1, index]
            errors = _from_place(goal, position.tolist(), orientation.tolist())
        outcomes = [event.message.partition(":")[0] for event in own]
        closing = [
            event.values
            for event, outcome in zip(own, outcomes, strict=True)
            if outcome in (GRASPED, MISSED)
        ]
        reasons = [event.message.partition(": ")[2] for event in own if event.level]
        figures.append(
            BrickFigures(
                name=brick.name,
                grasped=GRASPED in outcomes,
                distance=float(closing[0][DISTANCE]) if closing else None,
                angle=float(closing[0][ANGLE]) if closing else None,
                lost=LOST in outcomes,
                position_error=errors[0],
                orientation_error=errors[1],
                reason=reasons[0] if reasons else "",
            )
        )
    return tuple(figures)


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
    world, description = experiment.world, experiment.description
    if not moving_joints(description, experiment.end_effector).intersection(world.joints):
        return None
    base, others = world.rolling_base, world.initial_positions
    return TaskFrame(description, experiment.end_effector, base, others)


@dataclass(frozen=True)
class ExperimentResult:
    experiment: Experiment  # what was compared
    runs: tuple[RunSeries, ...]  # the recorded runs, the baseline first
    comparison: Comparison  # their numbers
    base: Mapping[str, BaseFigures] = field(default_factory=dict)
    end_effectors: Mapping[str, EndEffectorFigures] = field(default_factory=dict)
    bricks: Mapping[str, tuple[BrickFigures, ...]] = field(default_factory=dict)
    paths: tuple[EndEffectorPath, ...] = ()  # of the end effector, for the figure

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the experiment determines, and nothing that the clock does.

        Two runs of the same experiment with the same versions give the same mapping to the
        last bit, on the graph and in one process. A repeated command is no part of it: a bridge
        asks again when a machine was slow, and the answer to a repeat is the same.
        """
        experiment = self.experiment
        optional = {
            "unfollowed": unfollowed_mapping(self.runs),
            "base": {label: asdict(each) for label, each in self.base.items()},
            "end_effector": {k: asdict(each) for k, each in self.end_effectors.items()},
            "bricks": {
                label: {brick.name: brick.as_mapping() for brick in each}
                for label, each in self.bricks.items()
            },
        }
        return {
            "experiment": experiment.name,
            "sha256": experiment.digest,
            "seed": experiment.seed,
            "duration": experiment.duration,
            "engine": experiment.world.engine,
            "control_period": experiment.world.control_period_ns * 1e-9,
            "versions": versions(),
            "indices": self.comparison.as_mapping(),
            "samples": {
                run.label: {
                    series.joint: {
                        "states": len(series.position),
                        "commands": len(series.effort),
                        "unanswered_states": run.losses[series.joint].unanswered_states,
                    }
                    for series in run.joints
                }
                for run in self.runs
            },
            **{key: each for key, each in optional.items() if each},
            "parameters": experiment.parameters(),
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines that belong below the table: what a reader must know of the runs."""
        slips = [each.line(label) for label, each in self.base.items() if each.has_slipped]
        task = task_notes(self.end_effectors, self.bricks)
        return (*unfollowed_lines(self.runs), *task, *slips)


_TOPICS = (ODOM, TRUTH, SLIP, END_EFFECTOR, GRIP_EVENTS, BRICK_POSES)


def compute(experiment: Experiment, bags: Mapping[str, Path]) -> ExperimentResult:
    loops = [loop for each in experiment.controllers.values() for loop in each]
    selection = BagSelection(
        joints=experiment.world.joints,
        # What a law did to its gains depends on them, see save.
        velocities=any(each.velocity.is_measured for each in loops),
    )
    how = Measuring(selection, description=experiment.description)
    world, frame = experiment.world, _frame(experiment)
    measured, runs, base, end_effectors, bricks, paths = [], [], {}, {}, {}, []
    for label, path in bags.items():
        with Storage(path) as storage:
            found = measure(storage, label, how)
            bag = BagMessages(storage, *_TOPICS)
        measured.append(found.run)
        run = found.series
        if run is None:
            continue
        runs.append(run)
        for line in run.quality.lines if run.quality is not None else ():
            _log.warning("%s", shown(f"run {run.label!r}: {line}"))
        if world.rolling_base is not None:
            base[run.label] = _base_figures(world, world.rolling_base, bag, run)
        if frame is not None:
            end_effector = EndEffector(frame, run)
            end_effectors[run.label] = end_effector.figures(bag.poses(END_EFFECTOR, POSE))
            paths.append(end_effector.path(_PATH_POINTS))
        if world.workplace.bricks:
            bricks[run.label] = brick_figures(experiment, bag)
    comparison = Comparison(tuple(measured))
    return ExperimentResult(
        experiment, tuple(runs), comparison, base, end_effectors, bricks, tuple(paths)
    )


def save_numbers(
    result: ExperimentResult, folder: ResultFolder, reports: Sequence[RunReport], how: str
) -> None:
    """Write the numbers of a result: indices and table, and how long everything took."""
    folder.write("result.json", json.dumps(result.as_mapping(), indent=2) + "\n")
    notes = "".join(f"{note}\n" for note in result.notes)
    folder.write("table.txt", table_text(result.comparison) + notes)
    save_timing(folder, reports, how)


def save_timing(folder: ResultFolder, reports: Sequence[RunReport], how: str) -> None:
    """Write how long the runs took, as for :func:`save_numbers`."""
    timing = {"ran": how, "runs": {each.label: each.as_mapping() for each in reports}}
    folder.write("timing.json", json.dumps(timing, indent=2) + "\n")


def save(result: ExperimentResult, folder: ResultFolder, how: str) -> None:
    """Write the tables and the report of a result whose numbers are saved."""
    from hpid_bench.report.page import render_report

    folder.write("table.csv", table_csv(result.comparison))
    settings = {
        label: {each.joint: each for each in loops}
        for label, loops in result.experiment.controllers.items()
    }
    engine = result.experiment.world.engine
    provenance = {
        "experiment": result.experiment.name,
        "ran": how,
        "engine": engine,
        "command": f"hpid compare {result.experiment.path.name} --engine {engine}",
        "seed": result.experiment.seed,
        "SHA-256 of experiment and robot": result.experiment.digest,
        "versions": versions(),
    }
    folder.write(
        "report.html",
        render_report(
            result.comparison,
            result.runs,
            provenance,
            result.experiment.parameters(),
            warnings=(*result.notes, *gain_notes(result.runs, settings)),
            gains=gains_of_runs(result.runs, settings),
            paths=result.paths,
        ),
    )


def run_controller(
    experiment: Experiment,
    label: str,
    output: Path,
    progress: Progress,
    options: GraphOptions,
    *,
    force: bool = False,
    is_tried: bool = False,
) -> tuple[RunReport, ExperimentResult | None]:
    """Run one controller on the graph; what is not recorded has no result."""
    require_known("controller", [label], experiment.controllers, ExperimentError)
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        if experiment.engine_note:
            progress.note(experiment.engine_note)
        if options.is_realtime and is_tried:
            progress.phase(label, "trying what the machine can hold")
            progress.note(run_trial(experiment, label, options))
        folder.write(EXPERIMENT, experiment.text)
        bag, nodes = folder.bag(label), folder.nodes(label)
        report = run_on_graph(experiment, label, bag, nodes, progress, options)
        progress.advanced(label, experiment.duration)
        how = f"ROS 2 graph, {report.processes} processes"
        if not options.is_recorded:
            save_timing(folder, [report], how)
            return report, None
        result = compute(experiment, {label: bag})
        save_numbers(result, folder, [report], how)
        return report, result


Computed = Callable[[ExperimentResult, Sequence[RunReport]], None]


def run_comparison(
    experiment: Experiment,
    output: Path,
    progress: Progress,
    *,
    in_process: bool = False,
    options: GraphOptions | None = None,
    force: bool = False,
    computed: Computed = lambda result, reports: None,
) -> ExperimentResult:
    """Run an experiment's controllers one after the other, record, compute, report, certify.

    ``computed`` is called with the numbers as soon as they are saved.
    """
    with ResultFolder.create(output, force=force, inputs=experiment.inputs) as folder:
        if experiment.engine_note:
            progress.note(experiment.engine_note)
        folder.write(EXPERIMENT, experiment.text)
        reports = []
        for label in experiment.controllers:
            bag, nodes = folder.bag(label), folder.nodes(label)
            if in_process:
                # For who then starts the same controllers on a graph.
                write_run_files(nodes, experiment, experiment.controllers[label])
                reports.append(run_without_ros(experiment, label, bag, progress))
            else:
                reports.append(run_on_graph(experiment, label, bag, nodes, progress, options))
            progress.advanced(label, experiment.duration)
        progress.phase("", "computing")
        bags = {label: folder.bag(label) for label in experiment.controllers}
        result = compute(experiment, bags)
        how = "in one process" if in_process else "ROS 2 graph"
        save_numbers(result, folder, reports, how)
        computed(result, reports)
        save(result, folder, how)
        folder.write("certificates.json", json.dumps(certificates(experiment.controllers)) + "\n")
    return result
