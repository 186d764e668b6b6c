"""``hpid upgrade``: from a PID's gains to a homogeneous PID's parameter file."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.output_files import refuse_output, write_file
from hpid_ros.base.units import of_slide
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.robot_options import add_robot_options, inertias_from, load_robot

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.analysis import Comparison
    from hpid_ros.control import LoopSettings
    from hpid_ros.recordings.series import JointSeries
    from hpid_ros.tuning.upgrade import Upgrade

_GOALS = ("smooth", "fast", "balanced")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "upgrade",
        help="turn a PID's parameter file into a homogeneous PID's",
        description="Choose norm and degree for the gains of a PID, inside the certified "
        "interval, and write a controller parameter file with a comment on every number. A joint "
        "keeps its PID where there is nothing to gain: no degree but 0 qualifies, or, with "
        "--urdf, the goal's index (smooth: IVC, fast: ITAE, balanced: both, of the whole robot) "
        "is not predicted to fall by 2 %.",
        epilog="Exit code 1 if a joint could not be upgraded: the file holds it as it was, with "
        "the reason.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="parameter file of the PID")
    parser.add_argument(
        "--goal",
        choices=_GOALS,
        required=True,
        help="smooth lowers the variation of the effort, fast shortens transients; balanced does "
        "both for the robot as a whole, by one norm in N m for all joints, and needs --bag",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        help="recorded under the PID: gives scales and floor and, with --urdf, the poses for the "
        "inertias, unless --poses asks for others",
    )
    add_robot_options(parser)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("upgraded.yaml"), metavar="FILE", help="new file"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Propose, predict, write."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.tuning.controller_files import parameter_file

    inputs = [file for file in (options.file, options.bag) if file is not None]
    refuse_output(options.output, force=options.force, inputs=inputs, option="-o")
    console, told = output_console(), TextConsole(stderr=True)
    file = parameter_file(options.file)
    loops = list(file.loops.values())
    recorded = _recorded(options.bag, loops)
    proposals, failures = _proposals(options, loops, file.inertias, recorded, told)
    comparison = _prediction(options, loops, proposals, recorded, told)
    slides = _slides(options)
    _write(options, loops, proposals, failures, comparison, slides)
    for loop in loops:
        joint = loop.joint
        if joint in failures:
            lines = [f"{joint}: NOT upgraded, kept as it was", str(failures[joint])]
        else:
            lines = _summary(proposals[joint])
        if joint in slides:
            lines = [of_slide(line) for line in lines]
        console.print(lines[0], soft_wrap=True)
        for line in lines[1:]:
            style = "red" if joint in failures else "dim"
            console.print(f"  {line}", style=style, soft_wrap=True)
    if comparison is not None:
        from hpid_ros.report.tables.table import ComparisonTable

        console.print("\nPredicted, simulated on the model, with every proposal:")
        console.print(ComparisonTable(comparison))
    console.print(f"\nwritten: {options.output}", markup=False, soft_wrap=True, highlight=False)
    return FAILED if failures else DONE


def _summary(proposal: Upgrade) -> list[str]:
    settings = proposal.settings
    if settings.law == "pid":
        return [f"{settings.joint}: {proposal.reasons['law']}", *proposal.remarks]
    return [f"{settings.joint}: mu {settings.mu:+.2f}", proposal.reasons["mu"], *proposal.remarks]


def _slides(options: argparse.Namespace) -> frozenset[str]:
    """Return the joints that slide, where the robot or the recording says so."""
    if options.urdf:
        return load_robot(options.urdf).description.slides
    if options.bag is None:
        return frozenset()
    from hpid_ros.metrics.slides import sliding_joints

    return sliding_joints(options.bag, None).slides


def _recorded(bag: Path | None, loops: Sequence[LoopSettings]) -> tuple[JointSeries, ...]:
    if bag is None:
        return ()
    from hpid_ros.bags import read_run

    return read_run(bag, "PID", joints=[each.joint for each in loops]).joints


def _proposals(
    options: argparse.Namespace,
    loops: Sequence[LoopSettings],
    known: Mapping[str, tuple[float, float]],
    recorded: Sequence[JointSeries],
    told: Console,
) -> tuple[dict[str, Upgrade], dict[str, HpidError]]:
    """Return what is proposed, and why there is nothing for the other joints.

    Raises:
        SettingError: There is nothing for any joint.
    """
    from hpid_ros.cli.options import joint_progress
    from hpid_ros.stability.gain_check import inertia_of
    from hpid_ros.tuning.inertias import visited_poses
    from hpid_ros.tuning.upgrade import Candidate, loop_statistics, upgrades

    joints = [each.joint for each in loops]
    inertias = {**known, **inertias_from(options, joints, visited_poses(recorded))}
    series = {each.joint: each for each in recorded}
    limits = _effort_limits(options)
    candidates: list[Candidate] = []
    proposals: dict[str, Upgrade] = {}
    failures: dict[str, HpidError] = {}
    for loop in loops:
        own, statistics = series.get(loop.joint), None
        try:
            inertia = inertia_of(loop, inertias.get(loop.joint))
            if own is not None:
                statistics = loop_statistics(own, loop.velocity.filter_time_constant)
        except HpidError as error:
            failures[loop.joint] = error
        else:
            limit = limits.get(loop.joint, math.inf)
            candidates.append(Candidate(loop, inertia, statistics, limit))
    with joint_progress(told, "certified", len(candidates), is_logged=True) as tell:
        found = upgrades(candidates, options.goal, tell)
    for candidate, each in zip(candidates, found, strict=True):
        if isinstance(each, HpidError):
            failures[candidate.pid.joint] = each
        else:
            proposals[candidate.pid.joint] = each
    if not proposals:
        reasons = dict.fromkeys(str(each) for each in failures.values())
        raise SettingError(f"no joint can be upgraded: {'; '.join(reasons)}")
    return proposals, failures


def _effort_limits(options: argparse.Namespace) -> dict[str, float]:
    if not options.urdf:
        return {}
    joints = load_robot(options.urdf).description.joints
    return {name: joint.effort for name, joint in joints.items()}


def _prediction(
    options: argparse.Namespace,
    loops: Sequence[LoopSettings],
    proposals: dict[str, Upgrade],
    recorded: Sequence[JointSeries],
    told: Console,
) -> Comparison | None:
    """Simulate both laws on the robot, if there is one, and keep the PID where it is as good."""
    from hpid_ros.tuning.upgrade import worthwhile

    comparison = _simulated(options, loops, proposals, recorded, told) if options.urdf else None
    for joint, each in proposals.items():
        proposals[joint] = worthwhile(each, options.goal, comparison)
    return comparison


def _simulated(
    options: argparse.Namespace,
    loops: Sequence[LoopSettings],
    proposals: Mapping[str, Upgrade],
    recorded: Sequence[JointSeries],
    told: Console,
) -> Comparison:
    from dataclasses import replace

    from hpid_ros.tuning.prediction import predict

    after = [proposals[loop.joint].settings if loop.joint in proposals else loop for loop in loops]
    before = [replace(each, law="pid") for each in after]
    robot = load_robot(options.urdf)
    with told.status("simulating the PID and the proposal on the robot"):
        if not told.is_terminal:
            told.print("simulating the PID and the proposal on the robot")
        return predict(
            robot.source,
            {"PID": before, "hPID": after},
            recorded,
            fixed_base=robot.fixed_base,
            initial_positions=robot.initial_positions,
        )


def _write(
    options: argparse.Namespace,
    loops: Sequence[LoopSettings],
    proposals: Mapping[str, Upgrade],
    failures: Mapping[str, HpidError],
    comparison: Comparison | None,
    slides: frozenset[str],
) -> None:
    from hpid_ros.analysis.quantities import INDICES
    from hpid_ros.tuning.upgrade_file import upgrade_text

    header = [
        f"Homogeneous PID with the gains of {options.file}, goal {options.goal}.",
        f"Scales and floors from {options.bag}." if options.bag else "No recording was given.",
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    notes: dict[str, list[str]] = {loop.joint: [] for loop in loops}
    for joint, error in failures.items():
        notes[joint].append(f"NOT upgraded: {error}.")
    for joint, each in proposals.items():
        notes[joint] += each.remarks
        if comparison is not None:
            ratios = (f"{q.symbol} {comparison.ratio('hPID', q, joint):.3f}" for q in INDICES)
            notes[joint].append(f"Predicted on the model, over the PID: {', '.join(ratios)}.")
    written = [proposals.get(loop.joint, loop) for loop in loops]
    try:
        write_file(options.output, upgrade_text(written, header, notes, slides))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {options.output}: {reason}") from None
