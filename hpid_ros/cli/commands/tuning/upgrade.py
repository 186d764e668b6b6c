"""``hpid upgrade``: from a PID's gains, or a bag, to a homogeneous PID's parameter file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.output_files import refuse_output, write_file
from hpid_ros.base.units import of_slide
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.loops import sliding_joints
from hpid_ros.cli.robot_options import add_robot_options, inertias_from, load_robot

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.analysis import Comparison
    from hpid_ros.control import LoopSettings
    from hpid_ros.recordings.series import JointSeries
    from hpid_ros.tuning.proposals import Proposals
    from hpid_ros.tuning.upgrade import Upgrade

_GOALS = ("smooth", "fast", "balanced")
_BAGS = (".mcap", ".db3", ".zstd")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "upgrade",
        description="Of a parameter FILE: choose norm and degree for the gains of a PID, inside "
        "the certified interval, and write a controller parameter file with a comment on every "
        "number. Of a BAG with --urdf: identify the robot, check the PID that ran, propose, "
        "predict in simulation what that will bring, and write parameters, a page and the "
        "prediction; --verify holds the prediction against what was recorded after. A joint "
        "keeps its PID where there is nothing to gain: no degree but 0 qualifies, or, with "
        "--urdf, the goal's index (smooth: IVC, fast: ITAE, balanced: both, of the whole robot) "
        "is not predicted to fall by 2 %.",
        epilog="Exit code 1 if a joint could not be upgraded: the file holds it as it was, with "
        "the reason; if the simulated PID is nothing like the recorded one: only the page is "
        "written; with --verify, if the prediction did not hold.",
    )
    parser.add_argument(
        "file",
        nargs="?",
        type=Path,
        metavar="FILE|BAG",
        help="parameter file of the PID, or a bag that was recorded under it",
    )
    parser.add_argument(
        "--goal",
        choices=_GOALS,
        help="smooth lowers the variation of the effort, fast shortens transients; balanced does "
        "both for the robot as a whole, by one norm in N m for all joints, and needs a recording. "
        "A FILE needs it, of a BAG it is balanced",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        help="beside FILE: recorded under the PID; gives scales and floor and, with --urdf, the "
        "poses for the inertias, unless --poses asks for others",
    )
    parser.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="beside BAG: parameters of the controllers that ran, if the bag does not hold them",
    )
    add_robot_options(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="new file (upgraded.yaml; of a BAG upgrade.yaml, with upgrade.html and upgrade.json "
        "beside it)",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.add_argument(
        "--verify",
        nargs=2,
        type=Path,
        metavar=("BEFORE", "AFTER"),
        help="hold the prediction against two bags of the same motion",
    )
    parser.add_argument(
        "--prediction",
        type=Path,
        metavar="FILE",
        help="with --verify: what upgrade BAG has written (upgrade.json)",
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Take the form of the command that the arguments ask for."""
    if options.verify is not None:
        from hpid_ros.cli.commands.tuning.road import run_verify

        return run_verify(options)
    if options.prediction is not None:
        raise SettingError("--prediction is for --verify BEFORE AFTER")
    if options.file is None:
        raise SettingError(
            "upgrade needs a parameter FILE of a PID, a BAG that was recorded under one, or "
            "--verify BEFORE AFTER"
        )
    if options.file.is_dir() or options.file.suffix in _BAGS:
        from hpid_ros.cli.commands.tuning.road import run_road

        return run_road(options)
    if options.goal is None:
        if not options.file.exists():
            raise SettingError(f"there is no parameter file and no bag {options.file}")
        raise SettingError(f"--goal is missing: a parameter file needs {', '.join(_GOALS)}")
    if options.params is not None:
        raise SettingError("--params is for a BAG; a parameter FILE says the parameters itself")
    if options.output is None:
        options.output = Path("upgraded.yaml")
    return _of_file(options)


def _of_file(options: argparse.Namespace) -> int:
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
    slides = sliding_joints(options, None)
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


def _recorded(bag: Path | None, loops: Sequence[LoopSettings]) -> tuple[JointSeries, ...]:
    if bag is None:
        return ()
    from hpid_ros.bags import read_run
    from hpid_ros.bags.selection import BagSelection

    selection = BagSelection(separates_runs=True)
    return read_run(bag, "PID", joints=[each.joint for each in loops], selection=selection).joints


def _proposals(
    options: argparse.Namespace,
    loops: Sequence[LoopSettings],
    known: Mapping[str, tuple[float, float]],
    recorded: Sequence[JointSeries],
    told: Console,
) -> Proposals:
    """Return what is proposed, and why there is nothing for the other joints."""
    from hpid_ros.cli.options import joint_progress
    from hpid_ros.tuning.inertias import visited_poses
    from hpid_ros.tuning.proposals import effort_limits, propose

    joints = [each.joint for each in loops]
    inertias = {**known, **inertias_from(options, joints, visited_poses(recorded))}
    limits = effort_limits(load_robot(options.urdf).description) if options.urdf else {}
    return propose(
        loops,
        inertias,
        recorded,
        limits,
        options.goal,
        lambda count: joint_progress(told, "certified", count, is_logged=True),
    )


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
