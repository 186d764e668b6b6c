"""Everything of a run that was recorded, in one pass over its bag, and its stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError, MessageError, TrajectoryError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.columns import (
    CONTROLLER_STATE,
    FLOAT64,
    JOINT_STATE,
    Integers,
    JointSamples,
    TopicBatch,
)
from hpid_ros.messages.joint_readers import JointReader
from hpid_ros.messages.joint_trajectory import decode_trajectory
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import SeriesError, StampQuality
from hpid_ros.messages.storage import JointStream, Storage
from hpid_ros.messages.topics import TopicChoice, choose_topics
from hpid_ros.motion.joint_trajectory import PointArrays, checked_column, require_arrays
from hpid_ros.motion.spline import Column


def measures_velocity(path: Path, joint: str) -> bool:
    """Return whether the first state of a joint in a bag has a velocity."""
    reader = JointReader(joint)
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        states = choose_topics(f"bag {path}", types, BagSelection()).states
        for batch in bag.batches(frozenset(states), lambda share: None):
            for index in range(len(batch.log_times_ns)):
                try:
                    sample = reader.read(batch.raw(index))
                except MessageError:
                    continue
                if sample is not None:
                    return sample.velocity is not None
    return False


class Ordered(NamedTuple):
    """Samples with strictly increasing stamps."""

    stamps_ns: Integers  # [ns] stamps, (n,)
    values: Numbers  # their numbers, (n,)
    repeated: int = 0  # samples whose stamp was there; of several the last stands
    out_of_order: int = 0  # samples with an earlier stamp than the one before in the log
    not_finite: int = 0  # samples whose number was NaN, infinite or beyond 1e50

    def within(self, first_ns: int, last_ns: int) -> Ordered:
        """Return the samples of a window, both ends included."""
        begin = int(np.searchsorted(self.stamps_ns, first_ns))
        end = int(np.searchsorted(self.stamps_ns, last_ns, "right"))
        if (begin, end) == (0, len(self.stamps_ns)):
            return self
        return self._replace(
            stamps_ns=self.stamps_ns[begin:end].copy(), values=self.values[begin:end].copy()
        )


LARGEST = 1e50
"""Beyond this a number is no joint's, and its powers soon are no numbers, either."""


def finite(samples: JointSamples) -> tuple[JointSamples, int]:
    """Return the samples whose numbers can be a joint's, and how many cannot."""
    is_finite = np.abs(samples.values) < LARGEST  # false of NaN, too
    if is_finite.all():
        return samples, 0
    return samples.picked(is_finite), int(np.count_nonzero(~is_finite))


_RESET_NS = 1_000_000_000
"""By which a clock that was set back goes back at least; less is disorder on the way."""
RUN_SPACING_NS = 1_000_000_000_000_000
"""Added to the stamps of each run after another one: longer than any run."""


def separated(stamps_ns: Integers) -> Integers:
    """Return stamps in which a run that started again follows the one before."""
    resets = np.diff(stamps_ns) <= -_RESET_NS
    if not resets.any():
        return stamps_ns
    runs = np.concatenate([[0], np.cumsum(resets)])
    later: Integers = stamps_ns + RUN_SPACING_NS * runs
    return later


def ordered(stamps_ns: Integers, values: Numbers, not_finite: int) -> Ordered:
    """Put samples in the order of their stamps."""
    is_late = stamps_ns[1:] > stamps_ns[:-1]
    if is_late.all():
        return Ordered(stamps_ns, values, not_finite=not_finite)
    out_of_order = int(np.count_nonzero(stamps_ns[1:] < stamps_ns[:-1]))
    by_stamp = np.argsort(stamps_ns, kind="stable")
    stamps = stamps_ns[by_stamp]
    is_last = np.ones(len(stamps), dtype=np.bool_)
    is_last[:-1] = stamps[1:] != stamps[:-1]
    kept = by_stamp[is_last]
    return Ordered(
        stamps[is_last], values[kept], len(stamps_ns) - len(kept), out_of_order, not_finite
    )


def carried(
    log_times_ns: Integers, state_log_times_ns: Integers, state_stamps_ns: Integers
) -> Integers:
    """Carry receive times to the clock of the states' headers.

    Between two states linearly, before the first and after the last by their distance.
    """
    is_last = np.ones(len(state_log_times_ns), dtype=np.bool_)
    is_last[:-1] = state_log_times_ns[1:] > state_log_times_ns[:-1]
    received, stamps = state_log_times_ns[is_last], state_stamps_ns[is_last]
    since = (log_times_ns - received[0]).astype(float)
    inner = np.interp(
        since, (received - received[0]).astype(float), (stamps - stamps[0]).astype(float)
    )
    result: Integers = stamps[0] + np.rint(inner).astype(np.int64)
    result += np.minimum(log_times_ns - received[0], 0) + np.maximum(
        log_times_ns - received[-1], 0
    )
    return result


_LATE = 1.5
"""Periods between two stamps from which on a sample is taken to be missing."""


def stamp_quality(
    stamps_ns: Integers,
    origin_ns: int,
    *,
    repeated: int = 0,
    out_of_order: int = 0,
    not_finite: int = 0,
) -> StampQuality:
    """Return what the stamps of one joint's samples say."""
    counts = {"repeated": repeated, "out_of_order": out_of_order, "not_finite": not_finite}
    if not len(stamps_ns):
        return StampQuality(**counts)
    begin, end = ((int(stamps_ns[k]) - origin_ns) / NANOSECONDS for k in (0, -1))
    if len(stamps_ns) < 2:
        return StampQuality(count=1, begin=begin, end=end, **counts)
    steps = np.diff(stamps_ns)
    period = float(np.median(steps))
    late = np.flatnonzero(steps > _LATE * period)
    longest = int(late[np.argmax(steps[late])]) if len(late) else -1
    missing = int(np.sum(np.rint(steps[late] / period) - 1.0))
    # Samples that came late and then in a bunch are not missing.
    room = round(int(stamps_ns[-1] - stamps_ns[0]) / period) + 1 - len(stamps_ns)
    return StampQuality(
        count=len(stamps_ns),
        period=period / NANOSECONDS,
        begin=begin,
        end=end,
        gaps=len(late),
        lost=max(min(missing, room), 0),
        gap_time=float(np.sum(steps[late])) / NANOSECONDS,
        longest_gap=float(steps[longest]) / NANOSECONDS if len(late) else 0.0,
        longest_gap_at=((int(stamps_ns[longest]) - origin_ns) / NANOSECONDS if len(late) else 0.0),
        **counts,
    )


class LoggedTrajectory(NamedTuple):
    """A trajectory and its place in the log."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the files
    topic: str  # where it was published
    places: Mapping[str, int]  # place of each joint among its names
    column: Callable[[str, int], Column]  # gives the column of a joint and its place


def decoded_trajectory(raw: bytes) -> tuple[Mapping[str, int], Callable[[str, int], Column]]:
    """Return the joints of a serialised trajectory and what gives their columns."""
    # A recording may hold any number of points: reading it need not keep pace with a robot.
    decoded = decode_trajectory(raw, len(raw), len(raw))
    arrays = PointArrays(*decoded[3:7])
    times_ns, stamp_ns = decoded.times_ns, decoded.stamp_ns
    require_arrays(decoded.names, stamp_ns, times_ns, arrays, decoded.lengths, decoded.point)
    places = {name: index for index, name in enumerate(decoded.names)}
    return places, lambda joint, at: checked_column(joint, at, stamp_ns, times_ns, arrays)


class RecordedRun:
    """The messages of a run as columns and trajectories."""

    def __init__(
        self,
        choice: TopicChoice,
        types: Mapping[str, str],
        joints: frozenset[str] | None,
        has_order: bool,
    ) -> None:
        self.choice = choice
        self.notes: list[str] = []
        self.trajectories: list[LoggedTrajectory] = []
        self.states = {
            topic: JointStream(JOINT_STATE, "position", joints) for topic in choice.states
        }
        self.commands = {
            topic: JointStream(types[topic], "effort", joints, keeps_order=has_order)
            for topic in choice.commands
        }
        elements: dict[str, dict[int, str]] = {}
        for joint, (topic, element) in choice.command_topics.items():
            elements.setdefault(topic, {})[element] = joint
        self.floats = {
            topic: JointStream(types[topic], "data", elements=of_topic)
            for topic, of_topic in elements.items()
        }
        references = choice.references
        self.setpoints = {
            topic: JointStream(FLOAT64, "data", elements={0: joint})
            for joint, topic in references.setpoint.items()
        }
        self.sampled = {
            topic: JointStream(JOINT_STATE, "position", joints) for topic in references.sampled
        } | {
            topic: JointStream(CONTROLLER_STATE, "reference", joints)
            for topic in references.controller_state
        }

    def streams(self) -> Iterator[tuple[str, JointStream]]:
        """Yield topic and stream of everything but trajectories."""
        for streams in (self.states, self.commands, self.floats, self.setpoints, self.sampled):
            yield from streams.items()

    def add(self, batch: TopicBatch) -> None:
        """Take the next messages of a topic."""
        if batch.topic in self.choice.references.trajectory:
            self._add_trajectories(batch)
            return
        for topic, stream in self.streams():
            if topic == batch.topic:
                stream.add(batch)

    def _add_trajectories(self, batch: TopicBatch) -> None:
        for index in range(len(batch.starts)):
            log_time_ns, place = int(batch.log_times_ns[index]), int(batch.places[index])
            try:
                decoded = decoded_trajectory(batch.raw(index))
            except TrajectoryError as error:
                self.notes.append(f"a trajectory is left out, as controllers refuse it: {error}")
                continue
            except MessageError as error:
                # Whatever was followed from here on is unknown.
                raise BagError(f"{batch.topic} at {log_time_ns} ns: {error}") from error
            self.trajectories.append(LoggedTrajectory(log_time_ns, place, batch.topic, *decoded))

    def has_efforts(self) -> bool:
        """Return whether any command carries a joint's effort."""
        streams = (*self.commands.values(), *self.floats.values())
        return any(stream.joints() for stream in streams)

    def is_of_other_joints(self) -> bool:
        """Return whether there are commands or references, but of joints that no state names."""
        known = set(self.known_joints())
        named = self._concerned()
        return bool(named) and known.isdisjoint(named)

    def known_joints(self) -> list[str]:
        """Return the joints that states name, in their order."""
        return list(dict.fromkeys(name for each in self.states.values() for name in each.names))

    def take_states(self, joint: str) -> JointSamples | None:
        """Return one joint's positions and forget them; None if there are none."""
        topics = [topic for topic, stream in self.states.items() if joint in stream.joints()]
        if len(topics) > 1:
            raise SeriesError(
                f"joint {joint!r}: its states are on {' and on '.join(topics)}, but must be on "
                f"one of the topics (--states)"
            )
        return self.states[topics[0]].take(joint) if topics else None

    def concerned_joints(self) -> list[str]:
        """Return those that are commanded or have a reference, in the order of the states."""
        concerned = self._concerned()
        return [name for name in self.known_joints() if name in concerned]

    def _concerned(self) -> set[str]:
        concerned: set[str] = set()
        commands = () if self.choice.is_measured else self.commands.values()
        for stream in (*commands, *self.sampled.values()):
            concerned.update(stream.names)
        for stream in (*self.floats.values(), *self.setpoints.values()):
            concerned.update(stream.joints())
        for logged in self.trajectories:
            concerned.update(logged.places)
        return concerned
