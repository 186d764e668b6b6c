"""What was decided about the numbers of a recording, for the lines that say so."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hpid_ros.base.errors import listed_names
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.quality import MEASURED
from hpid_ros.messages.reading.efforts import EffortContradiction
from hpid_ros.messages.reading.references import Disagreement, Flags, ReferenceCandidate

FOREIGN = 0.05, 0.1, 0.3  # [rad], share of the range, at most: what is farther is no position
UNLIKE = 0.005, 0.05  # [rad] and share of the range: feedback that is farther is another position


def by_up_to(found: Mapping[str, float]) -> str:
    return f"(by up to {max(found.values()):.3g} rad)"


MOST_NAMES = 5


def _farthest(found: Mapping[str, float]) -> str:
    """Return joints and how far their references are apart, at most."""
    return f"{listed_names(list(found), 3)} {by_up_to(found)}"


def _turns_of(joints: Mapping[str, int], kind: str | None) -> str:
    """Return how often each joint jumps by a turn, and what becomes of it."""
    why = "nobody says whether they turn without end" if kind is None else f"they are {kind}"
    counts = ", ".join(f"{joint} {count} times" for joint, count in joints.items())
    return f"{counts} ({why}): the turns are added up, and errors taken to the nearest turn"


class Decisions:
    """What was decided about the numbers of a recording, for the lines that say so."""

    def __init__(self, states: Sequence[str]) -> None:
        self._states = states  # topics
        self._disagreements: dict[tuple[str, str, bool], dict[str, float]] = {}
        self._overruled: dict[tuple[str, str], dict[str, float]] = {}
        self._contradictions: dict[tuple[str, str, bool], dict[str, float]] = {}
        self._numberless: dict[tuple[tuple[str, ...], str], list[str]] = {}
        self._unstamped: dict[str, int] = {}
        self._set_backs: dict[tuple[str, str], None] = {}
        self._ahead: dict[str, tuple[str, int]] = {}
        self._turned: dict[str | None, dict[str, int]] = {}  # turns by joint, by its type
        # the same of references, by their topics, too
        self._turned_references: dict[tuple[str, str | None], dict[str, int]] = {}
        self._unlike: dict[str, dict[str, float]] = {}  # [rad] by joint, by topic of feedback
        self._refused: dict[str, dict[int, str]] = {}  # reasons by place, by topic
        self._foreign: dict[str, list[str]] = {}  # joints by topic whose references are no angles

    def be_foreign(self, topic: str, joint: str) -> None:
        """Note that a report is about something else than the joint's position."""
        self._foreign.setdefault(topic, []).append(joint)

    def differ(self, topic: str, joint: str, largest: float) -> None:
        """Note that a controller reports other positions than the states."""
        self._unlike.setdefault(topic, {})[joint] = largest

    def disagree(self, joint: str, found: Disagreement) -> None:
        """Note that two topics said different things about a joint."""
        key = found.taken, found.left, found.is_mixed
        self._disagreements.setdefault(key, {})[joint] = found.largest

    def overrule(
        self, joint: str, found: ReferenceCandidate, asked: ReferenceCandidate, differ: Flags
    ) -> None:
        """Note that a controller reported something else than it was asked."""
        largest = float(np.abs(found.values - asked.values)[differ].max())
        self._overruled.setdefault((found.topic, asked.topic), {})[joint] = largest

    def note_unstamped(self, topic: str, count: int) -> None:
        """Note messages that are left out, as they alone have no stamp."""
        self._unstamped[topic] = max(count, self._unstamped.get(topic, 0))

    def note_set_back(self, topic: str, at: float, by: float) -> None:
        """Note that the clock of the states was set back, seconds after the first."""
        self._set_backs[topic, f"{by:.3g} s at {at:.3f} s"] = None

    def compares(self, topic: str) -> bool:
        """Return whether the clock of a topic is still to be compared; once is enough."""
        return topic not in self._ahead

    def note_ahead(self, topic: str, states: str, ahead_ns: int) -> None:
        """Note by how much the stamps of a topic are ahead of the states'."""
        self._ahead[topic] = states, ahead_ns

    def _clock_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the stamps that was decided."""
        for topic, count in self._unstamped.items():
            messages = "1 message" if count == 1 else f"{count} messages"
            their, stamps = ("its", "stamp is") if count == 1 else ("their", "stamps are")
            yield (
                f"{messages} on {topic} left out: {their} {stamps} 0, and those of the others are "
                "not"
            )
        for topic, text in self._set_backs:
            yield (
                f"the clock of {topic} was set back by {text}: what follows is shifted by as "
                "much, so that it begins one period later"
            )
        for topic, (states, ahead_ns) in self._ahead.items():
            apart = f"{abs(ahead_ns) / NANOSECONDS:.2g} s"
            if ahead_ns and states:
                how = "later" if ahead_ns > 0 else "earlier"
                yield (
                    f"{topic} is stamped {apart} {how} than {states}, against the times at which "
                    "both were received: their clocks differ, or one is late; --clock receive "
                    "compares by the latter"
                )
            elif ahead_ns:
                yield (
                    f"{topic} is stamped {apart} before it was received, by the stamps of the "
                    "states: their clocks differ, or it came late; it counts from its stamp on"
                )

    def contradict(self, joint: str, found: EffortContradiction) -> None:
        """Note that two topics had unlike efforts of a joint."""
        key = found.taken, found.left, found.is_left_out
        self._contradictions.setdefault(key, {})[joint] = found.largest

    def note_no_numbers(self, joint: str, topics: Sequence[str], instead: str) -> None:
        """Note that the efforts of a joint on some topics are no numbers, and what is taken."""
        self._numberless.setdefault((tuple(topics), instead), []).append(joint)

    def _effort_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the efforts that was decided."""
        for (topics, instead), joints in self._numberless.items():
            taken = f"those of {instead} are taken" if instead else "nothing else has any"
            if instead.startswith(MEASURED):
                taken = f"those that {' and '.join(self._states)} measured are read"
            names = listed_names(joints, MOST_NAMES)
            yield (
                f"the efforts of {names} on {' and '.join(topics)} are not a number throughout: "
                f"{taken}"
            )
        for (taken, left, is_left_out), found in self._contradictions.items():
            names = listed_names(list(found), MOST_NAMES)
            how = f"{left} is left out" if is_left_out else f"{left} counts where that has none"
            yield (
                f"{taken} and {left} have unlike efforts of {names} at the same time (by up to "
                f"{max(found.values()):.3g}): {taken} is taken, {how} (--commands TOPIC or "
                "--command-topic JOINT=TOPIC[INDEX] names one)"
            )

    def refuse(self, topic: str, place: int, reason: str) -> None:
        """Note a trajectory that no controller takes."""
        self._refused.setdefault(topic, {})[place] = reason

    def unwrap(self, joint: str, turns: int, kind: str | None) -> None:
        """Note positions that jumped by a turn though nobody says that the joint turns so."""
        self._turned.setdefault(kind, {})[joint] = turns

    def unwrap_reference(self, topic: str, joint: str, turns: int, kind: str | None) -> None:
        """Note a reference that jumped by a turn where the joint did not."""
        self._turned_references.setdefault((topic, kind), {})[joint] = turns

    def _turn_lines(self) -> Iterator[str]:
        """Yield a line for joints whose positions were unwrapped by what they look like alone."""
        for kind, joints in self._turned.items():
            yield (
                "positions jump by a turn, as of a driver that reports one turn alone: "
                f"{_turns_of(joints, kind)}"
            )
        for (topic, kind), joints in self._turned_references.items():
            yield (
                f"references on {topic} jump by a turn where the positions do not: "
                f"{_turns_of(joints, kind)}"
            )

    def _reference_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the references that was decided."""
        for topic, reasons in self._refused.items():
            those = "1 trajectory" if len(reasons) == 1 else f"{len(reasons)} trajectories"
            first = next(iter(reasons.values()))
            yield f"{those} on {topic} left out, as controllers refuse them: {first}"
        for topic, joints in self._foreign.items():
            yield (
                f"{topic} reports no positions of {', '.join(joints)}: its feedback is something "
                "else than joint_states say: not taken as the reference"
            )
        for topic, unlike in self._unlike.items():
            yield (
                f"{topic} reports other positions of {listed_names(list(unlike), 3)} than "
                f"{' and '.join(self._states)} has {by_up_to(unlike)}: the error is "
                "against the states"
            )
        for (taken, left, is_mixed), found in self._disagreements.items():
            how = "each where the joint follows it" if is_mixed else f"the joint follows {taken}"
            yield f"{taken} and {left} have unlike references of {_farthest(found)}: {how}"
        for (report, asked), found in self._overruled.items():
            yield (
                f"{report} reports another reference than {asked} asks for, of "
                f"{_farthest(found)}: what the controller reports is taken"
            )

    def lines(self) -> Iterator[str]:
        """Yield a line for each thing that was decided."""
        yield from self._clock_lines()
        yield from self._turn_lines()
        yield from self._reference_lines()
        yield from self._effort_lines()
