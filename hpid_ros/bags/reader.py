"""From the bag of a run to the arrays that the indices are computed from."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpid_ros.analysis.series import JointSeries, Losses, RunSeries, SeriesError
from hpid_ros.bags.bag_file import BagReader, RawMessage, TopicSummary
from hpid_ros.bags.joint_blocks import JointStateBlock, joint_column, joint_state_blocks
from hpid_ros.bags.message_types import JOINT_STATE, JOINT_TRAJECTORY, decode_joint_trajectory
from hpid_ros.bags.references import LoggedTrajectory, sample_reference
from hpid_ros.errors import BagError, MessageError, TrajectoryError, unknown_name

__all__ = ["BagReader", "RawMessage", "TopicSummary", "read_run"]

_log = logging.getLogger(__name__)


class _Topics(NamedTuple):
    """Full names of the topics of a run; no trajectory topic means that every joint holds."""

    states: str
    commands: str
    trajectory: str | None


class _Recording(NamedTuple):
    """A run's messages as arrays and trajectories."""

    states: list[JointStateBlock]
    commands: list[JointStateBlock]
    trajectories: list[LoggedTrajectory]


def read_run(
    path: Path | str,
    label: str,
    *,
    states: str = "joint_states",
    commands: str = "joint_commands",
    trajectory: str | None = "joint_trajectory",
    joints: Sequence[str] | None = None,
) -> RunSeries:
    """Read one run from a bag.

    States and commands are ordered by their stamps; of several with one stamp the last stands.
    A command answers the state whose stamp it carries. Messages that carry no position (state)
    or no effort (command) for a joint do not concern it.

    Args:
        path: A bag folder, or one ``.mcap`` or ``.db3`` file.
        label: Name of the run in tables and figures.
        states: Topic of the states; names as in :meth:`BagReader.find_topic`.
        commands: Topic of the commands.
        trajectory: Topic of the references; None if every joint holds its first position.
        joints: The joints to read. If not given, those of the states that are commanded or
            have a reference, in the order of the states.

    Raises:
        BagError: If the bag cannot be read, or lacks a topic, a joint, a state or any command.
    """
    with BagReader(path) as bag:
        topics = _Topics(
            bag.find_topic(states, JOINT_STATE),
            bag.find_topic(commands, JOINT_STATE),
            None if trajectory is None else bag.find_topic(trajectory, JOINT_TRAJECTORY),
        )
        recording = _read(bag, topics)
        where = f"bag {bag.path}"
    known = list(dict.fromkeys(name for block in recording.states for name in block.names))
    if joints is None:
        joints = _concerned(recording, known)
        if not joints:
            raise BagError(
                f"{where}: no joint of {topics.states} is commanded on {topics.commands} or has "
                f"a reference; joints: {', '.join(known)}"
            )
    for joint in joints:
        if joint not in known:
            raise BagError(f"{where}: {unknown_name('joint', joint, known)}")
    try:
        series = [_joint_series(recording, joint) for joint in joints]
        return RunSeries(
            label,
            tuple(one for one, _ in series),
            {one.joint: losses for one, losses in series},
        )
    except SeriesError as error:
        raise BagError(f"{where}: {error}") from error


def _read(bag: BagReader, topics: _Topics) -> _Recording:
    """Read the messages of a run and decode them."""
    raw_states: list[bytes] = []
    raw_commands: list[bytes] = []
    trajectories: list[LoggedTrajectory] = []
    try:
        for topic, _, raw in bag.messages(*filter(None, topics)):
            if topic == topics.commands:
                raw_commands.append(raw)
            elif topic == topics.states:
                raw_states.append(raw)
            else:
                trajectories.extend(_logged_trajectory(bag, raw, len(raw_states)))
        for topic, raws in ((topics.states, raw_states), (topics.commands, raw_commands)):
            if not raws:
                raise BagError(f"bag {bag.path}: no message on {topic}; {_counts(bag)}")
        return _Recording(
            joint_state_blocks(raw_states), joint_state_blocks(raw_commands), trajectories
        )
    except MessageError as error:
        raise BagError(f"bag {bag.path}: {error}") from error


def _logged_trajectory(bag: BagReader, raw: bytes, states_before: int) -> list[LoggedTrajectory]:
    """Decode a trajectory; one that the controllers refused leaves the reference as it was."""
    try:
        return [LoggedTrajectory(decode_joint_trajectory(raw), states_before)]
    except TrajectoryError as error:
        _log.warning(
            "bag %s: a trajectory is left out, as controllers refuse it: %s", bag.path, error
        )
        return []


def _counts(bag: BagReader) -> str:
    """Say how many messages each topic has."""
    counts = (f"{name} {topic.message_count}" for name, topic in sorted(bag.topics.items()))
    return f"messages: {', '.join(counts)}"


def _concerned(recording: _Recording, known: Sequence[str]) -> list[str]:
    """Return the joints that are commanded or have a reference, in the order of the states."""
    concerned = {name for block in recording.commands for name in block.names}
    for logged in recording.trajectories:
        concerned.update(logged.trajectory.joint_names)
    return [name for name in known if name in concerned]


def _joint_series(recording: _Recording, joint: str) -> tuple[JointSeries, Losses]:
    """Return one joint's series and what went missing."""
    states = joint_column(recording.states, joint, "position")
    stamps_ns, position, _ = states.by_stamp()
    if not len(stamps_ns):
        raise SeriesError(f"joint {joint!r}: no state carries its position")
    command_stamps_ns, effort, repeated = joint_column(
        recording.commands, joint, "effort"
    ).by_stamp()
    unanswered = int(np.count_nonzero(~np.isin(stamps_ns, command_stamps_ns)))
    reference = sample_reference(
        joint, recording.trajectories, states, stamps_ns, float(position[0])
    )
    series = JointSeries(joint, stamps_ns, position, reference, command_stamps_ns, effort)
    return series, Losses(unanswered, repeated)
