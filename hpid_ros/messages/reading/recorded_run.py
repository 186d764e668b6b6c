"""The messages of a run as columns and trajectories."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

from hpid_ros.base.errors import BagError, MessageError, TrajectoryError
from hpid_ros.messages.bounds import RECORDED
from hpid_ros.messages.columns import (
    MULTI_DOF_STATE,
    Integers,
    JointSamples,
    JointStream,
    Layouts,
    Ordered,
    TopicBatch,
)
from hpid_ros.messages.joint_trajectory import TrajectoryArrays, decode_trajectory
from hpid_ros.messages.quality import StampQuality
from hpid_ros.messages.reading.decisions import Decisions
from hpid_ros.messages.reading.topic_choice import REPORTS, TopicChoice
from hpid_ros.messages.series import SeriesError
from hpid_ros.messages.spill import Spill
from hpid_ros.motion.joint_trajectory import Column


def decoded_trajectory(raw: bytes) -> TrajectoryArrays:
    """Return a serialised trajectory, checked."""
    decoded = decode_trajectory(raw, RECORDED)
    decoded.require()
    return decoded


class RecordedRun:
    """The messages of a run as columns and trajectories."""

    def __init__(
        self,
        choice: TopicChoice,
        types: Mapping[str, str],
        joints: Container[str] | None,
    ) -> None:
        self.choice = choice
        self.notes: list[str] = []
        self.decisions = Decisions(choice.states)
        # log time in [ns], place in the files, topic and content of each
        self.trajectories: list[tuple[int, int, str, TrajectoryArrays]] = []
        spill, layouts = Spill(), dict[str, Layouts]()

        def of(topic: str) -> Layouts:
            if topic not in layouts:
                layouts[topic] = Layouts(types[topic], spill)
            return layouts[topic]

        self.states = {
            topic: JointStream(of(topic), "position", joints) for topic in choice.states
        }
        self.velocities = {
            topic: JointStream(of(topic), "velocity", joints)
            for topic in (choice.states if choice.reads_velocities else ())
        }
        self.commands = {
            topic: JointStream(of(topic), "effort", joints) for topic in choice.commands
        }
        self.reports = {topic for topic in choice.commands if types[topic] in REPORTS}
        self.measured = {
            topic: JointStream(of(topic), "effort", choice.measured_joints)
            for topic in (choice.states if choice.measured_joints else ())
        }
        elements: dict[str, dict[int, str]] = {}
        for joint, (topic, element) in choice.command_topics.items():
            elements.setdefault(topic, {})[element] = joint
        self.floats = {
            topic: JointStream(of(topic), "data", elements=of_topic)
            for topic, of_topic in elements.items()
        }
        references = choice.references
        self.setpoints = {
            topic: JointStream(of(topic), "data", elements={0: joint})
            for joint, topic in references.setpoint.items()
        }
        self.sampled = {
            topic: JointStream(of(topic), "position", joints) for topic in references.sampled
        } | {
            topic: JointStream(of(topic), "reference", joints)
            for topic in references.controller_state
        }
        # where controllers say that joints were; of a PID controller it may be a velocity
        self.feedbacks = {
            topic: JointStream(of(topic), "feedback", joints)
            for topic in references.controller_state
        }
        self._of_pids = {x for x in references.controller_state if types[x] == MULTI_DOF_STATE}
        # of the streams that were looked at last
        self._qualities: list[tuple[Integers, int, StampQuality]] = []
        # topic of states that are not read, but have efforts of a joint
        self.efforts_elsewhere: dict[str, str] = {}

    def streams(self) -> Iterator[tuple[str, JointStream]]:
        """Yield topic and stream of everything but trajectories and velocities."""
        every = (self.states, self.commands, self.floats, self.setpoints, self.sampled)
        for streams in (*every, self.feedbacks, self.measured):
            yield from streams.items()

    def odd_lines(self) -> Iterator[str]:
        """Yield a line for each thing that is not taken, for the names that messages have."""
        for topic, stream in self.streams():
            yield from stream.odd_lines(topic)

    def add(self, batch: TopicBatch) -> None:
        if batch.topic in self.choice.references.trajectories:
            self._add_trajectories(batch)
            return
        for topic, stream in (*self.streams(), *self.velocities.items()):
            if topic == batch.topic:
                stream.add(batch)

    def _add_trajectories(self, batch: TopicBatch) -> None:
        for log_time_ns, place, raw in batch.messages():
            try:
                decoded = decoded_trajectory(raw)
            except TrajectoryError as error:
                self.notes.append(f"a trajectory is left out, as controllers refuse it: {error}")
                continue
            except MessageError as error:
                # Whatever was followed from here on is unknown.
                raise BagError(f"{batch.topic} at {log_time_ns} ns: {error}") from error
            self.trajectories.append((log_time_ns, place, batch.topic, decoded))

    @cached_property
    def _places(self) -> Mapping[str, Sequence[tuple[int, int]]]:
        """Where each joint is: which trajectory, and which of its names."""
        places: dict[str, list[tuple[int, int]]] = {}
        for number, (*_, arrays) in enumerate(self.trajectories):
            for at, name in enumerate(arrays.names):
                places.setdefault(name, []).append((number, at))
        return places

    def trajectories_of(self, joint: str) -> Iterator[tuple[int, int, str, Column]]:
        """Yield a joint's columns, each with log time in [ns], place in the files and topic.

        To be asked when all messages have been added.
        """
        for number, at in self._places.get(joint, ()):
            log_time_ns, place, topic, arrays = self.trajectories[number]
            yield log_time_ns, place, topic, arrays.column_at(at)

    def take_feedback(self, topic: str, joint: str) -> JointSamples | None:
        """Return where a controller says that a joint was and forget it; None if it does not."""
        stream = self.feedbacks.get(topic)
        return None if stream is None else stream.take(joint)

    def may_be_foreign(self, topic: str) -> bool:
        """Return whether reports may be about something else than positions."""
        return topic in self._of_pids

    def quality(self, samples: Ordered, origin_ns: int) -> StampQuality:
        """Return what the stamps of samples say; joints that share them are looked at once."""
        stamps_ns = samples.stamps_ns
        for known, of, found in self._qualities:
            if known is stamps_ns and of == origin_ns:
                return replace(
                    found,
                    repeated=samples.repeated,
                    out_of_order=samples.out_of_order,
                    not_finite=samples.not_finite,
                )
        found = samples.quality(origin_ns)
        self._qualities = [(stamps_ns, origin_ns, found), *self._qualities[:1]]
        return found

    def commanded(self) -> tuple[set[str], dict[str, list[str]]]:
        """Return joints with commanded efforts, and those whose efforts are no numbers.

        The latter with the topics of these.
        """
        commanded: set[str] = set()
        numberless: dict[str, list[str]] = {}
        for topic, stream in (*self.floats.items(), *self.commands.items()):
            for joint in stream.joints():
                if stream.has_numbers(joint):
                    commanded.add(joint)
                else:
                    numberless.setdefault(joint, []).append(topic)
        return commanded, {k: numberless[k] for k in sorted(numberless) if k not in commanded}

    def known_joints(self) -> list[str]:
        """Return the joints that states name, in their order."""
        return list(dict.fromkeys(name for each in self.states.values() for name in each.names))

    def topic_of_states(self, joint: str) -> str:
        """Return the topic of a joint's states; empty if there is none."""
        return next((topic for topic, stream in self.states.items() if stream.has(joint)), "")

    def take_states(self, joint: str) -> JointSamples | None:
        """Return one joint's positions and forget them; None if there are none."""
        topics = [topic for topic, stream in self.states.items() if stream.has(joint)]
        if len(topics) > 1:
            raise SeriesError(
                f"joint {joint!r}: its states are on {' and on '.join(topics)}, but must be on "
                f"one of the topics (--states)"
            )
        return self.states[topics[0]].take(joint) if topics else None

    def concerned_joints(self) -> set[str]:
        """Return those that are commanded or have a reference, known or not."""
        concerned: set[str] = set()
        commands = {} if self.choice.is_measured else self.commands
        for topic, stream in (*commands.items(), *self.sampled.items()):
            is_beside = topic in self.choice.beside and topic not in self.sampled
            concerned.update(stream.joints() if is_beside else stream.names)
        for stream in (*self.floats.values(), *self.setpoints.values()):
            concerned.update(stream.joints())
        for _, _, _, arrays in self.trajectories:
            concerned.update(arrays.names)
        return concerned
