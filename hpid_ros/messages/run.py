"""From the bag of a run to the arrays that the indices are computed from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from hpid_ros.base.errors import BagError, MessageError, unknown_name
from hpid_ros.messages.joint_run import JointRun, Window
from hpid_ros.messages.joint_state import JointReader
from hpid_ros.messages.selection import BagSelection, RecordedRun, TopicChoice, choose_topics
from hpid_ros.messages.series import (
    DataQuality,
    RecordingQuality,
    RunSeries,
    SeriesError,
    StampQuality,
)
from hpid_ros.messages.storage import (
    Progress,
    Storage,
    missed_messages,
    no_progress,
    time_stood_still,
)

_SHOWN_JOINTS = 3


def read_run(
    path: Path | str,
    label: str,
    *,
    joints: Sequence[str] | None = None,
    selection: BagSelection | None = None,
    progress: Progress | None = None,
) -> RunSeries:
    """Read one run from a bag.

    States and commands are ordered by their stamps; of several with one stamp the last stands.
    A command answers the state whose stamp it carries. Messages that carry no position (state)
    or no effort (command) for a joint do not concern it, and numbers that are not finite are left
    out. Where nothing carries efforts but the states, these measured ones are taken; a joint for
    which there are none, or no reference, has none (see :class:`JointSeries`). What could not be
    read, and what is missing, is in the result's ``quality``.

    Args:
        path: A bag folder, with ``metadata.yaml`` or without, or one ``.mcap`` or ``.db3`` file.
        label: Name of the run in tables and figures.
        joints: The joints to read, before those of the selection.
        selection: Topics, joints, references, clock and window; all found by name and type if
            not given.
        progress: Takes the share of the bag that has been read, in [0, 1].

    Raises:
        BagError: If nothing of the bag can be read, or it lacks a topic or a joint that was
            asked for, or any state, or a trajectory in it cannot be decoded.
        SettingError: The joints are no joints.
    """
    chosen = selection or BagSelection()
    if joints is not None:
        chosen = replace(chosen, joints=tuple(joints))
    with Storage(path) as storage:
        where = f"bag {storage.path}"
        try:
            recording = _recording(storage, where, chosen, progress or no_progress)
        except BagError as error:
            if not storage.unreadable:
                raise
            # What is missing may be in what could not be read.
            raise BagError(f"{error} ({'; '.join(storage.unreadable)})") from error
        unreadable = [*storage.unreadable, *_undecodable(where, recording)]
        own = storage.custom_data
        try:
            run = _run(label, recording, _joints(where, recording, chosen), chosen)
        except SeriesError as error:
            raise BagError(f"{where}: {error}") from error
    quality = replace(
        run.quality,
        source=str(path),
        unreadable=tuple(unreadable),
        missed=missed_messages(own),
        stood_still=time_stood_still(own),
    )
    return replace(run, quality=quality)


def _recording(
    storage: Storage, where: str, selection: BagSelection, progress: Progress
) -> RecordedRun:
    """Read the messages that are asked for."""
    topics = storage.topics()
    types = {name: info.type for name, info in topics.items()}
    joints = None if selection.joints is None else frozenset(selection.joints)

    def collected(choice: TopicChoice) -> RecordedRun:
        recording = RecordedRun(choice, types, joints)
        try:
            for batch in storage.batches(choice.all, progress):
                recording.add(batch)
        except BagError as error:
            raise BagError(f"{where}: {error}") from error
        return recording

    choice = choose_topics(where, types, selection)
    for topic in sorted(choice.all):
        encoding = topics[topic].encoding
        if encoding != "cdr":
            raise BagError(
                f"{where}: messages on {topic} are {encoding or 'of no encoding'}, but must be cdr"
            )
    recording = collected(choice)
    if choice.may_be_measured and not recording.has_efforts():
        recording = collected(choice.measured())
    _require_messages(where, recording)
    if choice.in_doubt and not (selection.commands or selection.command_topics):
        recording.notes.append(
            f"{', '.join(choice.in_doubt)}: efforts, positions or velocities, their types do not "
            "say which: not read; --commands effort takes them for efforts"
        )
    return recording


def _require_messages(where: str, recording: RecordedRun) -> None:
    """Raise BagError if there are no states, or no commands though they were asked for."""
    counts = {topic: stream.message_count for topic, stream in recording.streams()}
    counts |= dict.fromkeys(recording.choice.references.trajectory, 0)
    for logged in recording.trajectories:
        counts[logged.topic] += 1
    choice = recording.choice
    missing = [topic for topic in choice.states if not counts[topic]]
    commands = (*choice.commands, *(each.topic for each in choice.command_topics.values()))
    if not choice.is_measured and commands and not any(counts[topic] for topic in commands):
        missing.append(commands[0])
    if missing:
        listed = ", ".join(f"{name} {counts[name]}" for name in sorted(counts))
        raise BagError(f"{where}: no message on {missing[0]}; messages: {listed}")


def _undecodable(where: str, recording: RecordedRun) -> list[str]:
    """Return a line for each topic with messages that are not of its type."""
    lines = []
    for topic, stream in recording.streams():
        if stream.undecodable == stream.message_count > 0:
            raise BagError(f"{where}: {stream.first_failure}")
        if stream.undecodable:
            count = stream.undecodable
            lines.append(f"{count} messages on {topic} are left out: {stream.first_failure}")
    return lines


def _joints(where: str, recording: RecordedRun, selection: BagSelection) -> Sequence[str]:
    """Return the joints to read, all of which the states name."""
    known, concerned = recording.known_joints(), recording.concerned_joints()
    joints = selection.joints or [name for name in known if name in concerned]
    if not joints and not concerned:
        joints = known
    if not joints:
        choice = recording.choice
        commands = sorted({*choice.commands, *(c.topic for c in choice.command_topics.values())})
        raise BagError(
            f"{where}: no joint of {', '.join(choice.states)} is commanded on "
            f"{', '.join(commands) or 'any topic'} or has a reference; joints: "
            f"{', '.join(known)} (--command-topic JOINT=TOPIC[INDEX] says whose efforts are where)"
        )
    for joint in joints:
        if joint not in known:
            raise BagError(f"{where}: {unknown_name('joint', joint, known)}")
    return joints


def _run(
    label: str, recording: RecordedRun, joints: Sequence[str], selection: BagSelection
) -> RunSeries:
    """Return the series of all joints within the window."""
    runs = {joint: JointRun(recording, joint, selection) for joint in joints}
    origin_ns = min(int(run.states.stamps_ns[0]) for run in runs.values())
    window = Window.of(origin_ns, selection.start, selection.end)
    series, losses, qualities = [], {}, {}
    for joint in joints:
        joint_run = runs.pop(joint)
        if selection.joints is None and not joint_run.is_within(window):
            recording.notes.append(f"joint {joint!r} is left out: it has no state in the window")
            continue
        one, losses[joint], qualities[joint] = joint_run.series(window)
        series.append(one)
    if not series:
        raise SeriesError(f"no joint has a state from {selection.start} s to {selection.end} s")
    recording.notes.extend(_foreign_clocks(qualities))
    quality = RecordingQuality(joints=qualities, notes=tuple(recording.notes))
    return RunSeries(label, tuple(series), losses, quality=quality)


def _foreign_clocks(qualities: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield one line if commands have no time in common with the states."""
    joints = [name for name, each in qualities.items() if not each.has_common_time]
    if not joints:
        return
    first = qualities[joints[0]]
    shown = ", ".join(joints[:_SHOWN_JOINTS])
    more = len(joints) - _SHOWN_JOINTS
    yield (
        f"states and commands of {shown}{f' and {more} more' if more > 0 else ''} are on clocks "
        f"that do not overlap: {_span_of(first.states)} and {_span_of(first.commands)} after the "
        "first state; the energy is not computed (clock 'receive' gives both one clock)"
    )


def _span_of(stamps: StampQuality) -> str:
    return f"{stamps.begin:.3f} s to {stamps.end:.3f} s"


def measures_velocity(path: Path, joint: str) -> bool:
    """Return whether the first state of a joint in a bag has a velocity."""
    reader = JointReader(joint)
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        states = choose_topics(f"bag {path}", types, BagSelection()).states
        for batch in bag.batches(frozenset(states)):
            for raw in batch.raws():
                try:
                    sample = reader.read(raw)
                except MessageError:
                    continue
                if sample is not None:
                    return sample.velocity is not None
    return False
