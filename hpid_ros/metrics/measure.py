"""The numbers of recordings: bags in, one window for all, a comparison out.

:func:`compare` reads as the others are called: sources and their labels, each one's arrays and
numbers, repeats folded, all beside the baseline.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_ros.base.errors import (
    HpidError,
    RobotDescriptionError,
    SettingError,
    require_known,
    unknown_name,
)
from hpid_ros.base.files import load_json
from hpid_ros.base.names import is_label
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.messages import read_retunes, read_robot_descriptions
from hpid_ros.messages.metadata import custom_data, recorded_slides
from hpid_ros.messages.quality_lines import quality_lines
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.storage import Storage, bags_in, opened
from hpid_ros.metrics.alignment import ALIGNMENTS, Cut, RunWindow, cuts_of, window_cuts
from hpid_ros.metrics.comparison import Comparison, fold_repeats, mismatches
from hpid_ros.metrics.gain_signals import RunGainSignals, RunLoops, gain_notes, gains_of_runs
from hpid_ros.metrics.quantities import INDICES, L2_NORMS, Data, find_quantities
from hpid_ros.metrics.results import RunIndices, in_units
from hpid_ros.metrics.run_numbers import DEFAULT_CUTOFF, run_indices
from hpid_ros.metrics.saved_results import runs_from_mapping
from hpid_ros.robot.description import RobotDescription

if TYPE_CHECKING:
    from hpid_ros.metrics.task import EndEffector, EndEffectorFigures, EndEffectorPath, TaskFrame


Parameters = Mapping[str, Mapping[str, Mapping[str, object]]]
"""Settings by parameter name, of each joint, of each run's label."""

ALL_JOINTS = ""
"""The name under which :attr:`Measuring.effort_limits` holds what is of no joint in particular."""
_PATH_POINTS = 4000

Tell = Callable[[str, float], None]
"""Is told what is being read and which share of everything has been, in [0, 1]."""


@dataclass(frozen=True)
class Measuring:
    """How recordings are read, and what is computed of them.

    Attributes:
        selection: What is read: topics, joints, reference, clock, window.
        cutoff: Effort above this frequency is chatter, in [Hz].
        effort_limits: Effort at which a joint saturates in [N m], by joint; of all others under
            :data:`ALL_JOINTS`. Found in the efforts where none is given.
        robot: The robot whose end effector is followed; None for none.
        description: Of the robot, for which of its joints slide; that of ``robot``, or what the
            bag tells, if None.
        keeps_series: Whether the recordings stay in memory after their numbers are known, as
            figures and reports need them.
        align: How several recordings are laid over each other: where their references ``begin``,
            where these first move (``motion``), or not at all (``none``). ``auto`` is ``begin``;
            where the references then differ ``motion``, or the shift that fits best, if that makes
            them one.
        windows: The part of a recording to compare, by its label, instead.
    """

    selection: BagSelection = field(default_factory=BagSelection)
    cutoff: float = DEFAULT_CUTOFF
    effort_limits: Mapping[str, float] = field(default_factory=dict)
    robot: TaskFrame | None = None
    description: RobotDescription | None = None
    keeps_series: bool = True
    align: str = "auto"
    windows: Mapping[str, RunWindow] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_known("alignment", [self.align], ALIGNMENTS)


@dataclass(frozen=True)
class Measured:
    """What one source gave.

    Attributes:
        runs: The numbers: one run of a bag, one or more of saved numbers.
        series: The recording that they are of, if there is one and it was kept.
        path: Where they come from.
        parameters: What the controllers were set to, by joint and parameter, as far as is known.
        defects: What the numbers must be read with, one line each.
        end_effector: Its deviations, where a robot was named.
        end_effector_path: Its path, likewise.
    """

    runs: tuple[RunIndices, ...]
    series: RunSeries | None
    path: Path
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    defects: tuple[str, ...] = ()
    end_effector: EndEffectorFigures | None = None
    end_effector_path: EndEffectorPath | None = None

    @property
    def run(self) -> RunIndices:
        """The numbers of the first run, of a bag the only one."""
        return self.runs[0]


def measure(
    bag: Path | str | Storage,
    label: str | None = None,
    how: Measuring | None = None,
    *,
    tell: Tell | None = None,
) -> Measured:
    """Return the numbers of one recording.

    Args:
        bag: A bag folder or file, a bag that is open, or a ``.json`` file of saved numbers.
        label: What it is called; that of its metadata or its name if None.
        how: How it is read; as ``hpid metrics`` without options if None.
        tell: Is told how far the reading is.

    Raises:
        HpidError: It cannot be read.
    """
    named = Source(bag.path, label, bag) if isinstance(bag, Storage) else Source(Path(bag), label)
    (source,) = labelled([named])
    (found,) = _measured([source], how or Measuring(), tell or (lambda what, share: None), ())
    return found


def measure_all(
    bags: Sequence[Source | Path | str], how: Measuring | None = None, *, tell: Tell | None = None
) -> list[Measured]:
    """Return the numbers of several recordings, read one after the other.

    Recordings of unlike length, or of one motion at unlike times, are cut to what all of them
    have, unless a window was asked for. A result folder stands for its bags.
    """
    how, tell = how or Measuring(), tell or (lambda what, share: None)
    named = [each if isinstance(each, Source) else Source(Path(each)) for each in bags]
    sources = labelled([each for one in named for each in expanded(one)])
    measured = list(_measured(sources, how, tell, ()))
    if how.selection.start is not None or how.selection.end is not None:
        return measured
    if any(each.is_saved for each in sources):
        return measured
    runs = [run for each in measured for run in each.runs]
    outlines = [run.conditions.outline for run in runs if run.conditions is not None]
    known = [each for each in outlines if each is not None]
    if len(known) < len(runs):
        return measured
    labels = [run.label for run in runs]
    if how.windows:
        for label in how.windows:
            if label not in labels:
                raise SettingError(unknown_name("run", label, labels))
        cuts = window_cuts(known, [how.windows.get(label) for label in labels])
        if not cuts:
            raise SettingError("no time is left in the windows that were asked for")
        return list(_measured(sources, how, tell, cuts))
    cuts = cuts_of(known, how.align, labels)
    if how.align == "motion" and not cuts:
        still = [label for label, each in zip(labels, known, strict=True) if not each.has_motion]
        raise SettingError(
            "runs cannot be laid over each other where their references first move: "
            + (f"none moves in {', '.join(still)}" if still else "they have no time in common")
        )
    return list(_measured(sources, how, tell, cuts)) if cuts else measured


@dataclass(frozen=True)
class Summary:
    """A comparison with what a table, figures and a report need beside its numbers."""

    comparison: Comparison  # the numbers; repeats under one label are medians
    repeats: tuple[RunIndices, ...] = ()  # the single runs of its medians
    # the first recording of each label, as far as there are recordings
    series: tuple[RunSeries, ...] = ()
    parameters: Parameters = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # what keeps the runs from being compared fairly, one line each
    sources: tuple[Path, ...] = ()  # where the numbers come from
    end_effectors: Mapping[str, EndEffectorFigures] = field(default_factory=dict)
    paths: tuple[EndEffectorPath, ...] = ()

    def gains(self) -> RunGainSignals:
        """Return what the laws did to their gains, of each run whose parameters are known."""
        return gains_of_runs(self.series, self._loops())

    def gain_notes(self) -> list[str]:
        """Return what :meth:`gains` must be read with, one line each."""
        return gain_notes(self.series, self._loops())

    def _loops(self) -> RunLoops:
        return {
            run.label: {
                joint: LoopSettings.from_parameters(each)
                for joint, each in self.parameters.get(run.label, {}).items()
            }
            for run in self.series
        }


def compare(
    bags: Sequence[Measured | Path | str],
    *,
    baseline: str | None = None,
    indices: Sequence[str] = ("paper",),
    units: str = "rad",
    how: Measuring | None = None,
) -> Comparison:
    """Return recordings side by side, with ratios to the baseline.

    Args:
        bags: What was measured, or bags, result folders and saved numbers to be measured.
        baseline: The label that ratios are taken of; that of the first if None.
        indices: Keys of quantities, or the groups ``paper``, ``step`` and ``all``.
        units: Of angles: ``rad`` or ``deg``.
        how: How bags are read that have not been measured.

    Raises:
        HpidError: A bag cannot be read, the runs' joints differ, or a name is unknown.
    """
    if any(isinstance(each, Measured) for each in bags):
        found: list[Measured] = []
        for each in bags:
            found += [each] if isinstance(each, Measured) else measure_all([each], how)
    else:
        found = measure_all(bags, how)  # type: ignore[arg-type]  # all are paths
    return summary(found, baseline=baseline, indices=indices, units=units).comparison


def summary(
    measured: Sequence[Measured],
    *,
    baseline: str | None = None,
    indices: Sequence[str] = ("paper",),
    units: str = "rad",
    is_overall: bool = False,
    names_commands: bool = False,
) -> Summary:
    """Return measured recordings side by side, with all that belongs beside the numbers."""
    single = [run for each in measured for run in each.runs]
    if baseline is not None:
        if baseline not in (known := {run.label for run in single}):
            raise SettingError(unknown_name("baseline", baseline, known))
        single.sort(key=lambda run: run.label != baseline)
    warnings = (
        *(line for each in measured for line in each.defects),
        *_advice(single, is_measured_a_choice=not names_commands),
        *mismatches(single),
    )
    single = in_units(single, units)
    comparison = _selected(fold_repeats(single), indices, is_overall)
    _require_a_number(comparison)
    labels = [run.label for run in comparison.runs]
    first_of = {each.run.label: each for each in reversed(measured)}
    first = [first_of[label] for label in labels if label in first_of]
    return Summary(
        comparison=comparison,
        repeats=tuple(run for run in single if comparison.run(run.label).spread),
        series=tuple(each.series.with_slides(comparison.slides) for each in first if each.series),
        parameters={each.run.label: each.parameters for each in first if each.parameters},
        warnings=warnings,
        sources=tuple(each.path for each in measured),
        end_effectors={each.run.label: each.end_effector for each in first if each.end_effector},
        paths=tuple(each.end_effector_path for each in first if each.end_effector_path),
    )


RESULT = "result.json"
LABEL = "label"  # name of a bag's label among its metadata (custom_data)


@dataclass(frozen=True)
class Source:
    path: Path  # a bag, or a file of saved numbers
    label: str | None = None  # what it is called; None if it says so itself
    storage: Storage | None = None  # the bag, where it is open already

    @property
    def is_saved(self) -> bool:
        """Whether it holds numbers and no recording."""
        return self.path.suffix == ".json"


def expanded(source: Source) -> list[Source]:
    """Return the bags of a result folder or of a folder of bags, or the source itself.

    Of a result folder without its bags these are its saved numbers.
    """
    if not (source.path / RESULT).is_file():
        found = bags_in(source.path) if source.path.is_dir() else []
        return [Source(bag, source.label) for bag in found] or [source]
    labels = list(_section(_section(load_json(source.path / RESULT), "indices"), "runs"))
    # The file may be anybody's: a name that is no label does not lead to a bag of this folder.
    if not all(map(is_label, labels)):
        return [Source(source.path / RESULT, source.label)]
    bags = [Source(source.path / "bags" / label, source.label or label) for label in labels]
    if not bags or not all(bag.path.exists() for bag in bags):
        return [Source(source.path / RESULT, source.label)]
    return bags


def recordings_of(result: Path) -> dict[str, Path]:
    """Return the bags of a result folder, by label."""
    if not (result / RESULT).is_file():
        raise SettingError(f"{result} is no result folder: it has no {RESULT}")
    sources = expanded(Source(result))
    if any(each.is_saved for each in sources):
        raise SettingError(f"{result} has no recordings any more, or other labels than theirs")
    return {str(each.label): each.path for each in sources}


def labelled(sources: Sequence[Source]) -> list[Source]:
    """Give labels to bags without one: their metadata's, else as much of the path as differs."""
    labels = [
        each.label or (None if each.is_saved else custom_data(each.path).get(LABEL) or None)
        for each in sources
    ]
    nameless = [e.path for e, label in zip(sources, labels, strict=True) if label is None]
    names = dict(zip(nameless, _distinct_names(nameless), strict=True))
    return [
        each if each.is_saved else replace(each, label=label or names[each.path])
        for each, label in zip(sources, labels, strict=True)
    ]


def saved_parameters(bag: Path) -> Mapping[str, Mapping[str, object]]:
    """Return what the controllers of a bag in a result folder were set to, by joint and name."""
    result = bag.absolute().parent.parent / RESULT
    if bag.absolute().parent.name != "bags" or not result.is_file():
        return {}
    found = _section(_section(load_json(result), "parameters"), bag.name)
    return {joint: each for joint, each in found.items() if isinstance(each, dict)}


def _section(document: object, key: str) -> Mapping[str, Any]:
    """Return a mapping within a document, which may be anybody's; nothing where there is none."""
    found = document.get(key) if isinstance(document, dict) else None
    return found if isinstance(found, dict) else {}


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    whole = [path.absolute() for path in paths]
    # A file has a suffix; a folder may be called mu_-0.1.
    parts = [(each if each.is_dir() else each.with_suffix("")).parts for each in whole]
    for depth in range(1, max((len(part) for part in parts), default=0) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(set(whole)):
            return names
    return [str(each) for each in whole]


class SlidingJoints(NamedTuple):
    """What is known of a recording's joints."""

    slides: frozenset[str]  # joints that slide; what is not named turns, or nobody knows
    doubts: tuple[str, ...] = ()  # what could not be used, one line each
    # types by name, of those that a URDF has; of several URDFs the last
    kinds: Mapping[str, str] = {}


def sliding_joints(
    bag: Path | Storage, description: RobotDescription | None, namespace: str | None = None
) -> SlidingJoints:
    """Return which joints slide: by the given description, else by what the bag holds.

    A bag of this package says so in its metadata; others may hold the ``robot_description`` that
    ``robot_state_publisher`` latches.
    """
    if description is not None:
        return SlidingJoints(description.slides, kinds=description.kinds)
    own = bag.custom_data if isinstance(bag, Storage) else custom_data(bag)
    slides, turning, doubts = set(recorded_slides(own)), set[str](), []
    kinds: dict[str, str] = {}
    for topic, text in read_robot_descriptions(bag, namespace):
        try:
            robot = RobotDescription.load(text if text.lstrip().startswith("<") else "<robot/>")
        except RobotDescriptionError as error:
            doubts.append(f"{topic} does not tell which joints slide: {error}")
            continue
        kinds |= robot.kinds
        slides |= robot.slides
        turning |= robot.joints.keys() - robot.slides
    kinds = {k: kind for k, kind in kinds.items() if k not in slides or k not in turning}
    return SlidingJoints(frozenset(slides - turning), tuple(doubts), kinds)


def _measured(
    sources: Sequence[Source], how: Measuring, tell: Tell, cuts: Sequence[Cut]
) -> Iterator[Measured]:
    """Yield what each source gives, of each its cut if there are any."""
    for number, source in enumerate(sources):

        def told(share: float, what: str = str(source.path), number: int = number) -> None:
            tell(what, (number + share) / len(sources))

        told(0.0)
        if source.is_saved:
            runs = runs_from_mapping(load_json(source.path), str(source.path))
            if source.label is not None:
                runs = (_relabelled(source, runs),)
            yield Measured(runs, None, source.path)
        else:
            yield _of_bag(source, how, told, cuts[number] if cuts else None)


def _of_bag(
    source: Source, how: Measuring, told: Callable[[float], None], cut: Cut | None
) -> Measured:
    selection = how.selection
    if cut is not None:
        selection = replace(selection, start=cut.start, end=cut.end)
    parameters = saved_parameters(source.path)
    robot = how.description or (how.robot.description if how.robot else None)
    with opened(source.storage or source.path) as bag:
        known = sliding_joints(bag, robot, selection.namespace)
        selection = replace(
            selection,
            kinds={**known.kinds, **selection.kinds},
            velocities=selection.velocities or (how.keeps_series and _use_velocities(parameters)),
        )
        series = read_run(
            bag, str(source.label), selection=selection, progress=lambda each: told(0.7 * each)
        )
        series = series.with_slides(known.slides)
        if how.keeps_series:
            series = replace(series, retunes=read_retunes(bag))
    limits = dict(how.effort_limits)
    if ALL_JOINTS in limits:
        limits = dict.fromkeys(series.joint_names, limits.pop(ALL_JOINTS)) | limits
    numbers = run_indices(series, how.cutoff, limits, lambda each: told(0.7 + 0.3 * each))
    if cut is not None:
        numbers = replace(numbers, cut=cut.text, shift=cut.shift)
    hand, unfollowed = _end_effector(how.robot, series)
    mislabelled = _mislabelled(str(source.label), parameters)
    return Measured(
        (numbers,),
        series if how.keeps_series else None,
        source.path,
        parameters,
        (*mislabelled, *quality_lines(series), *known.doubts, *unfollowed),
        None if hand is None else hand.figures(),
        None if hand is None else hand.path(_PATH_POINTS),
    )


def _use_velocities(parameters: Mapping[str, Mapping[str, object]]) -> bool:
    """Return whether what became of a law's gains depends on the velocities of the states."""
    return any(each.get("velocity_source") == "measured" for each in parameters.values())


def _mislabelled(label: str, parameters: Mapping[str, Mapping[str, object]]) -> Iterator[str]:
    """Yield a line where a label names one law and the recorded controllers ran another."""
    words = re.findall("(?<![a-z])h?pid", label.lower())
    ran = {str(each["law"]) for each in parameters.values() if "law" in each}
    if words and len(ran) == 1 and ran.isdisjoint(words):
        yield f"run {label!r}: its controllers ran law {ran.pop()!r}: were two labels exchanged?"


def _end_effector(
    robot: TaskFrame | None, series: RunSeries
) -> tuple[EndEffector | None, tuple[str, ...]]:
    """Return the end effector, or why it is not followed where nobody insists on it."""
    if robot is None:
        return None, ()
    try:
        from hpid_ros.metrics.task import EndEffector

        return EndEffector(robot, series), ()
    except HpidError as error:
        if robot.is_required:
            raise
        return None, (f"the end effector is not followed: {error}",)


def _relabelled(source: Source, runs: Sequence[RunIndices]) -> RunIndices:
    if len(runs) > 1:
        raise SettingError(
            f"{source.path} holds {len(runs)} runs, {', '.join(run.label for run in runs)}: it "
            f"cannot have the one label {source.label!r}"
        )
    return replace(runs[0], label=str(source.label))


_REMEDIES = {
    "effort": "--commands TOPIC, --commands effort or --command-topic JOINT=TOPIC[INDEX]",
    "reference": "--reference TOPIC, FILE or hold",
}


def _selected(runs: Sequence[RunIndices], indices: Sequence[str], is_overall: bool) -> Comparison:
    """Return the runs with the indices that were asked for."""
    chosen = find_quantities(indices)
    if is_overall:
        return Comparison(tuple(runs), indices=(), norms=chosen)
    if chosen == (*INDICES, *L2_NORMS):
        return Comparison(tuple(runs))
    return Comparison(tuple(runs), indices=chosen, norms=())


def _advice(runs: Sequence[RunIndices], *, is_measured_a_choice: bool) -> list[str]:
    """Return one line for each set of runs that lack something, with the options that give it."""
    labels: dict[str, list[str]] = {}
    for run in runs:
        parts = []
        if Data.EFFORT in run.assumed and is_measured_a_choice:
            parts.append(
                f"efforts are {run.assumed[Data.EFFORT]}, as nothing else carries any "
                "(--commands TOPIC or --command-topic JOINT=TOPIC[INDEX] names commands)"
            )
        for data, remedy in _REMEDIES.items():
            reasons: dict[str, list[str]] = {}
            for joint, lacking in run.lacking.items():
                for each, reason in lacking.items():
                    if each.value == data:
                        reasons.setdefault(reason, []).append(joint)
            for reason, joints in reasons.items():
                where = "" if len(joints) == len(run.joints) else f" for {', '.join(joints)}"
                parts.append(f"{reason}{where}: {remedy}")
        if parts:
            labels.setdefault("; ".join(parts), []).append(repr(run.label))
    return [
        f"run{'s' if len(names) > 1 else ''} {', '.join(dict.fromkeys(names))}: {text}"
        for text, names in labels.items()
    ]


def _require_a_number(comparison: Comparison) -> None:
    """Raise SettingError if no run has what any of the numbers asked for needs."""
    for run in comparison.runs:
        for quantity in (*comparison.indices, *comparison.norms):
            if any(quantity.needs not in run.lacking.get(joint, {}) for joint in run.joints):
                return
    lines = "; ".join(_advice(comparison.runs, is_measured_a_choice=True))
    raise SettingError(f"none of the indices asked for can be computed: {lines}")
