"""The numbers of recordings: sources, retunes, sliding joints, one window for all."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import HpidError, RobotDescriptionError, SettingError
from hpid_ros.base.names import is_label
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.assembly import make_law, make_norm
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.settings import LOOP_PARAMETERS, LoopSettings
from hpid_ros.messages.columns import JOINT_STATE
from hpid_ros.messages.messages import ParameterChange, parameter_changes, read_robot_descriptions
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries, Retune, RunSeries
from hpid_ros.messages.storage import Storage, custom_data, recorded_slides
from hpid_ros.metrics.comparison import Cut, common_cuts
from hpid_ros.metrics.folding import quality_lines
from hpid_ros.metrics.quantities import GainSignals, Signal
from hpid_ros.metrics.results import DEFAULT_CUTOFF, IndexSettings, RunIndices, run_indices
from hpid_ros.metrics.saved import runs_from_mapping
from hpid_ros.metrics.task import EndEffectorFigures, EndEffectorPath
from hpid_ros.robot.description import RobotDescription
from hpid_ros.stability.closed_loop import norm_values

if TYPE_CHECKING:
    from hpid_ros.metrics.end_effector import EndEffector, TaskFrame


_HEADER = 12
"""Bytes of an encapsulation header and a stamp."""


def read_retunes(path: Path) -> tuple[Retune, ...]:
    """Return what was set at the controllers of a bag, each with the state before it.

    Parameters that a node declares when it starts are no changes.
    """
    with Storage(path) as bag:
        topics = bag.topics()
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        told = parameter_changes(bag) if states else []
        if not told:
            return ()
        stamps = _stamps_before([each.place for each in told], bag, states[0])
    pairs = zip(told, stamps, strict=True)
    return tuple(
        retune
        for each, stamp_ns in pairs
        if stamp_ns is not None
        for retune in _retunes(each, stamp_ns)
    )


def _unreported(share: float) -> None:
    """Take no note of the progress."""


def _stamps_before(places: Sequence[int], bag: Storage, states: str) -> list[int | None]:
    """Return for each place the stamp of the last state before it, None if there is none."""
    stamps: list[int | None] = [None] * len(places)
    last: list[int] = [-1] * len(places)
    for batch in bag.batches(frozenset((states,)), _unreported):
        before = np.searchsorted(batch.places, places) - 1
        for number, index in enumerate(before.tolist()):
            if index >= 0 and batch.places[index] > last[number] and batch.sizes[index] >= _HEADER:
                last[number] = int(batch.places[index])
                stamps[number] = _header_stamp_ns(batch.raw(index))
    return stamps


def _header_stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a header: its first eight bytes."""
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _retunes(told: ParameterChange, stamp_ns: int) -> Iterator[Retune]:
    changes = [
        f"{name} = {_shown(value)}"
        for name, value in told.changed.items()
        if name in LOOP_PARAMETERS
    ]
    if changes:
        yield Retune(stamp_ns, told.node, ", ".join(changes))


def _shown(value: Any) -> str:
    if value is None:
        return "unset"
    return f"{value:g}" if isinstance(value, float) else str(value)


def gain_signals(
    run: RunSeries, settings: Mapping[str, LoopSettings]
) -> dict[str, GainSignals] | None:
    """Return norm and multiplier of each joint over time.

    The error's rate is computed as the loop does it: the reference's own rate minus the filtered
    difference of the positions.
    """
    if any(each.joint not in settings or not each.has_reference for each in run.joints):
        return None
    return {series.joint: _signals(series, settings[series.joint]) for series in run.joints}


def _signals(series: JointSeries, settings: LoopSettings) -> GainSignals:
    law, norm = make_law(settings), make_norm(settings)
    values = norm_values(norm, series.error, _error_rate(series, settings))
    if not isinstance(law, HomogeneousPid):
        multiplier = np.ones_like(values)
    else:
        limited = np.clip(values, law.norm_floor, law.norm_cap)
        at_zero = 1.0 if norm.degree == 0.0 else 0.0
        positive = np.where(limited > 0.0, limited, 1.0)
        multiplier = np.where(limited > 0.0, positive**norm.degree, at_zero)
    stamps = series.state_stamps_ns
    return GainSignals(Signal(stamps, values), Signal(stamps, multiplier))


def _error_rate(series: JointSeries, settings: LoopSettings) -> Numbers:
    t = series.time
    if t.size < 2:
        return np.zeros_like(t)
    from scipy.signal import lfilter  # slow to import, and only needed here

    steps = np.diff(t)
    period = float(np.median(steps))
    share = period / (settings.velocity.filter_time_constant + period)
    difference = np.append(0.0, np.diff(series.position) / steps)
    velocity: Numbers = lfilter([share], [1.0, share - 1.0], difference)
    return _reference_rate(series.reference, steps) - velocity


def _reference_rate(reference: Numbers, steps: Numbers) -> Numbers:
    """Return the rate of a reference; a jump from rest to rest has none."""
    moves = np.diff(reference)
    before, after = np.append(0.0, moves[:-1]), np.append(moves[1:], 0.0)
    is_jump = (moves != 0.0) & (before == 0.0) & (after == 0.0)
    return np.append(0.0, np.where(is_jump, 0.0, moves / steps))


RESULT = "result.json"
LABEL = "label"
"""Name of a bag's label among its metadata (custom_data)."""


@dataclass(frozen=True)
class Source:
    """One thing to read."""

    path: Path  # a bag, or a file of saved numbers
    label: str | None = None  # what it is called; None if it says so itself

    @property
    def is_saved(self) -> bool:
        """Whether it holds numbers and no recording."""
        return self.path.suffix == ".json"


def expanded(source: Source) -> list[Source]:
    """Return the bags of a result folder, its saved numbers if they are gone, or the source."""
    if not (source.path / RESULT).is_file():
        return [source]
    document = load_json(source.path / RESULT)
    indices = document.get("indices") if isinstance(document, dict) else None
    labels = list(indices.get("runs", {})) if isinstance(indices, dict) else []
    # The file may be anybody's: a name that is no label does not lead to a bag of this folder.
    if not all(map(is_label, labels)):
        return [Source(source.path / RESULT, source.label)]
    bags = [Source(source.path / "bags" / label, source.label or label) for label in labels]
    if not bags or not all(bag.path.exists() for bag in bags):
        return [Source(source.path / RESULT, source.label)]
    return bags


def labelled(sources: Sequence[Source]) -> list[Source]:
    """Give labels to bags without one: their metadata's, else as much of the path as differs."""
    labels = [
        each.label or (None if each.is_saved else _label_in_metadata(each.path))
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
    document = load_json(result)
    parameters = document.get("parameters") if isinstance(document, dict) else None
    found = parameters.get(bag.name) if isinstance(parameters, dict) else None
    if not isinstance(found, dict):
        return {}
    return {joint: each for joint, each in found.items() if isinstance(each, dict)}


def load_json(path: Path) -> Any:
    """Return what a JSON file says."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot read {path}: {reason}") from None
    except (ValueError, RecursionError) as error:
        raise SettingError(f"{path} is no JSON: {error}") from None


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


class SlidingJoints(NamedTuple):
    """What is known of a recording's joints."""

    slides: frozenset[str]  # joints that slide; what is not named turns, or nobody knows
    doubts: tuple[str, ...] = ()  # what could not be used, one line each


def sliding_joints(
    bag: Path, description: RobotDescription | None, namespace: str | None = None
) -> SlidingJoints:
    """Return which joints slide: by the given description, else by what the bag holds.

    A bag of this package says so in its metadata; others may hold the ``robot_description`` that
    ``robot_state_publisher`` latches.
    """
    if description is not None:
        return SlidingJoints(description.slides)
    slides, turning, doubts = set(recorded_slides(custom_data(bag))), set[str](), []
    for topic, text in read_robot_descriptions(bag, namespace):
        try:
            robot = RobotDescription.load(text if text.lstrip().startswith("<") else "<robot/>")
        except RobotDescriptionError as error:
            doubts.append(f"{topic} does not tell which joints slide: {error}")
            continue
        slides |= robot.slides
        turning |= robot.joints.keys() - robot.slides
    return SlidingJoints(frozenset(slides - turning), tuple(doubts))


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
    """

    selection: BagSelection = field(default_factory=BagSelection)
    cutoff: float = DEFAULT_CUTOFF
    effort_limits: Mapping[str, float] = field(default_factory=dict)
    robot: TaskFrame | None = None
    description: RobotDescription | None = None
    keeps_series: bool = True

    @property
    def described(self) -> RobotDescription | None:
        """The robot, if one was named."""
        return self.description or (None if self.robot is None else self.robot.description)

    def index_settings(self, joints: Sequence[str]) -> IndexSettings:
        """Return the settings of the indices of a run with these joints.

        Args:
            joints: Their names.

        Raises:
            SeriesError: A value is not positive, or names a joint that is not there.
        """
        limits = dict(self.effort_limits)
        if ALL_JOINTS in limits:
            limits = dict.fromkeys(joints, limits.pop(ALL_JOINTS)) | limits
        return IndexSettings(cutoff=self.cutoff, effort_limits=limits)


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
    bag: Path | str,
    label: str | None = None,
    how: Measuring | None = None,
    *,
    tell: Tell | None = None,
) -> Measured:
    """Return the numbers of one recording.

    Args:
        bag: A bag folder or file, or a ``.json`` file of saved numbers.
        label: What it is called; that of its metadata or its name if None.
        how: How it is read; as ``hpid metrics`` without options if None.
        tell: Is told how far the reading is.

    Raises:
        HpidError: It cannot be read.
    """
    (source,) = labelled([Source(Path(bag), label)])
    (found,) = _measured([source], how or Measuring(), tell or _untold, ())
    return found


def measure_all(
    bags: Sequence[Source | Path | str],
    how: Measuring | None = None,
    *,
    tell: Tell | None = None,
) -> list[Measured]:
    """Return the numbers of several recordings, read one after the other.

    Recordings of unlike length are cut to the time that all of them have, unless a window was
    asked for. A result folder stands for its bags.
    """
    how, tell = how or Measuring(), tell or _untold
    named = [each if isinstance(each, Source) else Source(Path(each)) for each in bags]
    sources = labelled([each for one in named for each in expanded(one)])
    measured = list(_measured(sources, how, tell, ()))
    if how.selection.start is not None or how.selection.end is not None:
        return measured
    if any(each.is_saved for each in sources):
        return measured
    cuts = common_cuts([run for each in measured for run in each.runs])
    return list(_measured(sources, how, tell, cuts)) if cuts else measured


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
    series = read_run(source.path, str(source.label), selection=selection, progress=told)
    known = sliding_joints(source.path, how.described, selection.namespace)
    series = series.with_slides(known.slides)
    if how.keeps_series:
        series = replace(series, retunes=read_retunes(source.path))
    numbers = run_indices(series, how.index_settings(series.joint_names))
    if cut is not None:
        numbers = replace(numbers, cut=cut.text)
    hand, unfollowed = _end_effector(how.robot, series)
    parameters = saved_parameters(source.path)
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


def _mislabelled(label: str, parameters: Mapping[str, Mapping[str, object]]) -> Iterator[str]:
    """Yield a line where a label names one law and the recorded controllers ran another."""
    words = re.findall("h?pid", label.lower())
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
        from hpid_ros.metrics.end_effector import EndEffector

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


def _untold(what: str, share: float) -> None:
    """Take no note of the progress."""
