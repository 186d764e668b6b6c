"""``hpid upgrade``: from a PID's gains, or a bag, to a homogeneous PID's parameter file.

``hpid upgrade --verify`` compares what was predicted with what was recorded before and after.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from rich.console import Console
from rich.text import Text

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.options import (
    inertias_from,
    joint_progress,
    load_robot,
    parameter_file,
    sliding_joints_from,
    warn_unlimited,
    write_output,
)
from hpid_bench.cli.terminal import output_console
from hpid_bench.report.console import TextConsole
from hpid_bench.report.table import ComparisonTable, TableColumn, WideTable
from hpid_bench.tuning.identification.robot_identification import as_recorded, visited_poses
from hpid_bench.tuning.loop_simulation import RobotSimulation, simulate
from hpid_bench.tuning.upgrade import (
    GOALS,
    Certifying,
    Upgrade,
    effort_limits,
    propose,
    worthwhile,
)
from hpid_bench.tuning.upgrade_file import upgrade_text
from hpid_bench.tuning.upgrade_from_bag import BagUpgrade, UpgradeRequest, upgrade_from_bag
from hpid_bench.tuning.upgrade_page import (
    doubts,
    parameter_text,
    render_upgrade_page,
    upgrade_summary,
)
from hpid_bench.tuning.upgrade_prediction import (
    HOLDS_WITHIN,
    JUDGED,
    Held,
    PredictionVerification,
    read_prediction,
    verify_prediction,
)
from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_output
from hpid_ros.base.text import shown
from hpid_ros.base.units import of_slide
from hpid_ros.control.laws import LAWS
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import INDICES
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.robot.description import GivenRobot

_OUTPUT = Path("upgrade.yaml")
_PREDICTION = Path("upgrade.json")
_YAML = (".yaml", ".yml")
_BAGS = (".mcap", ".db3", ".bag", ".zstd", ".zst")


def run(options: argparse.Namespace) -> int:
    if options.verify is not None:
        return _verify(options)
    if options.prediction is not None:
        raise SettingError("--prediction is for --verify BEFORE AFTER")
    if options.file is None:
        raise SettingError(
            "upgrade needs a parameter FILE of a PID, a BAG that was recorded under one, or "
            "--verify BEFORE AFTER"
        )
    if options.file.is_dir() or options.file.suffix in _BAGS:
        return _of_bag(options)
    if options.goal is None:
        if not options.file.exists():
            raise SettingError(f"there is no parameter file and no bag {options.file}")
        raise SettingError(f"--goal is missing: a parameter file needs {', '.join(GOALS)}")
    if options.params is not None:
        raise SettingError("--params is for a BAG; a parameter FILE says the parameters itself")
    if options.output is None:
        options.output = Path("upgraded.yaml")
    return _of_file(options)


def _certifying(console: Console) -> Certifying:
    return lambda count: joint_progress(console, "certified", count, is_logged=True)


def _robot(name: str) -> GivenRobot:
    """Return a robot, of a URDF with a base that stands still, as in ``hpid identify``."""
    robot = load_robot(name)
    return robot if Path(name).suffix in _YAML else replace(robot, fixed_base=True)


def _of_bag(options: argparse.Namespace) -> int:
    files = _files(options)
    if options.params is not None:
        parameter_file(options.params)  # for what it says of ros2_control's own
    robot = _robot(options.urdf)
    errors = TextConsole(stderr=True)
    request = UpgradeRequest(
        bag=options.file,
        robot=robot,
        robot_name=options.urdf,
        goal=options.goal,
        parameters=options.params,
        payload=options.payload,
    )
    found = upgrade_from_bag(
        request,
        phase=lambda name: errors.print(name, style="dim"),
        certifying=_certifying(errors),
    )
    warn_unlimited(robot.description, found.recording.loops)
    prediction, contents = found.prediction, {"page": render_upgrade_page(found, files)}
    if prediction.is_credible:
        contents = {"parameters": parameter_text(found), **contents}
        contents["prediction"] = prediction.as_text()
    for name, content in contents.items():
        write_output(files[name], content)
    console = output_console()
    if prediction.is_credible:
        console.print(_table(found))
        console.print("")
    console.print(upgrade_summary(found), style="bold")
    for line in doubts(found):
        console.print(f"! {shown(line)}", style="yellow")
    console.print("")
    for name in contents:
        console.print(f"written: {files[name]}", soft_wrap=True)
    return FAILED if found.tried.proposals.failures or not prediction.is_credible else DONE


def _files(options: argparse.Namespace) -> dict[str, Path]:
    """Return what will be written for a bag; refuse what does not go with one or is in the way."""
    if options.bag is not None:
        raise SettingError(
            f"--bag is for a parameter FILE; {options.file} is the recording itself"
        )
    if options.inertia or options.poses is not None:
        raise SettingError("--inertia and --poses are for a parameter FILE: a BAG tells them")
    if not options.urdf:
        raise SettingError(
            "a BAG needs --urdf, the robot's URDF or an experiment file; without one, hpid "
            "identify BAG -o found.yaml and upgrade FILE --bag BAG --inertia found.yaml go as far"
        )
    output: Path = options.output or _OUTPUT
    if output.suffix not in _YAML:
        raise SettingError(f"-o must end in .yaml, not {output.name!r}: a page goes beside it")
    files = {
        "parameters": output,
        "page": output.with_suffix(".html"),
        "prediction": output.with_suffix(".json"),
    }
    inputs = [options.file, Path(options.urdf), *([options.params] if options.params else [])]
    for path in files.values():
        refuse_output(path, force=options.force, inputs=inputs, option="-o")
    return files


def _table(found: BagUpgrade) -> WideTable:
    names = [each.joint for each in found.tried.settings]
    laws = [
        f"mu {each.mu:+.2f}" if each.is_homogeneous else LAWS[each.law].title
        for each in found.tried.settings
    ]
    columns = [TableColumn("law", [*laws, ""])]
    for index in INDICES:
        rows = [found.prediction.joints[name][index.key] for name in names]
        rows.append(found.prediction.total(index.key))
        columns += [
            TableColumn(f"{index.symbol} ratio", [f"{each.ratio:.3f}" for each in rows]),
            TableColumn("from", [f"{each.low:.2f}" for each in rows]),
            TableColumn("to", [f"{each.high:.2f}" for each in rows]),
        ]
    joints = TableColumn("joint", [*map(shown, names), "all"], is_text=True)
    return WideTable([joints], columns)


def _verify(options: argparse.Namespace) -> int:
    given = {
        "FILE or BAG": options.file,
        "--bag": options.bag,
        "--params": options.params,
        "--goal": options.goal,
        "--urdf": options.urdf,
        "-o": options.output,
    }
    others = [name for name, value in given.items() if value is not None]
    if others or options.inertia:
        raise SettingError(
            f"--verify BEFORE AFTER takes --prediction and nothing else, not "
            f"{', '.join(others or ['--inertia'])}"
        )
    prediction = read_prediction(options.prediction or _PREDICTION)
    found = verify_prediction(prediction, *options.verify)
    console = output_console()
    console.print(_verified_table(found))
    console.print("over what was recorded before; off: measured over predicted", style="dim")
    console.print("")
    for line in (*found.warnings, *found.others):
        console.print(f"! {shown(line)}", style="yellow")
    console.print(_verdict(found))
    return DONE if found.is_held else FAILED


def _verified_table(found: PredictionVerification) -> WideTable:
    columns: list[TableColumn] = []
    for index in INDICES:
        rows = [row[index.key] for row in (*found.joints.values(), found.totals)]
        columns += [
            TableColumn(f"{index.symbol} predicted", [_number(each.predicted) for each in rows]),
            TableColumn("measured", [_number(each.measured) for each in rows]),
            TableColumn("off", [_off(each) for each in rows]),
        ]
    joints = TableColumn("joint", [*map(shown, found.joints), "all"], is_text=True)
    return WideTable([joints], columns)


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _off(each: Held) -> str | Text:
    if not math.isfinite(each.off):
        return "–"
    return Text(f"{each.off:+.1%}", style="green" if each.is_held else "red")


def _verdict(found: PredictionVerification) -> Text:
    offs = [(index.symbol, found.totals[index.key].off) for index in JUDGED]
    text = ", ".join(
        f"{symbol} {off:+.1%}" if math.isfinite(off) else f"{symbol} unknown"
        for symbol, off in offs
    )
    if found.others:
        return Text(f"The prediction is NOT tested: something else ran ({text}).", style="red")
    if found.is_held:
        return Text(f"The prediction held, within {HOLDS_WITHIN:.0%}: {text}.", style="green")
    return Text(f"The prediction did NOT hold within {HOLDS_WITHIN:.0%}: {text}.", style="red")


def _of_file(options: argparse.Namespace) -> int:
    read = [options.file, options.bag, options.urdf, *chain.from_iterable(options.inertia)]
    inputs = [Path(each) for each in read if each]
    refuse_output(options.output, force=options.force, inputs=inputs, option="-o")
    console, errors = output_console(), TextConsole(stderr=True)
    file = parameter_file(options.file)
    loops = list(file.loops.values())
    joints = [each.joint for each in loops]
    recorded: Sequence[JointSeries] = ()
    if options.bag is not None:
        selection = BagSelection(separates_runs=True, every=True)
        recorded = read_run(options.bag, "PID", joints=joints, selection=selection).joints
    inertias = {**file.inertias, **inertias_from(options, joints, visited_poses(recorded))}
    robot = _robot(options.urdf) if options.urdf else None
    limits = effort_limits(robot.description) if robot else {}
    if robot:
        warn_unlimited(robot.description, loops)
    proposals, failures = propose(
        loops, inertias, recorded, limits, options.goal, _certifying(errors)
    )
    comparison = None
    if robot is not None:
        robot = as_recorded(robot, recorded)
        after = [proposals[x.joint].settings if x.joint in proposals else x for x in loops]
        both = {"PID": [replace(each, law="pid") for each in after], "hPID": after}
        phase = "simulating the PID and the proposal on the robot"
        with errors.status(phase):
            if not errors.is_terminal:
                errors.print(phase)
            simulation = RobotSimulation(robot.source, robot.fixed_base, robot.initial_positions)
            runs = simulate(simulation, both, recorded)
            comparison = Comparison(tuple(map(run_indices, runs)))
    notes = {joint: [f"NOT upgraded: {error}."] for joint, error in failures.items()}
    for joint, each in proposals.items():
        proposals[joint] = worthwhile(each, options.goal, comparison)
        notes[joint] = [*each.remarks]
        if comparison is not None:
            ratios = (f"{q.symbol} {comparison.ratio('hPID', q, joint):.3f}" for q in INDICES)
            notes[joint].append(f"Predicted on the model, over the PID: {', '.join(ratios)}.")
    header = [
        f"Homogeneous PID with the gains of {options.file}, goal {options.goal}.",
        f"Scales and floors from {options.bag}." if options.bag else "No recording was given.",
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    slides = sliding_joints_from(options, None)
    written = [proposals.get(joint, loop) for joint, loop in zip(joints, loops, strict=True)]
    write_output(options.output, upgrade_text(written, header, notes, slides))
    for joint in joints:
        if joint in failures:
            lines = [f"{joint}: NOT upgraded, kept as it was", str(failures[joint])]
        else:
            lines = _summary(proposals[joint])
        first, *others = [of_slide(line) for line in lines] if joint in slides else lines
        console.print(first, soft_wrap=True)
        for line in others:
            style = "red" if joint in failures else "dim"
            console.print(f"  {line}", style=style, soft_wrap=True)
    if comparison is not None:
        console.print("\nPredicted, simulated on the model, with every proposal:")
        console.print(ComparisonTable(comparison))
    console.print(f"\nwritten: {options.output}", soft_wrap=True)
    return FAILED if failures else DONE


def _summary(proposal: Upgrade) -> list[str]:
    settings = proposal.settings
    if not settings.is_homogeneous:
        return [f"{settings.joint}: {proposal.reasons['law']}", *proposal.remarks]
    return [f"{settings.joint}: mu {settings.mu:+.2f}", proposal.reasons["mu"], *proposal.remarks]
