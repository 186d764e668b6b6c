"""Everything of a run that was recorded, collected in one pass over its bag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from hpid_ros.bags.columns.batches import TopicBatch
from hpid_ros.bags.columns.layouts import CONTROLLER_STATE, FLOAT64, JOINT_STATE
from hpid_ros.bags.columns.samples import JointSamples
from hpid_ros.bags.columns.streams import JointStream
from hpid_ros.bags.run.topics import TopicChoice
from hpid_ros.base.errors import BagError, MessageError, TrajectoryError
from hpid_ros.recordings.series import SeriesError
from hpid_ros.trajectory import Column
from hpid_ros.trajectory.joint_trajectory import PointArrays, checked_column, require_arrays
from hpid_ros.wire import decode_trajectory


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
        """Tell whether any command carries a joint's effort."""
        streams = (*self.commands.values(), *self.floats.values())
        return any(stream.joints() for stream in streams)

    def is_of_other_joints(self) -> bool:
        """Tell whether there are commands or references, but of joints that no state names."""
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
