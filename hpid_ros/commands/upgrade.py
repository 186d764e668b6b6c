"""``hpid upgrade``: from a PID's gains to a homogeneous PID's parameter file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.commands import DONE
from hpid_ros.commands.robot_options import add_robot_options, inertias_from
from hpid_ros.errors import SettingError
from hpid_ros.output_files import refuse_output, write_file

if TYPE_CHECKING:
    from hpid_ros.analysis import Comparison, JointSeries
    from hpid_ros.control import LoopSettings
    from hpid_ros.tuning.upgrade import Upgrade

_GOALS = ("smooth", "fast")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "upgrade",
        help="turn a PID's parameter file into a homogeneous PID's",
        description="Choose norm and degree for the gains of a PID, inside the certified "
        "interval, and write a controller parameter file with a comment on every number.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="parameter file of the PID")
    parser.add_argument(
        "--goal",
        choices=_GOALS,
        required=True,
        help="smooth lowers the variation of the effort, fast shortens transients",
    )
    parser.add_argument("--bag", type=Path, help="recorded under the PID: gives scales and floor")
    add_robot_options(parser)
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("upgraded.yaml"), metavar="FILE", help="new file"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Propose, predict, write."""
    from hpid_ros.text_output import TextConsole
    from hpid_ros.tuning.controller_files import settings_from_parameter_file
    from hpid_ros.tuning.gain_check import inertia_of
    from hpid_ros.tuning.upgrade import upgrade

    inputs = [file for file in (options.file, options.bag) if file is not None]
    refuse_output(options.output, force=options.force, inputs=inputs, option="-o")
    loops = list(settings_from_parameter_file(options.file).values())
    known = inertias_from(options, [each.joint for each in loops])
    recorded = _recorded(options.bag, loops)
    upgrades = [
        upgrade(each, inertia_of(each, known.get(each.joint)), options.goal, statistics)
        for each, statistics in zip(loops, _statistics(loops, recorded), strict=True)
    ]
    comparison = _prediction(options, upgrades, recorded)
    _write(options, upgrades, comparison)
    console = TextConsole()
    for each in upgrades:
        console.print(f"{each.settings.joint}: mu {each.settings.mu:+.2f}", highlight=False)
        console.print(f"  {each.reasons['mu']}", style="dim", highlight=False)
    if comparison is not None:
        from hpid_ros.analysis.table import ComparisonTable

        console.print("\nPredicted, simulated on the model:")
        console.print(ComparisonTable(comparison))
    console.print(f"\nwritten: {options.output}", soft_wrap=True, highlight=False)
    return DONE


def _recorded(bag: Path | None, loops: Sequence[LoopSettings]) -> tuple[JointSeries, ...]:
    if bag is None:
        return ()
    from hpid_ros.bags import read_run

    return read_run(bag, "PID", joints=[each.joint for each in loops]).joints


def _statistics(loops: Sequence[LoopSettings], recorded: Sequence[JointSeries]) -> list[Any]:
    from hpid_ros.tuning.loop_statistics import loop_statistics

    if not recorded:
        return [None] * len(loops)
    by_joint = {series.joint: series for series in recorded}
    return [
        loop_statistics(by_joint[each.joint], each.velocity_filter_time_constant) for each in loops
    ]


def _prediction(
    options: argparse.Namespace, upgrades: Sequence[Upgrade], recorded: Sequence[JointSeries]
) -> Comparison | None:
    if not options.urdf:
        return None
    from dataclasses import replace

    from hpid_ros.commands.robot_options import load_robot
    from hpid_ros.tuning.prediction import predict

    after = [each.settings for each in upgrades]
    before = [replace(each, law="pid") for each in after]
    robot = load_robot(options.urdf)
    return predict(
        robot.source,
        {"PID": before, "hPID": after},
        recorded,
        fixed_base=robot.fixed_base,
        initial_positions=robot.initial_positions,
    )


def _write(
    options: argparse.Namespace, upgrades: Sequence[Upgrade], comparison: Comparison | None
) -> None:
    from hpid_ros.analysis.indices import INDICES
    from hpid_ros.tuning.upgrade_file import upgrade_text

    header = [
        f"Homogeneous PID with the gains of {options.file}, goal {options.goal}.",
        f"Scales and floors from {options.bag}." if options.bag else "No recording was given.",
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    notes: dict[str, list[str]] = {}
    if comparison is not None:
        for joint in comparison.joint_names:
            ratios = (f"{q.symbol} {comparison.ratio('hPID', q, joint):.3f}" for q in INDICES)
            notes[joint] = [f"Predicted on the model, over the PID: {', '.join(ratios)}."]
    try:
        write_file(options.output, upgrade_text(upgrades, header, notes))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {options.output}: {reason}") from None
