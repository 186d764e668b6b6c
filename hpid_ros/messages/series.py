"""A run as arrays, and how complete it is.

Stamps are the integer nanoseconds of the states' headers, so a run that was slow on the wall clock
is the same run; times of arrival only where clock ``receive`` is asked for, or efforts have none.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hpid_ros.base.errors import HpidError
from hpid_ros.base.text import shown
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.spill import Kept, Spill, Stored

HOLD = "hold"
"""As a reference: the joint's first position, because it was asked for."""
GIVEN = "given"
"""As a reference: a trajectory that is not in the recording."""
MEASURED = "measured"
"""First word of the source of efforts that nobody commanded."""
NONE = "none"
"""There is no reference, or there are no efforts."""
HELD = "the first position, held as asked for"
NO_REFERENCE = "no reference was recorded"
NO_EFFORT = "no effort was recorded"


@dataclass(frozen=True)
class StampQuality:
    """One stream of samples of one joint, its states or its commands.

    The period is the median time between two stamps. An interval longer than 1.5 periods is a
    gap. Repeats and samples that are out of order are counted in the order of the recording.
    """

    count: int = 0  # samples that are used
    period: float = 0.0  # [s] median time between two of them; zero for fewer than two
    begin: float = 0.0  # [s] first stamp, in seconds since the first state of any joint
    end: float = 0.0  # [s] last stamp, likewise
    gaps: int = 0  # intervals longer than 1.5 periods
    lost: int = 0  # samples that would fill the gaps, no more than the whole time has room for
    longest_gap: float = 0.0  # [s] the longest; zero if there is none
    # [s] when it begins, in seconds since the first state of any joint
    longest_gap_at: float = 0.0
    repeated: int = 0  # samples whose stamp was there already; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the sample recorded before
    # samples that were left out, their number being NaN, infinite or beyond 1e50
    not_finite: int = 0


@dataclass(frozen=True)
class DataQuality:
    """What one joint's series was made of."""

    states: StampQuality = field(default_factory=StampQuality)
    commands: StampQuality = field(default_factory=StampQuality)
    state_clock: str = "header"  # "header" or "receive": whose time the states have
    command_clock: str = "header"  # likewise of the commands
    answers_states: bool = True
    # kind and topic of the reference, for instance "trajectory /joint_trajectory"
    reference: str = NONE
    references: int = 0  # number of reference messages that concern the joint
    # [s] when the joint came under its reference, in seconds since the first state of any joint
    reference_from: float | None = None
    # [s] first and last state of each stretch with a reference, since the first state of any joint
    reference_spans: tuple[tuple[float, ...], ...] = ()
    effort: str = NONE  # topic of the efforts, "measured" and the topic of the states, or "none"
    no_effort: str = ""  # why there is none; empty if there is

    @property
    def has_common_time(self) -> bool:
        """Whether states and commands, if there are both, share some time."""
        states, commands = self.states, self.commands
        if not (states.count and commands.count):
            return True
        return states.begin <= commands.end and commands.begin <= states.end

    @property
    def without_reference(self) -> float:
        """Share of the states' time for which there is no reference, of a joint that has one."""
        time = self.states.end - self.states.begin
        if not self.reference_spans or time <= 0.0:
            return 0.0
        return 1.0 - sum(end - begin for begin, end in self.reference_spans) / time

    @property
    def held_before(self) -> float:
        """Time before the first trajectory or setpoint in which the first position counts."""
        if self.reference_from is None or not self.reference_spans:
            return 0.0
        return max(self.reference_from - self.reference_spans[0][0], 0.0)

    @property
    def uncovered(self) -> float:
        """Share of the states' time before the first and after the last command."""
        states, commands = self.states, self.commands
        if not (states.end > states.begin and commands.count and self.has_common_time):
            return 0.0
        late = max(commands.begin - states.begin, 0.0) + max(states.end - commands.end, 0.0)
        return late / (states.end - states.begin)


@dataclass(frozen=True)
class RecordingQuality:
    """What a whole recording was made of."""

    source: str = ""  # path of the bag
    joints: Mapping[str, DataQuality] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()  # one line for each part of the files that could not be read
    notes: tuple[str, ...] = ()  # one line for each thing that was assumed or left out on purpose
    missed: Mapping[str, int] = field(default_factory=dict)
    stood_still: float = 0.0  # [s] how long the recorder itself stood still

    @property
    def missing_lines(self) -> tuple[str, ...]:
        """One line for each thing that is known to be missing."""
        missed = [
            f"the recorder missed {count} messages on {topic}"
            for topic, count in self.missed.items()
        ]
        if self.stood_still:
            missed.append(
                f"the recorder stood still for {self.stood_still:.1f} s: more messages of that "
                "time may be missing than were counted"
            )
        return (*self.unreadable, *missed)

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for each thing that concerns more than one joint."""
        return (*self.missing_lines, *self.notes)


class SeriesError(HpidError, ValueError):
    """Arrays that are no time series: of unequal length, not finite, or not in order."""


@dataclass(frozen=True, eq=False)
class JointSeries:
    """One joint of one run. The arrays are read-only; those that were not before are copied.

    Attributes:
        joint: Name of the joint.
        state_stamps_ns: Stamps of the states, (N,), strictly increasing, N >= 1, in [ns].
        position: Measured position at each state, (N,), in [rad].
        reference: Reference sampled at the same stamps, (N,), in [rad]; empty where nothing says
            what the joint was to follow.
        command_stamps_ns: Stamps of the states that the commands answer, (M,), strictly
            increasing, in [ns]. M = 0 is a joint whose controller never answered.
        effort: Effort of each command, or as it was measured, (M,), in [N m].
        is_slide: Whether the joint is known to slide: "rad" reads "m" then, and "N m" reads "N".
        known: At which states there is a reference, (N,); None at all of them. Elsewhere the
            reference says nothing.

    Raises:
        SeriesError: If a length differs, a value is not finite, or stamps do not increase.
    """

    joint: str
    state_stamps_ns: NDArray[np.int64]
    position: Numbers
    reference: Numbers
    command_stamps_ns: NDArray[np.int64]
    effort: Numbers
    is_slide: bool = False
    known: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if not self.joint:
            raise SeriesError("a joint series needs the name of its joint, got an empty one")
        are_shared = self.command_stamps_ns is self.state_stamps_ns
        states = self._store("state_stamps_ns", self._stamps("state_stamps_ns"))
        commands = states if are_shared else self._stamps("command_stamps_ns")
        self._store("command_stamps_ns", commands)
        if not states.size:
            raise SeriesError(f"joint {self.joint!r}: no state; at least one is needed")
        for name, stamps in (("position", states), ("reference", states), ("effort", commands)):
            self._store(name, self._samples(name, stamps.size))
        if self.known is not None:
            known = self._store("known", _own(self.known, np.bool_))
            if self.reference.size and known.shape != (states.size,):
                raise SeriesError(
                    f"joint {self.joint!r}: known has shape {known.shape}, but the states have "
                    f"({states.size},)"
                )

    @property
    def has_reference(self) -> bool:
        """Whether it is known what the joint was to follow."""
        return self.reference.size > 0

    @property
    def has_effort(self) -> bool:
        """Whether any effort is known."""
        return self.effort.size > 0

    @cached_property
    def time(self) -> Numbers:
        """Time of each state since the first state, (N,), in [s]."""
        return _read_only(seconds_since(self.state_stamps_ns, int(self.state_stamps_ns[0])))

    @cached_property
    def command_time(self) -> Numbers:
        """Time of the state that each command answers since the first state, (M,), in [s]."""
        if self.command_stamps_ns is self.state_stamps_ns:
            return self.time
        return _read_only(seconds_since(self.command_stamps_ns, int(self.state_stamps_ns[0])))

    @property
    def error(self) -> Numbers:
        """Reference minus measured position, (N,), in [rad].

        Raises:
            SeriesError: Nothing says what the joint was to follow.
        """
        if not self.has_reference:
            raise SeriesError(f"joint {self.joint!r}: no reference was recorded, hence no error")
        return self.reference - self.position

    @property
    def referenced(self) -> list[slice]:
        """Stretches of states at which there is a reference."""
        if not self.has_reference:
            return []
        if self.known is None:
            return [slice(0, self.position.size)]
        return [slice(first, end) for first, end in stretches(self.known)]

    def parts(self) -> Iterator[JointSeries]:
        """Yield the joint in each stretch of states at which there is a reference."""
        if self.known is None:
            if self.has_reference:
                yield self
            return
        for each in self.referenced:
            stamps = self.state_stamps_ns[each]
            begin = int(np.searchsorted(self.command_stamps_ns, stamps[0]))
            end = int(np.searchsorted(self.command_stamps_ns, stamps[-1], "right"))
            arrays = (stamps, self.position[each], self.reference[each])
            commands = (self.command_stamps_ns[begin:end], self.effort[begin:end])
            yield JointSeries(self.joint, *arrays, *commands, is_slide=self.is_slide)

    def _store(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        object.__setattr__(self, name, _read_only(values))
        return values

    def _stamps(self, name: str) -> NDArray[np.int64]:
        raw = np.asarray(getattr(self, name))
        where = f"joint {self.joint!r}: {name}"
        if raw.ndim != 1 or (raw.size and raw.dtype.kind not in "iu"):
            raise SeriesError(
                f"{where} must be a line of integers, got {raw.dtype} of shape {raw.shape}"
            )
        stamps = _own(raw, np.int64)
        late = np.flatnonzero(np.diff(stamps) <= 0)
        if late.size:
            k = int(late[0])
            raise SeriesError(
                f"{where} must increase strictly, but [{k}] = {stamps[k]} "
                f"is followed by {stamps[k + 1]}"
            )
        return stamps

    def _samples(self, name: str, length: int) -> Numbers:
        samples = _own(getattr(self, name), np.float64)
        where = f"joint {self.joint!r}: {name}"
        if name == "reference" and samples.shape == (0,):
            return samples
        if samples.shape != (length,):
            raise SeriesError(
                f"{where} has shape {samples.shape}, but its stamps have ({length},)"
            )
        require_finite(where, samples)
        return samples


class JointOutline(NamedTuple):
    """What a joint's series holds, without its arrays."""

    joint: str
    is_slide: bool
    states: int  # how many
    commands: int  # how many
    has_reference: bool
    first_ns: int  # [ns] stamp of the first state
    last_ns: int  # [ns] stamp of the last state


def outline(series: JointSeries) -> JointOutline:
    stamps_ns = series.state_stamps_ns
    return JointOutline(
        series.joint,
        series.is_slide,
        stamps_ns.size,
        series.effort.size,
        series.has_reference,
        int(stamps_ns[0]),
        int(stamps_ns[-1]),
    )


_ARRAYS = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort", "known")


class KeptJoints(Sequence[JointSeries]):
    """The joints of a large run: their arrays lie in a file, and are read one joint at a time."""

    def __init__(self, spill: Spill) -> None:
        self.outlines: list[JointOutline] = []
        self._spill = spill
        self._kept: list[dict[str, Kept | None]] = []
        # Joints of one topic share their stamps: the arrays seen last, and where they are kept.
        self._seen: dict[str, tuple[NDArray[Any], Kept]] = {}
        self._last: tuple[int, JointSeries] | None = None

    def append(self, series: JointSeries) -> None:
        kept: dict[str, Kept | None] = {}
        for name in _ARRAYS:
            array = getattr(series, name)
            if name.endswith("stamps_ns"):
                seen = [each for each in self._seen.values() if each[0] is array]
                self._seen[name] = seen[0] if seen else (array, self._spill.keep(array))
                kept[name] = self._seen[name][1]
            else:
                kept[name] = None if array is None else self._spill.keep(array)
        self.outlines.append(outline(series))
        self._kept.append(kept)

    def at_once(self) -> tuple[JointSeries, ...] | None:
        """Return all joints, to be in memory together; None where some lie in the file."""
        every = [kept for each in self._kept for kept in each.values()]
        return None if any(isinstance(kept, Stored) for kept in every) else tuple(self)

    def __len__(self) -> int:
        return len(self.outlines)

    @overload
    def __getitem__(self, index: int) -> JointSeries: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[JointSeries]: ...

    def __getitem__(self, index: int | slice) -> JointSeries | Sequence[JointSeries]:
        if isinstance(index, slice):
            return self._picked(range(len(self))[index])
        index = range(len(self))[index]
        if self._last is None or self._last[0] != index:
            self._last = None  # before the next one is read
            self._last = index, self._read(index)
        return self._last[1]

    def with_slides(self, slides: Collection[str]) -> KeptJoints:
        """Return the joints with these known to slide, and no others."""
        picked = self._picked(range(len(self)))
        picked.outlines = [
            each._replace(is_slide=each.joint in slides) for each in picked.outlines
        ]
        return picked

    def narrowed(self, joints: Collection[str]) -> KeptJoints:
        """Return some of the joints."""
        return self._picked([k for k, each in enumerate(self.outlines) if each.joint in joints])

    def _picked(self, indices: Sequence[int]) -> KeptJoints:
        picked = KeptJoints(self._spill)
        picked.outlines = [self.outlines[k] for k in indices]
        picked._kept = [self._kept[k] for k in indices]
        return picked

    def _read(self, index: int) -> JointSeries:
        """Return a joint, which was checked when it was kept."""
        series = object.__new__(JointSeries)
        found = self.outlines[index]
        arrays = {name: self._array(name, kept) for name, kept in self._kept[index].items()}
        for name, value in (*arrays.items(), ("joint", found.joint), ("is_slide", found.is_slide)):
            object.__setattr__(series, name, value)
        return series

    def _array(self, name: str, kept: Kept | None) -> NDArray[Any] | None:
        if kept is None:
            return None
        if not name.endswith("stamps_ns"):
            return _read_only(self._spill.array(kept))
        seen = [array for array, where in self._seen.values() if where is kept]
        array = seen[0] if seen else _read_only(self._spill.array(kept))
        self._seen[name] = array, kept
        return array


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    values.setflags(write=False)
    return values


def stretches(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first index and the one after the last of each run of true flags."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0)).tolist()
    yield from zip(edges[::2], edges[1::2], strict=True)


@dataclass(frozen=True)
class Losses:
    """What went missing between one joint's controller and the robot."""

    unanswered_states: int = 0  # states that no command answers
    repeated_commands: int = 0  # commands beyond the first that carry an already answered stamp

    def __post_init__(self) -> None:
        if self.unanswered_states < 0 or self.repeated_commands < 0:
            raise SeriesError(f"losses are counts and cannot be negative, got {self}")

    def __bool__(self) -> bool:
        return self.unanswered_states > 0 or self.repeated_commands > 0


@dataclass(frozen=True)
class Retune:
    """A change of a controller's parameters while it ran."""

    stamp_ns: int  # [ns] stamp of the last state before it
    node: str  # name of the controller's node
    change: str  # what was set, for instance "mu = -0.2"


@dataclass(frozen=True, eq=False)
class RunSeries:
    """All joints of one run under one controller.

    Attributes:
        label: Name of the run in tables and legends, for instance ``"hPID"``.
        joints: The series of each joint, in the order in which they are shown. Those of a large
            recording are read from a temporary file, one at a time.
        losses: Losses by joint name; a joint that is not named lost nothing.
        retunes: Changes of parameters while it ran, as far as they were recorded.
        quality: How complete the recording is, and on which clock and reference it stands.

    Raises:
        SeriesError: If there is no label or no joint, a joint is there twice, or losses name
            a joint that the run does not have.
    """

    label: str
    joints: Sequence[JointSeries]
    losses: Mapping[str, Losses] = field(default_factory=dict)
    retunes: tuple[Retune, ...] = ()
    quality: RecordingQuality = field(default_factory=RecordingQuality)

    def __post_init__(self) -> None:
        if not isinstance(self.joints, KeptJoints):
            object.__setattr__(self, "joints", tuple(self.joints))
        names = self.joint_names
        if not self.label or not names:
            raise SeriesError(
                f"a run needs a label and at least one joint, got {self.label!r}, {[*names]}"
            )
        if len(set(names)) < len(names):
            raise SeriesError(f"run {self.label!r}: a joint occurs twice in {', '.join(names)}")
        foreign = sorted(set(self.losses) - set(names))
        if foreign:
            raise SeriesError(
                f"run {self.label!r}: losses of unknown joints {', '.join(foreign)}; "
                f"known: {', '.join(names)}"
            )
        losses = {name: self.losses.get(name, Losses()) for name in names}
        object.__setattr__(self, "losses", losses)

    @property
    def outlines(self) -> Sequence[JointOutline]:
        """What each joint's series holds, in order."""
        if isinstance(self.joints, KeptJoints):
            return self.joints.outlines
        return [outline(series) for series in self.joints]

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in order."""
        return tuple(each.joint for each in self.outlines)

    @cached_property
    def slides(self) -> frozenset[str]:
        """Names of the joints that are known to slide."""
        return frozenset(each.joint for each in self.outlines if each.is_slide)

    def with_slides(self, slides: Collection[str]) -> RunSeries:
        """Return the run with these joints known to slide, and no others.

        Args:
            slides: Names of joints; what the run does not have is passed over.
        """
        if self.slides == frozenset(slides).intersection(self.joint_names):
            return self
        if isinstance(self.joints, KeptJoints):
            return replace(self, joints=self.joints.with_slides(slides))
        marked = (replace(each, is_slide=each.joint in slides) for each in self.joints)
        return replace(self, joints=tuple(marked))

    def narrowed(self, joints: Collection[str]) -> RunSeries:
        """Return the run of some of its joints, in its own order.

        Args:
            joints: Their names; at least one is in the run.

        Raises:
            SeriesError: None is.
        """
        kept: Sequence[JointSeries]
        if isinstance(self.joints, KeptJoints):
            kept = self.joints.narrowed(joints)
        else:
            kept = tuple(each for each in self.joints if each.joint in joints)
        losses = {name: self.losses[name] for name in self.joint_names if name in joints}
        seen = {name: each for name, each in self.quality.joints.items() if name in joints}
        return replace(
            self, joints=kept, losses=losses, quality=replace(self.quality, joints=seen)
        )

    @cached_property
    def start_ns(self) -> int:
        """Stamp of the first state of any joint, in [ns]."""
        return min(each.first_ns for each in self.outlines)

    @cached_property
    def duration(self) -> float:
        """Time from the first to the last state of any joint, in [s]."""
        return (max(each.last_ns for each in self.outlines) - self.start_ns) / NANOSECONDS


def _own(values: ArrayLike, kind: type[np.generic]) -> NDArray[Any]:
    """Return an array that nobody changes: a copy, or one that is read-only and no view."""
    if (
        isinstance(values, np.ndarray)
        and values.dtype == kind
        and values.flags.owndata
        and not values.flags.writeable
    ):
        return values
    return np.array(values, dtype=kind)


def seconds_since(stamps_ns: NDArray[np.int64], origin_ns: int) -> Numbers:
    """Return stamps as seconds since an origin; exact differences, rounded once."""
    return np.asarray((stamps_ns - origin_ns) / NANOSECONDS, dtype=np.float64)


def require_finite(what: str, values: ArrayLike) -> None:
    """Raise SeriesError, naming the first offender, unless every value is finite."""
    array = np.asarray(values, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        k = int(bad[0])
        raise SeriesError(
            f"{what} must be finite, but [{k}] = {array[k]} ({bad.size} of {array.size})"
        )


def complete_run(
    label: str,
    joints: Sequence[str],
    stamps_ns: NDArray[np.int64],
    columns: Iterable[Numbers],
    slides: Collection[str] = (),
) -> RunSeries:
    """Return the series of a run without losses."""
    positions, references, efforts = columns
    return RunSeries(
        label,
        tuple(
            JointSeries(
                *(joint, stamps_ns, positions[:, k], references[:, k], stamps_ns, efforts[:, k]),
                is_slide=joint in slides,
            )
            for k, joint in enumerate(joints)
        ),
    )


SMALL_ERROR = 0.05  # an error below this is small for any joint, in [rad]
SHARE_OF_RANGE = 0.1  # so is one below this share of the reference's range
_SELDOM = 0.1  # a joint follows if its error is small for at least this share of its motion
_MUCH = 0.05  # of the states' time
_MOVED = 0.05  # a joint whose position ranges over more than this has moved, in [rad]


def unfollowed(run: RunSeries) -> dict[str, float]:
    """Return the joints whose error was small hardly ever, from where the reference moved on."""
    found = {}
    for series in run.joints:
        usual_least = _usual_least(series)
        if usual_least is not None:
            found[series.joint] = usual_least
    return found


def _usual_least(series: JointSeries) -> float | None:
    """Return the error that a joint hardly ever falls below; None if it follows its reference."""
    if not series.has_reference:
        return None
    moved = np.flatnonzero(series.reference != series.reference[0])
    error, known = np.abs(series.error), series.known
    if known is None:
        known = np.ones(error.size, dtype=np.bool_)
    if moved.size and known[moved[0] :].any():
        error, known = error[moved[0] :], known[moved[0] :]
    usual_least = float(np.quantile(error[known], _SELDOM))
    reference = series.reference if series.known is None else series.reference[series.known]
    reference_range = float(np.ptp(reference))
    follows = usual_least <= max(SMALL_ERROR, SHARE_OF_RANGE * reference_range)
    return None if follows else usual_least


def unfollowed_lines(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a line for each run with joints that did not follow."""
    for run in runs:
        yield from _unfollowed_line(run, unfollowed(run))


def _unfollowed_line(run: RunSeries, joints: Mapping[str, float]) -> Iterator[str]:
    if joints:
        listed = ", ".join(
            f"{joint} ({error:.3g} {'m' if joint in run.slides else 'rad'})"
            for joint, error in joints.items()
        )
        yield (
            f"run {run.label!r}: these joints do not follow their reference, and their ratios "
            f"say nothing of the controller: {listed}; in brackets the error that they exceed "
            f"{1 - _SELDOM:.0%} of the time"
        )


def unfollowed_mapping(runs: Sequence[RunSeries]) -> Mapping[str, Mapping[str, float]]:
    """Return :func:`unfollowed` by label, of the runs that have such joints."""
    found = {run.label: unfollowed(run) for run in runs}
    return {label: joints for label, joints in found.items() if joints}


QUALITY_COLUMNS = (
    *("joint", "stream", "clock", "samples", "rate [Hz]", "from [s]", "to [s]"),
    *("lost", "gaps", "longest gap [ms]", "at [s]", "repeated", "out of order", "not finite"),
)


def quality_lines(run: RunSeries) -> Iterator[str]:
    """Yield one line for each thing about a recording that its numbers must be read with."""
    for line in _lines(run):
        yield shown(line)


def _lines(run: RunSeries) -> Iterator[str]:
    joints = run.quality.joints
    for line in run.quality.lines:
        yield f"run {run.label!r}: {line}"
    for stream in ("states", "commands"):
        qualities = {name: getattr(quality, stream) for name, quality in joints.items()}
        parts = [f"{name}: {_defects(each)}" for name, each in qualities.items() if _defects(each)]
        if parts:
            listed = "; ".join(parts[:3]) + (f"; {len(parts) - 3} more" if len(parts) > 3 else "")
            yield f"run {run.label!r}: {stream} are not complete: {listed}"
    alone = [name for name, each in joints.items() if each.states.count == 1]
    if alone:
        names = ", ".join(alone)
        yield f"run {run.label!r}: a single state of {names}: integrals over no time are 0"
    received = [
        stream
        for stream in ("state", "command")
        if any(getattr(each, f"{stream}_clock") == "receive" for each in joints.values())
    ]
    if received:
        streams = " and ".join(f"{stream}s" for stream in received)
        yield f"run {run.label!r}: {streams} have their receive time, not a stamp of their own"
    partly = [name for name, each in joints.items() if each.uncovered > _MUCH]
    if partly:
        yield (
            f"run {run.label!r}: the efforts of {', '.join(partly)} begin after the states or end "
            f"before them, by more than {_MUCH:.0%} of the time: their numbers are of the rest"
        )
    for line in _without_reference(joints):
        yield f"run {run.label!r}: {line}"
    idle, errors = [], {}
    for series in run.joints:
        if series.effort.size and not series.effort.any() and np.ptp(series.position) > _MOVED:
            idle.append(series.joint)
        usual_least = _usual_least(series)
        if usual_least is not None:
            errors[series.joint] = usual_least
    if idle:
        yield (
            f"run {run.label!r}: every effort of {', '.join(idle)} is 0, and the joint moved: "
            "nobody commanded it, or its driver fills in what it does not measure"
        )
    yield from _unfollowed_line(run, errors)


def _span_text(begin: float, end: float) -> str:
    return f"{begin:.3f} s to {end:.3f} s"


def _without_reference(joints: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield a line for each way in which references do not cover the states."""
    found: dict[str, list[str]] = {}
    held: dict[str, list[str]] = {}
    for name, each in joints.items():
        if each.held_before > _MUCH * (each.states.end - each.states.begin):
            held.setdefault(f"{each.reference_from:.3f} s", []).append(name)
        if each.without_reference > _MUCH:
            spans = ", ".join(_span_text(*span) for span in each.reference_spans)
            text = f"{spans}, and the states from {_span_text(each.states.begin, each.states.end)}"
            found.setdefault(text, []).append(name)
    for text, names in held.items():
        yield (
            f"the reference of {', '.join(names)} begins at {text}: before it the first position "
            "counts, at which the joint rested"
        )
    for text, names in found.items():
        yield (
            f"the reference of {', '.join(names)} is known from {text}: the numbers of the error "
            "are of this time"
        )


def quality_rows(joint: str, quality: DataQuality) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a joint's states and commands, see :data:`QUALITY_COLUMNS`."""
    streams = (
        ("states", quality.states, quality.state_clock),
        ("commands", quality.commands, quality.command_clock),
    )
    for name, each, clock in streams:
        yield (
            *(joint, name, clock, each.count),
            f"{1.0 / each.period:.4g}" if each.period else "–",
            *(f"{each.begin:.3f}", f"{each.end:.3f}", each.lost, each.gaps),
            f"{1e3 * each.longest_gap:.3f}" if each.gaps else "–",
            f"{each.longest_gap_at:.3f}" if each.gaps else "–",
            *(each.repeated, each.out_of_order, each.not_finite),
        )


def _defects(quality: StampQuality) -> str:
    counts = {
        "lost": quality.lost,
        "repeated": quality.repeated,
        "out of order": quality.out_of_order,
        "not finite": quality.not_finite,
    }
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    if quality.gaps:
        parts.append(
            f"longest gap {1e3 * quality.longest_gap:.3g} ms at {quality.longest_gap_at:.3f} s"
        )
    return ", ".join(parts)
