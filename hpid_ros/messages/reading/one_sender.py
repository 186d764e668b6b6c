"""One sender of each joint's states and efforts, and the clock that its stamps are fit for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from hpid_ros.base.errors import SettingError, listed_names
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.columns import Integers, JointSamples, JointStream
from hpid_ros.messages.reading.clocks import set_backs, states_set_right
from hpid_ros.messages.reading.recorded_run import RecordedRun
from hpid_ros.messages.reading.senders import (
    Part,
    Senders,
    coarse_ns,
    contradict_at_one_instant,
    find_senders,
    has_several_clocks,
    may_be_several,
    returns,
    stands_every_other,
)

_SHARED_MOVE = 0.05  # of the states that share a stamp; with fewer that move they are repeats
_COARSE_STEPS = 1.5  # by so many steps coarse stamps are behind receive times, at most


def _may_be_several(
    stream: JointStream,
    joints: Sequence[str],
    layout: tuple[str, list[Integers]],
) -> bool:
    """Return whether messages of one layout may be of several senders, by a glance."""
    stamps_ns, log_times_ns, _ = layout[1]
    if may_be_several(stamps_ns) or has_several_clocks(stamps_ns, log_times_ns):
        return True
    return any(returns(some) for joint in joints for some in stream.probes(joint))


def _coarse(joints: Iterable[JointSamples]) -> tuple[int, bool]:
    """Return the step of stamps that unlike states share, and whether they are receive times.

    The step is 0 where stamps are not coarse, in [ns].
    """
    for samples in joints:
        stamps_ns, log_times_ns, _, values = samples
        step = coarse_ns(stamps_ns, log_times_ns)
        if not step:
            return 0, False
        is_shared = stamps_ns[1:] == stamps_ns[:-1]
        moved = np.count_nonzero(np.abs(np.diff(values))[is_shared] > 0.0)
        if moved > _SHARED_MOVE * np.count_nonzero(is_shared):
            return step, bool(np.ptp(log_times_ns - stamps_ns) < _COARSE_STEPS * step)
    return 0, False


def _doubt_lines(
    topic: str, stream: JointStream, efforts: JointStream | None, joints: Sequence[str]
) -> Iterator[str]:
    """Yield a line for numbers that alternate, where nothing else tells of a second sender."""
    alternate = (
        (stream, returns, "positions come back from state to state, by more than 0.02"),
        (efforts, stands_every_other, "every other effort is one and the same number"),
    )
    for of, does, what in alternate:
        names = [
            joint
            for joint in joints
            if of is not None and any(does(some) for some in of.probes(joint))
        ]
        if names:
            yield (
                f"{listed_names(names, 3)} on {topic}: {what}: taken for one sender's, "
                "as neither stamps nor positions prove a second one"
            )


def _has_two_efforts(samples: JointSamples | None) -> bool:
    if samples is None:
        return False
    stamps_ns = states_set_right(samples, set_backs(samples))
    return contradict_at_one_instant(stamps_ns, samples.values)


def _set_right(layouts: list[tuple[str, list[Integers]]]) -> list[tuple[str, list[Integers]]]:
    """Return messages by layout with stamps as if their clock had never been set back."""
    if all((times[0][1:] > times[0][:-1]).all() for _, times in layouts):
        return layouts
    joined = JointSamples.joined(
        [JointSamples(stamps, logs, places, np.empty(0)) for _, (stamps, logs, places) in layouts]
    )
    order = np.lexsort((joined.places, joined.log_times_ns))
    logged = JointSamples(
        joined.stamps_ns[order], joined.log_times_ns[order], joined.places[order], joined.values
    )
    found = set_backs(logged)
    if not found:
        return layouts
    stamps_ns = np.empty_like(joined.stamps_ns)
    stamps_ns[order] = states_set_right(logged, found)
    parts = np.split(stamps_ns, np.cumsum([len(times[0]) for _, times in layouts])[:-1])
    return [(text, [part, *times[1:]]) for (text, times), part in zip(layouts, parts, strict=True)]


def _parts(
    stream: JointStream | None,
    efforts: JointStream | None,
    joints: Sequence[str],
    layouts: Sequence[tuple[str, list[Integers]]],
) -> list[Part]:
    """Return the messages of some joints by layout, with their positions and measured efforts."""

    def columns(of: JointStream | None) -> list[dict[str, Numbers]]:
        found: list[dict[str, Numbers]] = [{} for _ in layouts]
        for joint in joints:
            samples = None if of is None else of.peek(joint)
            if samples is None:
                continue
            order = np.argsort(samples.places)
            known = samples.places[order]
            for (_, (_, _, places)), numbers in zip(layouts, found, strict=True):
                at = np.minimum(np.searchsorted(known, places), len(known) - 1)
                if (known[at] == places).all():
                    numbers[joint] = np.nan_to_num(samples.values[order[at]])
        return found

    parts = zip(layouts, columns(stream), columns(efforts), strict=True)
    return [
        Part(text, stamps_ns, log_times_ns, places, values, numbers)
        for (text, (stamps_ns, log_times_ns, places)), values, numbers in parts
    ]


def _senders_line(topic: str, what: str, joints: Sequence[str], found: Senders) -> str:
    names = listed_names(joints, 3)
    left = " and ".join(map(str, found.left))
    if len(found.left) == len(found.each) - 1:
        left = "the others are left out"
    else:
        left += " is left out" if len(found.left) == 1 else " are left out"
    return (
        f"{names} on {topic}: {what} of {len(found.each)} senders, {'; '.join(found.texts())}: "
        f"sender {found.taken} is taken, {left} (--sender NUMBER, RATEHz or LAYOUT takes another)"
    )


def resolve_senders(recording: RecordedRun, wanted: str | None) -> None:
    """Keep one sender of each joint, the wanted one or the one that goes on, and say so.

    Raises:
        SettingError: No sender of any joint is the wanted one.
    """
    found: list[tuple[str, Senders]] = []
    for topic, stream in recording.states.items():
        measured = recording.commands if recording.choice.is_measured else recording.measured
        efforts = measured.get(topic)
        for joints, logged in stream.shared():
            layouts, senders = _set_right(logged), None
            if len(layouts) > 1 or _may_be_several(stream, joints, layouts[0]):
                senders = find_senders(_parts(stream, efforts, joints, layouts), wanted)
            if senders is None:
                recording.notes.extend(_doubt_lines(topic, stream, efforts, joints))
                continue
            found.append((_senders_line(topic, "states", joints, senders), senders))
            for each in (stream,) if efforts is None else (stream, efforts):
                for joint in joints:
                    each.leave_out(joint, senders.left_out)
    for topic, stream in recording.commands.items():
        if recording.choice.is_measured or topic in recording.reports:
            continue
        for joints, logged in stream.shared():
            layouts = _set_right(logged)
            if not any(_has_two_efforts(stream.peek(joint)) for joint in joints):
                continue
            senders = find_senders(_parts(None, stream, joints, layouts), wanted)
            if senders is None:
                continue
            found.append((_senders_line(topic, "efforts", joints, senders), senders))
            for joint in joints:
                stream.leave_out(joint, senders.left_out)
    lines = [line for line, _ in found]
    recording.notes.extend(lines)
    if wanted is not None and not any(senders.is_wanted for _, senders in found):
        raise SettingError(
            f"no sender is {wanted!r}: "
            + ("; ".join(lines) or "each joint has one sender, by what can be seen")
        )


def resolve_clock(recording: RecordedRun, clock: str) -> str:
    """Return the clock to read with, the receive times where stamps are those made coarse."""
    if clock != "header":
        return clock
    for topic, stream in recording.states.items():
        for joints, layouts in stream.shared():
            if len(layouts) == 1 and (np.diff(layouts[0][1][0]) > 0).all():
                continue
            step, is_receive = _coarse(filter(None, map(stream.peek, joints)))
            if not step:
                continue
            line = (
                f"the stamps of {topic} come in steps of {step / NANOSECONDS:.3g} s, and "
                "several states of one sender share each: "
            )
            if is_receive:
                recording.notes.append(f"{line}receive times are taken (as with --clock receive)")
                return "receive"
            recording.notes.append(f"{line}the last one stands (--clock receive takes all)")
            return clock
    return clock
