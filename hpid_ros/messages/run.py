"""From the bag of a run to the arrays that the indices are computed from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from hpid_ros.base.errors import BagError, listed_names
from hpid_ros.base.names import NamePatterns
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.metadata import missed_messages, time_stood_still
from hpid_ros.messages.quality import (
    GIVEN,
    HOLD,
    MEASURED,
    DataQuality,
    RecordingQuality,
    StampQuality,
)
from hpid_ros.messages.reading.joint_reference import FOREVER_NS
from hpid_ros.messages.reading.joint_run import JointRun, NoNumberError, Window
from hpid_ros.messages.reading.one_sender import resolve_clock, resolve_senders
from hpid_ros.messages.reading.other_states import glimpse, note_other_states
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.topic_choice import REPORTS, TopicChoice, choose_topics
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import KeptJoints, RunSeries, SeriesError
from hpid_ros.messages.spill import Spill
from hpid_ros.messages.storage import ReadingProgress, Storage, no_progress, opened

_SHOWN_JOINTS = 3
_SHOWN_OTHERS = 10
_READING = 0.5  # share of the work that is reading the files, about


def read_run(
    path: Path | str | Storage,
    label: str,
    *,
    joints: Sequence[str] | None = None,
    selection: BagSelection | None = None,
    progress: ReadingProgress | None = None,
) -> RunSeries:
    """Read one run from a bag.

    States and commands are ordered by their stamps; of several with one stamp the last stands.
    A command answers the state whose stamp it carries. Messages that carry no position (state)
    or no effort (command) for a joint do not concern it, and numbers that are not finite are left
    out. Where nothing carries efforts but the states, these measured ones are taken; a joint for
    which there are none, or no reference, has none (see :class:`JointSeries`). What could not be
    read, and what is missing, is in the result's ``quality``.

    Args:
        path: A bag folder, with ``metadata.yaml`` or without, or one ``.mcap`` or ``.db3`` file;
            or a bag that is open.
        label: Name of the run in tables and figures.
        joints: The joints to read, before those of the selection.
        selection: Topics, joints, references, clock and window; all found by name and type if
            not given.
        progress: Takes the share of the work that is done, in [0, 1].

    Raises:
        BagError: If nothing of the bag can be read, or it lacks a topic or a joint that was
            asked for, or any state, or a trajectory in it cannot be decoded.
        SettingError: The joints are no joints.
    """
    chosen = selection or BagSelection()
    told = progress or no_progress
    if joints is not None:
        chosen = replace(chosen, joints=joints)
    with opened(path) as storage:
        where = f"bag {storage.path}"
        try:
            recording = _recording(storage, where, chosen, lambda share: told(_READING * share))
        except BagError as error:
            if not storage.unreadable:
                raise
            # What is missing may be in what could not be read.
            raise BagError(f"{error} ({'; '.join(storage.unreadable)})") from error
        quality = RecordingQuality(
            source=str(storage.path if isinstance(path, Storage) else path),
            unreadable=(*storage.unreadable, *_undecodable(where, recording)),
            missed=missed_messages(storage.custom_data),
            stood_still=time_stood_still(storage.custom_data),
        )
    joints = _joints(where, recording, chosen)
    chosen = replace(chosen, clock=resolve_clock(recording, chosen.clock))
    try:
        return _run(
            label,
            recording,
            joints,
            chosen,
            quality,
            lambda share: told(_READING + (1.0 - _READING) * share),
        )
    except SeriesError as error:
        raise BagError(f"{where}: {error}") from error


def _recording(
    storage: Storage, where: str, selection: BagSelection, progress: ReadingProgress
) -> RecordedRun:
    """Read the messages that are asked for."""
    topics = storage.topics()
    types = {name: info.type for name, info in topics.items()}
    is_open = selection.joints is None or selection.every
    joints = None if is_open else NamePatterns(selection.joints or ())

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
    commanded, numberless = recording.commanded()
    if choice.may_be_measured and (not commanded or numberless):
        before = list(recording.odd_lines())
        recording = collected(choice.measured({*numberless} if commanded else None))
        recording.notes += [line for line in before if line not in recording.odd_lines()]
        for joint, without in () if commanded else numberless.items():
            recording.decisions.note_no_numbers(joint, without, MEASURED)
    _require_messages(where, recording)
    resolve_senders(recording, selection.sender)
    if choice.other_states:
        unreadable = len(storage.unreadable)  # what cannot be read was said
        read, *others = (
            glimpse(topic, storage.batches(frozenset({topic})))
            for topic in (*choice.states, *choice.other_states)
        )
        del storage.unreadable[unreadable:]
        note_other_states(recording, read, others)
    if choice.others:
        recording.notes.append(
            f"{', '.join(choice.others)}: not read, as another robot's, whose states are beside "
            "them; --commands TOPIC takes them"
        )
    if choice.in_doubt and not (selection.commands or selection.command_topics):
        recording.notes.append(
            f"{', '.join(choice.in_doubt)}: efforts, positions or velocities, their types do not "
            "say which: not read; --commands effort takes them for efforts"
        )
    if choice.goals and not (choice.references.controller_state or choice.references.trajectories):
        recording.notes.append(
            f"{', '.join(choice.goals)}: goals of an action, or its feedback: not read; record "
            "controller_state, or give the motion (--reference FILE)"
        )
    if choice.nameless and not choice.references.controller_state:
        recording.notes.append(
            f"{', '.join(choice.nameless)}: errors and outputs of a PID, which name no joint: not "
            f"read; record what names them ({' or '.join(REPORTS)})"
        )
    return recording


def _require_messages(where: str, recording: RecordedRun) -> None:
    """Raise BagError if there are no states, or no commands though they were asked for."""
    counts = {topic: stream.message_count for topic, stream in recording.streams()}
    counts |= dict.fromkeys(recording.choice.references.trajectories, 0)
    for _, _, topic, _ in recording.trajectories:
        counts[topic] += 1
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
    odd = dict.fromkeys(recording.odd_lines())
    if odd and not any(stream.joints() for stream in recording.states.values()):
        raise BagError(f"{where}: no state of a joint can be read: {'; '.join(odd)}")
    return [*dict.fromkeys(lines), *odd]


def _joints(where: str, recording: RecordedRun, selection: BagSelection) -> Sequence[str]:
    """Return the joints to read, all of which the states name."""
    known, concerned = recording.known_joints(), recording.concerned_joints()
    joints = [name for name in known if name in concerned]
    if not joints and (not concerned or selection.reference == HOLD):
        joints = known
    commanded = {name for each in recording.floats.values() for name in each.joints()}
    for name in sorted(commanded - {*known}) if known else ():
        topic = recording.choice.command_topics[name].topic
        recording.notes.append(
            f"{topic}: {name!r}, after which it is called, is no joint of the states: its efforts "
            "are not read (--command-topic JOINT=TOPIC[INDEX] says whose they are)"
        )
    if selection.joints is None and (others := [name for name in known if name not in joints]):
        recording.notes.append(
            f"left out, as nothing commands them and nothing is their reference: "
            f"{listed_names(others, _SHOWN_OTHERS)} (--joint names joints to read)"
        )
    if selection.joints is not None and known:
        try:
            return NamePatterns(selection.joints).chosen("joint", known, BagError, joints)
        except BagError as error:
            raise BagError(f"{where}: {error}") from None
    if not joints:
        choice = recording.choice
        commands = sorted({*choice.commands, *(c.topic for c in choice.command_topics.values())})
        raise BagError(
            f"{where}: no joint of {', '.join(choice.states)} is commanded on "
            f"{', '.join(commands) or 'any topic'} or has a reference; joints: "
            f"{', '.join(known)} (--command-topic JOINT=TOPIC[INDEX] says whose efforts are where)"
        )
    return joints


def _run(
    label: str,
    recording: RecordedRun,
    joints: Sequence[str],
    selection: BagSelection,
    quality: RecordingQuality,
    progress: ReadingProgress,
) -> RunSeries:
    """Return the series of all joints within the window."""
    spill, runs, failures = Spill(), dict[str, JointRun](), list[NoNumberError]()
    for number, joint in enumerate(joints):
        progress(0.5 * number / len(joints))
        try:
            runs[joint] = JointRun(recording, joint, selection)
        except NoNumberError as error:
            if selection.joints is not None:
                raise
            failures.append(error)
            recording.notes.append(f"joint {joint!r} is left out: no position of it is a number")
            continue
        runs[joint].set_aside(spill)
    if not runs:
        raise failures[0]
    joints = [*runs]
    origin_ns = min(int(run.states.stamps_ns[0]) for run in runs.values())
    start, end = selection.start, selection.end
    window = Window(
        origin_ns,
        -FOREVER_NS if start is None else origin_ns + round(start * NANOSECONDS),
        FOREVER_NS if end is None else origin_ns + round(end * NANOSECONDS),
    )
    series, losses, qualities = KeptJoints(spill), {}, {}
    for number, joint in enumerate(joints):
        progress(0.5 + 0.5 * number / len(joints))
        found = runs.pop(joint).series(window)
        if found is not None:
            one, losses[joint], qualities[joint] = found
            series.append(one)
        elif selection.joints is None:
            recording.notes.append(f"joint {joint!r} is left out: it has no state in the window")
        else:
            raise SeriesError(f"joint {joint!r}: no state in the window")
    if not series:
        raise SeriesError(f"no joint has a state from {start} s to {end} s")
    asked = frozenset(joints)
    for joint in recording.known_joints() if selection.every else ():
        with suppress(SeriesError):  # nobody asked for it
            if joint not in asked and (
                found := JointRun(recording, joint, selection).series(window)
            ):
                one, losses[joint], qualities[joint] = found
                series.append(one)
    recording.notes.extend(recording.decisions.lines())
    recording.notes.extend(_other_speeds(recording.choice.speed_scalings, qualities))
    recording.notes.extend(_foreign_clocks(qualities))
    progress(1.0)
    is_window = start is not None or end is not None
    streams = [each for found in qualities.values() for each in (found.states, found.commands)]
    if is_window and any(x.repeated or x.out_of_order or x.not_finite for x in streams):
        recording.notes.append(
            "what is repeated, out of order or not finite is counted in the whole recording, not "
            "in the window alone"
        )
    quality = replace(quality, joints=qualities, notes=tuple(recording.notes))
    return RunSeries(label, series.at_once() or series, losses, quality=quality)


def _other_speeds(topics: Sequence[str], qualities: Mapping[str, DataQuality]) -> Iterator[str]:
    """Yield one line if trajectories are references, and may have been followed more slowly."""
    joints = [
        name
        for name, each in qualities.items()
        if each.reference == GIVEN or each.reference.startswith("trajectory ")
    ]
    if topics and joints:
        yield (
            f"the trajectory of {listed_names(joints, _SHOWN_JOINTS)} may have been followed at "
            f"another speed: {' and '.join(topics)} is not read (a controller_state says what was "
            "followed)"
        )


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
        "first state; the energy is not computed (--clock receive gives both one clock)"
    )


def _span_of(stamps: StampQuality) -> str:
    return f"{stamps.begin:.3f} s to {stamps.end:.3f} s"
