"""What ``hpid metrics`` is given: bags, result folders and saved numbers, with labels."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hpid_ros.analysis import RunIndices, run_indices
from hpid_ros.analysis.comparability import Cut, common_cuts
from hpid_ros.analysis.doubts import quality_lines
from hpid_ros.analysis.indices.task import EndEffectorFigures, EndEffectorPath
from hpid_ros.analysis.saved import runs_from_mapping
from hpid_ros.bags import read_run
from hpid_ros.bags.metadata import custom_data
from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import is_label, require_label
from hpid_ros.cli.commands.metrics.options import bag_selection, index_settings
from hpid_ros.cli.commands.metrics.retunes import read_retunes
from hpid_ros.cli.commands.metrics.robot import end_effector_of, task_frame
from hpid_ros.recordings.series import RunSeries

RESULT = "result.json"
LABEL = "label"
"""Name of a bag's label among its metadata (custom_data)."""


@dataclass(frozen=True)
class Input:
    """One thing to read.

    Attributes:
        path: A bag, or a file of saved numbers.
        label: What it is called; None if it says so itself.
    """

    path: Path
    label: str | None = None

    @property
    def is_saved(self) -> bool:
        """Whether it holds numbers and no recording."""
        return self.path.suffix == ".json"


@dataclass(frozen=True)
class Measured:
    """What was read from one input.

    Attributes:
        runs: The numbers.
        series: The recording that they are of, if it was kept.
        path: Where they come from.
        parameters: What the controller was set to, by joint and parameter, as far as is known.
        defects: What the numbers must be read with, one line each.
        end_effector: Its deviations, where a robot was named.
        end_effector_path: Its path, likewise.
    """

    runs: tuple[RunIndices, ...]
    series: RunSeries | None
    path: Path
    parameters: Mapping[str, Mapping[str, object]]
    defects: tuple[str, ...] = ()
    end_effector: EndEffectorFigures | None = None
    end_effector_path: EndEffectorPath | None = None


def inputs_of(options: argparse.Namespace) -> list[Input]:
    """Return what is to be read, the baseline first if it was named by a path.

    Raises:
        SettingError: Nothing is named, or labels do not fit.
        BagError: A result folder has no bags.
    """
    if options.labels and len(options.labels) != len(options.bags):
        raise SettingError(
            f"there must be one label for each of {len(options.bags)} bags, "
            f"not {len(options.labels)}"
        )
    for label in options.labels or ():
        require_label(label, "--labels", SettingError)
    labels = options.labels or [None] * len(options.bags)
    named = [Input(path, label) for path, label in zip(options.bags, labels, strict=True)]
    for label, *paths in options.group:
        if not paths:
            raise SettingError(f"--group {label} names no bag: it takes a label, then bags")
        require_label(label, "--group", SettingError)
        named += [Input(Path(path), label) for path in paths]
    inputs = [each for one in named for each in _expanded(one)]
    if options.baseline is not None and Path(options.baseline).exists():
        inputs = _with_baseline_first(inputs, Path(options.baseline))
    if not inputs:
        raise SettingError("name at least one bag, result folder or file of saved indices")
    return _labelled(inputs)


def measure(
    options: argparse.Namespace,
    inputs: Sequence[Input],
    keeps_series: bool,
    tell: Callable[[str, float], None],
) -> list[Measured]:
    """Read the inputs one after the other and return their numbers.

    Recordings of unlike length are cut to the time that all of them have, unless a window was
    asked for.

    Args:
        options: The options.
        inputs: What to read.
        keeps_series: Whether recordings are needed after their numbers are known.
        tell: Is told what is being read and which share of everything has been, in [0, 1].

    Raises:
        HpidError: Something cannot be read.
    """
    measured = list(_measured(options, inputs, keeps_series, tell, ()))
    if options.start is not None or options.end is not None:
        return measured
    if any(each.is_saved for each in inputs):
        return measured
    cuts = common_cuts([run for each in measured for run in each.runs])
    return list(_measured(options, inputs, keeps_series, tell, cuts)) if cuts else measured


def _measured(
    options: argparse.Namespace,
    inputs: Sequence[Input],
    keeps_series: bool,
    tell: Callable[[str, float], None],
    cuts: Sequence[Cut],
) -> Iterator[Measured]:
    """Read the inputs, of each its cut if there are any."""
    selection = bag_selection(options)
    frame = task_frame(options)
    for number, each in enumerate(inputs):

        def told(share: float, what: str = str(each.path), number: int = number) -> None:
            tell(what, (number + share) / len(inputs))

        told(0.0)
        if each.is_saved:
            runs = runs_from_mapping(_load_json(each.path), str(each.path))
            if each.label is not None:
                runs = (_relabelled(each, runs),)
            yield Measured(runs, None, each.path, {})
            continue
        if cuts:
            selection = replace(selection, start=cuts[number].start, end=cuts[number].end)
        with _silence():  # what the reader logs is in the recording's quality too
            series = read_run(each.path, str(each.label), selection=selection, progress=told)
        if keeps_series:
            series = replace(series, retunes=read_retunes(each.path))
        numbers = run_indices(series, index_settings(options, series.joint_names))
        if cuts:
            numbers = replace(numbers, cut=cuts[number].text)
        parameters = _saved_parameters(each.path)
        hand = (None, None) if frame is None else end_effector_of(frame, series)
        yield Measured(
            (numbers,),
            series if keeps_series else None,
            each.path,
            parameters,
            tuple(quality_lines(series)),
            *hand,
        )


def _relabelled(one: Input, runs: Sequence[RunIndices]) -> RunIndices:
    if len(runs) > 1:
        raise SettingError(
            f"{one.path} holds {len(runs)} runs, {', '.join(run.label for run in runs)}: it "
            f"cannot have the one label {one.label!r}"
        )
    return replace(runs[0], label=str(one.label))


@contextmanager
def _silence() -> Iterator[None]:
    logger = logging.getLogger(read_run.__module__)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _expanded(one: Input) -> list[Input]:
    """Return the bags of a result folder, or the input itself."""
    if not (one.path / RESULT).is_file():
        return [one]
    document = _load_json(one.path / RESULT)
    indices = document.get("indices") if isinstance(document, dict) else None
    labels = list(indices.get("runs", {})) if isinstance(indices, dict) else []
    # The file may be anybody's: a name that is no label does not lead to a bag of this folder.
    if not all(map(is_label, labels)):
        return [Input(one.path / RESULT, one.label)]
    bags = [Input(one.path / "bags" / label, one.label or label) for label in labels]
    if not bags or not all(bag.path.exists() for bag in bags):
        return [Input(one.path / RESULT, one.label)]
    return bags


def _with_baseline_first(inputs: Sequence[Input], baseline: Path) -> list[Input]:
    def is_baseline(each: Input) -> bool:
        return each.path.resolve() == baseline.resolve()

    first = [each for each in inputs if is_baseline(each)] or _expanded(Input(baseline))
    return [*first, *(each for each in inputs if not is_baseline(each))]


def _labelled(inputs: Sequence[Input]) -> list[Input]:
    """Give labels to bags without one: their metadata's, else as much of the path as differs."""
    labels = [
        each.label or (None if each.is_saved else _label_in_metadata(each.path)) for each in inputs
    ]
    nameless = [e.path for e, label in zip(inputs, labels, strict=True) if label is None]
    names = dict(zip(nameless, _distinct_names(nameless), strict=True))
    return [
        each if each.is_saved else replace(each, label=label or names[each.path])
        for each, label in zip(inputs, labels, strict=True)
    ]


def _label_in_metadata(path: Path) -> str | None:
    label = custom_data(path).get(LABEL)
    return label if isinstance(label, str) and label else None


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    parts = [path.absolute().with_suffix("").parts for path in paths]
    for depth in range(1, max((len(part) for part in parts), default=0) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(set(parts)):
            return names
    return [part[-1] for part in parts]


def _saved_parameters(bag: Path) -> Mapping[str, Mapping[str, object]]:
    """Return what the controllers of a bag in a result folder were set to."""
    result = bag.absolute().parent.parent / RESULT
    if bag.absolute().parent.name != "bags" or not result.is_file():
        return {}
    document = _load_json(result)
    parameters = document.get("parameters") if isinstance(document, dict) else None
    found = parameters.get(bag.name) if isinstance(parameters, dict) else None
    return found if isinstance(found, dict) else {}


def _load_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot read {path}: {reason}") from None
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path} is no JSON: {error}") from None
