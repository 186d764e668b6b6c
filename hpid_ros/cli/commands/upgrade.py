"""``hpid upgrade``: from a PID's gains, or a bag, to a homogeneous PID's parameter file.

``hpid upgrade --verify`` holds what was predicted against what was recorded before and after.
"""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.files import refuse_output, write_file
from hpid_ros.base.text import shown
from hpid_ros.base.units import of_slide
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import add_robot_options, inertias_from, load_robot, sliding_joints

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.control.settings import LoopSettings
    from hpid_ros.messages.series import JointSeries
    from hpid_ros.metrics.comparison import Comparison
    from hpid_ros.report.table import WideTable
    from hpid_ros.robot.description import GivenRobot
    from hpid_ros.tuning.upgrade import Proposals, Upgrade
    from hpid_ros.tuning.upgrade_from_bag import Answer, Telling
    from hpid_ros.tuning.upgrade_prediction import Held, Prediction, Verification


_OUTPUT = Path("upgrade.yaml")
_PREDICTION = Path("upgrade.json")
_YAML = (".yaml", ".yml")


def run_road(options: argparse.Namespace) -> int:
    """Identify, check, propose, predict, write."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.tuning.upgrade_from_bag import Question, answer
    from hpid_ros.tuning.upgrade_page import doubts, summary
    from hpid_ros.tuning.upgrade_prediction import prediction_of

    _check(options)
    files = _files(options)
    robot = _robot(options.urdf)
    question = Question(
        options.file, robot, options.urdf, options.goal, options.params, options.payload
    )
    found = answer(question, _telling(TextConsole(stderr=True)))
    prediction = prediction_of(found)
    written = files if prediction.is_credible else {"page": files["page"]}
    _write_road(found, prediction, files, written)
    console = output_console()
    if prediction.is_credible:
        console.print(_table(found, prediction))
        console.print("")
    console.print(summary(found, prediction), style="bold", highlight=False, markup=False)
    for line in doubts(found, prediction):
        console.print(f"! {shown(line)}", style="yellow", highlight=False, markup=False)
    console.print("")
    for path in written.values():
        console.print(f"written: {path}", markup=False, soft_wrap=True, highlight=False)
    return FAILED if found.proposals.failures or not prediction.is_credible else DONE


def _check(options: argparse.Namespace) -> None:
    """Refuse what does not go with a bag."""
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


def _files(options: argparse.Namespace) -> dict[str, Path]:
    """Return what will be written, which must not be in the way of anything."""
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


def _robot(name: str) -> GivenRobot:
    """Return the robot; of a URDF the base stands still, as when it is identified."""
    robot = load_robot(name)
    return robot if Path(name).suffix in _YAML else replace(robot, fixed_base=True)


def _telling(told: Console) -> Telling:
    from hpid_ros.cli.options import joint_progress
    from hpid_ros.tuning.upgrade_from_bag import Telling

    return Telling(
        lambda phase: told.print(phase, style="dim", highlight=False, markup=False),
        lambda count: joint_progress(told, "certified", count, is_logged=True),
    )


def _write_road(
    found: Answer, prediction: Prediction, files: dict[str, Path], wanted: Iterable[str]
) -> None:
    from hpid_ros.tuning.upgrade_page import render

    contents = {
        "parameters": _parameters(found, prediction),
        "page": render(found, prediction, files),
        "prediction": prediction.as_text(),
    }
    for name in wanted:
        path = files[name]
        try:
            write_file(path, contents[name])
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise SettingError(f"cannot write {path}: {reason}") from None


def _parameters(found: Answer, prediction: Prediction) -> str:
    from hpid_ros.tuning.upgrade import upgrade_text
    from hpid_ros.tuning.upgrade_page import summary

    header = [
        f"From {found.question.bag}, goal {found.goal}.",
        *textwrap.wrap(summary(found, prediction), 96),
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    notes = {each.joint: list(_notes(found, prediction, each.joint)) for each in found.loops}
    written = [found.proposals.found.get(each.joint, each) for each in found.loops]
    return upgrade_text(written, header, notes, frozenset(found.findings.slides))


def _notes(found: Answer, prediction: Prediction, joint: str) -> Iterator[str]:
    from hpid_ros.metrics.quantities import INDICES

    failure = found.proposals.failures.get(joint)
    if failure is not None:
        yield f"NOT upgraded: {failure}."
        return
    yield from found.proposals.found[joint].remarks
    yield from found.known.assumptions.get(joint, ())
    expected = ((q.symbol, prediction.joints[joint][q.key]) for q in INDICES)
    ratios = (
        f"{name} {each.ratio:.3f} ({each.low:.2f} to {each.high:.2f})" for name, each in expected
    )
    yield f"Expected over the PID: {', '.join(ratios)}."


def _table(found: Answer, prediction: Prediction) -> WideTable:
    from hpid_ros.metrics.quantities import INDICES
    from hpid_ros.report.table import TableColumn, WideTable

    names = [each.joint for each in found.settings]
    laws = [f"mu {each.mu:+.2f}" if each.law == "hpid" else "PID" for each in found.settings]
    columns = [TableColumn("law", [*laws, ""])]
    for index in INDICES:
        known = [prediction.joints[name][index.key] for name in names]
        known.append(prediction.total(index.key))
        columns += [
            TableColumn(f"{index.symbol} ratio", [f"{each.ratio:.3f}" for each in known]),
            TableColumn("from", [f"{each.low:.2f}" for each in known]),
            TableColumn("to", [f"{each.high:.2f}" for each in known]),
        ]
    rows = TableColumn("joint", [*map(shown, names), "all"], is_text=True)
    return WideTable([rows], columns)


def run_verify(options: argparse.Namespace) -> int:
    """Hold a prediction against two recordings."""
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.tuning.upgrade_prediction import read_prediction, verify

    given = {
        "FILE or BAG": options.file,
        "--bag": options.bag,
        "--params": options.params,
        "--goal": options.goal,
        "--urdf": options.urdf,
        "-o": options.output,
    }
    beside = [name for name, value in given.items() if value is not None]
    if beside or options.inertia:
        raise SettingError(
            f"--verify BEFORE AFTER takes --prediction and nothing else, not "
            f"{', '.join(beside or ['--inertia'])}"
        )
    prediction = read_prediction(options.prediction or _PREDICTION)
    before, after = options.verify
    found = verify(prediction, before, after)
    console = output_console()
    console.print(_held_table(found))
    console.print("over what was recorded before; off: measured over predicted", style="dim")
    console.print("")
    for line in (*found.warnings, *found.others):
        console.print(f"! {shown(line)}", style="yellow", highlight=False, markup=False)
    console.print(_verdict(found))
    return DONE if found.is_held else FAILED


def _held_table(found: Verification) -> WideTable:
    from hpid_ros.metrics.quantities import INDICES
    from hpid_ros.report.table import TableColumn, WideTable

    rows = [*found.joints.values(), found.totals]
    columns: list[TableColumn] = []
    for index in INDICES:
        each = [row[index.key] for row in rows]
        columns += [
            TableColumn(f"{index.symbol} predicted", [_number(held.predicted) for held in each]),
            TableColumn("measured", [_number(held.measured) for held in each]),
            TableColumn("off", _off(each)),
        ]
    names = TableColumn("joint", [*map(shown, found.joints), "all"], is_text=True)
    return WideTable([names], columns)


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _off(each: Sequence[Held]) -> list[str | Text]:
    return [
        Text(f"{held.off:+.1%}", style="green" if held.is_held else "red")
        if math.isfinite(held.off)
        else "–"
        for held in each
    ]


def _verdict(found: Verification) -> Text:
    from hpid_ros.tuning.upgrade_from_bag import JUDGED
    from hpid_ros.tuning.upgrade_prediction import HOLDS_WITHIN

    judged = [found.totals[index.key] for index in JUDGED]
    told = ", ".join(
        f"{index.symbol} {held.off:+.1%}" if math.isfinite(held.off) else f"{index.symbol} unknown"
        for index, held in zip(JUDGED, judged, strict=True)
    )
    if found.others:
        return Text(f"The prediction is NOT tested: something else ran ({told}).", style="red")
    if found.is_held:
        return Text(f"The prediction held, within {HOLDS_WITHIN:.0%}: {told}.", style="green")
    return Text(f"The prediction did NOT hold within {HOLDS_WITHIN:.0%}: {told}.", style="red")


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
        return run_verify(options)
    if options.prediction is not None:
        raise SettingError("--prediction is for --verify BEFORE AFTER")
    if options.file is None:
        raise SettingError(
            "upgrade needs a parameter FILE of a PID, a BAG that was recorded under one, or "
            "--verify BEFORE AFTER"
        )
    if options.file.is_dir() or options.file.suffix in _BAGS:
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
    from hpid_ros.control.controller_files import parameter_file

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
        from hpid_ros.report.table import ComparisonTable

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
    from hpid_ros.messages.run import read_run
    from hpid_ros.messages.selection import BagSelection

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
    from hpid_ros.tuning.robot_identification import visited_poses
    from hpid_ros.tuning.upgrade import effort_limits, propose

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

    from hpid_ros.tuning.loop_simulation import predict

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
    from hpid_ros.metrics.quantities import INDICES
    from hpid_ros.tuning.upgrade import upgrade_text

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
