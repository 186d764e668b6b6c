"""``hpid upgrade BAG``: the road from a recording under a PID to a homogeneous PID, and back.

``hpid upgrade --verify`` holds what was predicted against what was recorded before and after.
"""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from hpid_ros.base.errors import SettingError
from hpid_ros.base.foreign_text import shown
from hpid_ros.base.output_files import refuse_output, write_file
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.robot_options import load_robot

if TYPE_CHECKING:
    from rich.console import Console

    from hpid_ros.report.tables.wide_table import WideTable
    from hpid_ros.road.prediction import Prediction
    from hpid_ros.road.proposal import Answer, Telling
    from hpid_ros.road.verification import Held, Verification
    from hpid_ros.robot.given import GivenRobot


_OUTPUT = Path("upgrade.yaml")
_PREDICTION = Path("upgrade.json")
_YAML = (".yaml", ".yml")


def run_road(options: argparse.Namespace) -> int:
    """Identify, check, propose, predict, write."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.cli.terminal import output_console
    from hpid_ros.road.page import doubts, summary
    from hpid_ros.road.prediction import prediction_of
    from hpid_ros.road.proposal import Question, answer

    _check(options)
    files = _files(options)
    robot = _robot(options.urdf)
    question = Question(
        options.file, robot, options.urdf, options.goal, options.params, options.payload
    )
    found = answer(question, _telling(TextConsole(stderr=True)))
    prediction = prediction_of(found)
    written = files if prediction.is_credible else {"page": files["page"]}
    _write(found, prediction, files, written)
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
    from hpid_ros.road.proposal import Telling

    return Telling(
        lambda phase: told.print(phase, style="dim", highlight=False, markup=False),
        lambda count: joint_progress(told, "certified", count, is_logged=True),
    )


def _write(
    found: Answer, prediction: Prediction, files: dict[str, Path], wanted: Iterable[str]
) -> None:
    from hpid_ros.road.page import render

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
    from hpid_ros.road.page import summary
    from hpid_ros.tuning.upgrade_file import upgrade_text

    header = [
        f"From {found.question.bag}, goal {found.goal}.",
        *textwrap.wrap(summary(found, prediction), 96),
        "ros2 run hpid_ros joint_controllers --ros-args --params-file THIS_FILE",
    ]
    notes = {each.joint: list(_notes(found, prediction, each.joint)) for each in found.loops}
    written = [found.proposals.found.get(each.joint, each) for each in found.loops]
    return upgrade_text(written, header, notes, frozenset(found.findings.slides))


def _notes(found: Answer, prediction: Prediction, joint: str) -> Iterator[str]:
    from hpid_ros.analysis.quantities import INDICES

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
    from hpid_ros.analysis.quantities import INDICES
    from hpid_ros.report.tables.wide_table import TableColumn, WideTable

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
    from hpid_ros.road.prediction import read_prediction
    from hpid_ros.road.verification import verify

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
    from hpid_ros.analysis.quantities import INDICES
    from hpid_ros.report.tables.wide_table import TableColumn, WideTable

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
    from hpid_ros.road.proposal import JUDGED
    from hpid_ros.road.verification import HOLDS_WITHIN

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
