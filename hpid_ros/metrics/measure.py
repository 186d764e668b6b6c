"""The numbers of one recording, or of several over the time that all of them have."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_ros.analysis.comparability import Cut, common_cuts
from hpid_ros.analysis.doubts import quality_lines
from hpid_ros.analysis.indices.run import DEFAULT_CUTOFF, IndexSettings, run_indices
from hpid_ros.analysis.indices.task import EndEffectorFigures, EndEffectorPath
from hpid_ros.analysis.results import RunIndices
from hpid_ros.analysis.saved import runs_from_mapping
from hpid_ros.bags.run.reader import read_run
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.metrics.retunes import read_retunes
from hpid_ros.metrics.slides import sliding_joints
from hpid_ros.metrics.sources import Source, expanded, labelled, load_json, saved_parameters
from hpid_ros.recordings.series import RunSeries
from hpid_ros.robot.description import RobotDescription

if TYPE_CHECKING:
    from hpid_ros.metrics.end_effector import EndEffector, TaskFrame

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
        from hpid_ros.metrics.end_effector import EndEffector  # with Pinocchio, a fifth of a start

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
