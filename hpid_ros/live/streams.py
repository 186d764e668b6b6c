"""Messages of one joint as samples on its control clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import MessageError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.live.graph import Samples
from hpid_ros.messages.batches import SLACK, Integers
from hpid_ros.messages.columns import LAYOUTS, WORD, Layout, LayoutFamily, Words, gather_words
from hpid_ros.messages.joint_state import ENCAPSULATION

_MOST_FAMILIES = 64  # of layouts; a topic has one or two
_MOST_LEARNED = 64  # layouts in one batch; a robot has fewer joints, and a flood is passed over


class Part(NamedTuple):
    """Messages of one layout."""

    layout: Layout
    rows: Words  # the messages, (n, words)
    order: Integers  # their places among all messages of the batch, (n,), ascending

    def numbers(self, field: str, index: int) -> Numbers | None:
        """Return one number of each message, (n,); None where the field is not one a name."""
        length = self.layout.fields[field].length
        if self.layout.names and length != len(self.layout.names):
            return None
        return self.layout.column(self.rows, field, index) if index < length else None


class MessageColumns:
    """Reads the numbers of a topic's messages; their layouts are learned once.

    What is no message of the type is passed over.
    """

    def __init__(self, type: str) -> None:
        self._learn = LAYOUTS[type]
        self._families: dict[int, list[LayoutFamily]] = {}

    def read(self, raws: Sequence[bytes]) -> list[Part]:
        """Return messages by their layouts, in the order in which they came within each."""
        if not raws:
            return []
        sizes = np.fromiter(map(len, raws), np.int64, len(raws))
        slack = bytes(SLACK)
        buffer = np.frombuffer(b"".join((slack, *raws, slack)), dtype=np.uint8)
        starts = SLACK + np.cumsum(sizes) - sizes
        parts: list[Part] = []
        for size in np.unique(sizes).tolist():
            here = np.flatnonzero(sizes == size)
            words = -(-(size + ENCAPSULATION) // WORD)
            rows = gather_words(buffer, starts[here] - ENCAPSULATION, words)
            parts += self._read_size(raws, rows, here, size)
        return parts

    def _read_size(
        self, raws: Sequence[bytes], rows: Words, here: Integers, size: int
    ) -> Iterator[Part]:
        """Yield messages of one length by their layouts."""
        is_left = np.ones(len(rows), dtype=np.bool_)
        for family in self._families.get(size, ()):
            for layout, claims in family.split(rows):
                claims &= is_left
                yield Part(layout, rows[claims], here[claims])
                is_left &= ~claims
        for _ in range(_MOST_LEARNED):
            if not is_left.any():
                return
            first = int(np.argmax(is_left))
            is_left[first] = False
            learned = self._learned(raws[here[first]], size)
            if learned is not None:
                claims = ((rows & learned.mask) == learned.values).all(axis=1) & is_left
                claims[first] = True
                yield Part(learned, rows[claims], here[claims])
                is_left &= ~claims

    def _learned(self, raw: bytes, size: int) -> Layout | None:
        """Learn a message's layout; None where it is none of the type."""
        try:
            layout = self._learn(raw)
        except MessageError:
            return None
        self._remember(layout, size)
        return layout

    def _remember(self, layout: Layout, size: int) -> None:
        if sum(map(len, self._families.values())) >= _MOST_FAMILIES:
            self._families.clear()
        families = self._families.setdefault(size, [])
        for family in families:
            if family.accepts(layout):
                family.add(layout)
                return
        families.append(LayoutFamily(layout))


class JointNumbers(NamedTuple):
    """One joint's part of some messages, in the order in which they came."""

    stamps_ns: Integers  # [ns] of the messages, (n,)
    position: Numbers  # [rad] (n,); nan where messages have none, as in the others
    velocity: Numbers  # [rad/s] (n,)
    effort: Numbers  # [N m] (n,)

    def picked(self, which: slice | Integers) -> JointNumbers:
        """Return some of them."""
        return JointNumbers(
            self.stamps_ns[which], self.position[which], self.velocity[which], self.effort[which]
        )


def joint_numbers(parts: Sequence[Part], joint: str) -> JointNumbers:
    """Return one joint's numbers out of joint states; of each message the first that names it."""
    found = [part for part in parts if joint in part.layout.names]
    stamps = [part.layout.stamps_ns(part.rows, slice(None)) for part in found]
    columns = [
        [_or_nan(part, field, part.layout.names.index(joint)) for part in found]
        for field in ("position", "velocity", "effort")
    ]
    if not found:
        none = np.zeros(0)
        return JointNumbers(np.zeros(0, dtype=np.int64), none, none, none)
    if len(found) == 1:
        return JointNumbers(stamps[0], *(np.ascontiguousarray(each[0]) for each in columns))
    order = np.argsort(np.concatenate([part.order for part in found]))
    return JointNumbers(
        np.concatenate(stamps)[order], *(np.concatenate(each)[order] for each in columns)
    )


def _or_nan(part: Part, field: str, index: int) -> Numbers:
    numbers = part.numbers(field, index)
    return np.full(len(part.rows), np.nan) if numbers is None else numbers


def bare_numbers(parts: Sequence[Part]) -> Numbers:
    """Return the first number of each message without stamps and names, in their order, (n,)."""
    found = [(part.order, part.numbers("data", 0)) for part in parts]
    known = [(order, numbers) for order, numbers in found if numbers is not None]
    if not known:
        return np.zeros(0)
    order = np.argsort(np.concatenate([order for order, _ in known]))
    numbers: Numbers = np.concatenate([numbers for _, numbers in known])[order]
    return numbers


class ControlClock:
    """Where the control clock of a topic of states began."""

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.epoch = 0

    def begin(self, stamp_ns: int) -> None:
        """Start again with a stamp."""
        self.start_ns = stamp_ns
        self.epoch += 1


class JointClock:
    """The control clock as one joint has seen it.

    Joints of one topic may be told by several publishers, which do not go back at the same time:
    the first one begins the clock again, the others join it when they go back, too.
    """

    def __init__(self, clock: ControlClock) -> None:
        self._clock = clock
        self._start_ns = self._epoch = 0
        self.last_ns: int | None = None

    def take(self, stamps_ns: Integers) -> tuple[int, bool]:
        """Take the stamps of new states."""
        before = stamps_ns[:1] if self.last_ns is None else np.array([self.last_ns])
        back = np.flatnonzero(np.diff(stamps_ns, prepend=before) < 0)
        first = int(back[-1]) if len(back) else 0
        if self.last_ns is None or len(back):
            self._join(int(stamps_ns[first]))
        self.last_ns = int(stamps_ns[-1])
        return first, bool(len(back))

    def _join(self, stamp_ns: int) -> None:
        """Take the topic's clock, and begin it again where nobody else has done so."""
        clock = self._clock
        is_first_back = self.last_ns is not None and clock.epoch == self._epoch
        start_ns = clock.start_ns
        if start_ns is None or is_first_back or stamp_ns < start_ns:
            clock.begin(stamp_ns)
            start_ns = stamp_ns
        self._start_ns, self._epoch = start_ns, clock.epoch

    def seconds(self, stamps_ns: Integers) -> Numbers:
        """Return times since the clock began, in [s]."""
        seconds: Numbers = (stamps_ns - self._start_ns) / float(NANOSECONDS)
        return seconds

    def now(self, stamp_ns: int) -> float:
        """Return one time in [s]."""
        return (stamp_ns - self._start_ns) / NANOSECONDS

    def present(self, stamps_ns: Integers, is_restarted: bool) -> Integers:
        """Return which answers to states are of the present time, as indices."""
        if self.last_ns is None:
            return np.zeros(0, dtype=np.int64)
        if not is_restarted:
            return np.arange(len(stamps_ns))
        within = (stamps_ns >= self._start_ns - _BESIDE) & (stamps_ns <= self.last_ns + _BESIDE)
        back = np.flatnonzero(np.diff(stamps_ns) < -_BESIDE)
        if len(back):
            within[: back[-1] + 1] = False
        return np.flatnonzero(within)


_BESIDE = 1_000_000  # [ns]; an answer may be stamped beside its state, and come before it


class Heard(NamedTuple):
    """What came of one joint, by where it came from."""

    states: JointNumbers
    commands: JointNumbers  # its commands, stamped with the states that they answer
    bare_commands: Numbers  # [N m] its commands where they have no stamps, (n,)
    references: JointNumbers  # what its controller told as its reference


class JointSampler:
    """Makes samples of what comes of one joint."""

    def __init__(self, clock: ControlClock) -> None:
        self.clock = JointClock(clock)
        self._has_commands = False

    def take(self, heard: Heard) -> Samples:
        """Return what came since the last call; what nobody can place in time is left out."""
        stamps = heard.states.stamps_ns
        first, is_restarted = self.clock.take(stamps) if len(stamps) else (0, False)
        states = heard.states.picked(slice(first, None))
        times = self.clock.seconds(states.stamps_ns)
        references = self._answers(heard.references, is_restarted)
        return Samples(
            np.column_stack((times, states.position, states.velocity)),
            self._efforts(heard, states, times, is_restarted),
            np.column_stack(
                (
                    self.clock.seconds(references.stamps_ns),
                    references.position,
                    references.velocity,
                )
            ),
            is_restarted,
        )

    def _answers(self, told: JointNumbers, is_restarted: bool) -> JointNumbers:
        """Return what answers states of the present time."""
        return told.picked(self.clock.present(told.stamps_ns, is_restarted))

    def _efforts(
        self, heard: Heard, states: JointNumbers, times: Numbers, is_restarted: bool
    ) -> Numbers:
        """Return times and efforts: as commanded, or else as measured."""
        bare = heard.bare_commands
        self._has_commands |= bool(len(heard.commands.stamps_ns) or len(bare))
        if len(bare):
            return np.column_stack((self._times_of(len(bare), times), bare))
        if self._has_commands:
            commands = self._answers(heard.commands, is_restarted)
            return np.column_stack((self.clock.seconds(commands.stamps_ns), commands.effort))
        is_told = np.isfinite(states.effort)
        return np.column_stack((times[is_told], states.effort[is_told]))

    def _times_of(self, count: int, times: Numbers) -> Numbers:
        """Return times of so many commands without stamps: the newest answers the newest state."""
        if not len(times):
            last_ns = self.clock.last_ns
            return np.full(count, np.nan if last_ns is None else self.clock.now(last_ns))
        return times[np.clip(np.arange(len(times) - count, len(times)), 0, None)]
