"""Runs of unlike length, cut to the time that all of them have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hpid_ros.analysis.conditions import DURATION_WITHIN
from hpid_ros.analysis.results import RunIndices

SHORTEST = 0.1
"""Shorter common times, in [s], say nothing of whole motions: runs are left as they are."""


class Cut(NamedTuple):
    """The part of a recording that is common to all.

    Attributes:
        start: Its begin, in [s] since the first state of any joint.
        end: Its end, likewise.
        text: The same in words; empty where it is the whole recording.
    """

    start: float
    end: float
    text: str


def common_cuts(runs: Sequence[RunIndices]) -> tuple[Cut, ...]:
    """Return the part of each recording to compare; nothing if the whole ones can be.

    Recordings are laid beside each other where their references begin, as recorders are started
    by hand; where one has none, at their first states.

    Args:
        runs: The numbers of whole recordings.
    """
    conditions = [run.conditions for run in runs]
    known = [each for each in conditions if each is not None]
    if len(known) < len(runs) or len(runs) < 2:
        return ()
    durations = [each.duration for each in known]
    begins = [each.reference_from for each in known]
    has_references = all(begin is not None for begin in begins)
    starts = [begin or 0.0 for begin in begins] if has_references else [0.0] * len(runs)
    room = min(duration - start for duration, start in zip(durations, starts, strict=True))
    within = DURATION_WITHIN * max(durations)
    if max(durations) - min(durations) <= within and max(starts) - min(starts) <= within:
        return ()
    if room < SHORTEST:
        return ()
    where = "its reference begins" if has_references else "its states do"
    return tuple(
        Cut(
            start,
            start + room,
            ""
            if duration - room <= DURATION_WITHIN * room
            else f"cut to {room:.4g} s of {duration:.4g} s, from {start:.4g} s on, where {where}",
        )
        for start, duration in zip(starts, durations, strict=True)
    )
