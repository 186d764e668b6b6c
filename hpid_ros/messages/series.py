"""A run as arrays.

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
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.quality import RecordingQuality
from hpid_ros.messages.spill import Kept, Spill, Stored


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
        velocity: Velocity that each state reports, (N,), in [rad/s], NaN where it reports none;
            None where velocities were not read.

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
    velocity: Numbers | None = None

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
        if self.velocity is not None:
            velocity = self._store("velocity", _own(self.velocity, np.float64))
            if velocity.shape != (states.size,):
                raise SeriesError(
                    f"joint {self.joint!r}: velocity has shape {velocity.shape}, but the states "
                    f"have ({states.size},)"
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
        return read_only(seconds_since(self.state_stamps_ns, int(self.state_stamps_ns[0])))

    @cached_property
    def command_time(self) -> Numbers:
        """Time of the state that each command answers since the first state, (M,), in [s]."""
        if self.command_stamps_ns is self.state_stamps_ns:
            return self.time
        return read_only(seconds_since(self.command_stamps_ns, int(self.state_stamps_ns[0])))

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
        object.__setattr__(self, name, read_only(values))
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


_ARRAYS = (
    "state_stamps_ns",
    "position",
    "reference",
    "command_stamps_ns",
    "effort",
    "known",
    "velocity",
)


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
            return read_only(self._spill.array(kept))
        seen = [array for array, where in self._seen.values() if where is kept]
        array = seen[0] if seen else read_only(self._spill.array(kept))
        self._seen[name] = array, kept
        return array


def read_only(values: NDArray[Any]) -> NDArray[Any]:
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
                joint,
                stamps_ns,
                positions[:, k],
                references[:, k],
                stamps_ns,
                efforts[:, k],
                is_slide=joint in slides,
            )
            for k, joint in enumerate(joints)
        ),
    )
