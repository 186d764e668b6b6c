"""Topics of states that are not read, and what they hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import listed_names
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.columns import JOINT_STATE, JointStream, Layouts, TopicBatch, finite
from hpid_ros.messages.reading.decisions import MOST_NAMES
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.topic_choice import is_below, namespace_of


class Glimpse(NamedTuple):
    """What the first messages on a topic of states hold."""

    topic: str
    period: float  # [s] usual time between two; zero if there are not two
    joints: frozenset[str]  # whose positions they have
    joints_with_efforts: frozenset[str]  # whose efforts they have, and not 0 throughout

    def __str__(self) -> str:
        rate = f"{1.0 / self.period:.3g} Hz, " if self.period else ""
        return f"{self.topic} ({rate}{'with' if self.joints_with_efforts else 'without'} efforts)"


_GLIMPSED = 100  # messages that tell the rate


def glimpse(topic: str, batches: Iterable[TopicBatch]) -> Glimpse:
    """Return what the first messages on a topic of states hold."""
    layouts = Layouts(JOINT_STATE)
    positions, efforts = (JointStream(layouts, field) for field in ("position", "effort"))
    times = np.empty(0, dtype=np.int64)
    for batch in batches:
        positions.add(batch)
        efforts.add(batch)
        times = np.concatenate((times, batch.log_times_ns))
        if len(times) >= _GLIMPSED:
            break
    steps = np.diff(np.sort(times))
    with_efforts = []
    for joint in efforts.joints():
        samples = efforts.peek(joint)
        if samples is not None and finite(samples)[0].values.any():
            with_efforts.append(joint)
    return Glimpse(
        topic,
        float(np.median(steps)) / NANOSECONDS if len(steps) else 0.0,
        positions.joints(),
        frozenset(with_efforts),
    )


def note_other_states(recording: RecordedRun, read: Glimpse, others: Sequence[Glimpse]) -> None:
    """Note topics that have states of the joints, too, where one was chosen by its name."""
    known = recording.known_joints()
    for each in others:
        shared = [joint for joint in known if joint in each.joints]
        namespace = namespace_of(each.topic)
        beside = [name for name in recording.choice.not_own if is_below(name, namespace)]
        left = f"; what is beside them is not read: {', '.join(beside)}" if beside else ""
        if shared:
            recording.notes.append(
                f"{each} has states of {listed_names(shared, MOST_NAMES)}, too: {read} is "
                f"read (--states {each.topic} takes the other){left}"
            )
        for joint in each.joints_with_efforts:
            recording.efforts_elsewhere.setdefault(joint, each.topic)
