"""Changes of parameters while a bag was recorded, from ``/parameter_events`` if it is in there."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.message_types import JOINT_STATE
from hpid_ros.bags.parameter_events import ParameterChange, parameter_changes
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import LOOP_PARAMETERS
from hpid_ros.recordings.series import Retune

_HEADER = 12
"""Bytes of an encapsulation header and a stamp."""


def read_retunes(path: Path) -> tuple[Retune, ...]:
    """Return what was set at the controllers of a bag, each with the state before it.

    Parameters that a node declares when it starts are no changes.
    """
    with Storage(path) as bag:
        topics = bag.topics()
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        told = parameter_changes(bag) if states else []
        if not told:
            return ()
        stamps = _stamps_before([each.place for each in told], bag, states[0])
    pairs = zip(told, stamps, strict=True)
    return tuple(
        retune
        for each, stamp_ns in pairs
        if stamp_ns is not None
        for retune in _retunes(each, stamp_ns)
    )


def _untold(share: float) -> None:
    """Take no note of the progress."""


def _stamps_before(places: Sequence[int], bag: Storage, states: str) -> list[int | None]:
    """Return for each place the stamp of the last state before it, None if there is none."""
    stamps: list[int | None] = [None] * len(places)
    last: list[int] = [-1] * len(places)
    for batch in bag.batches(frozenset((states,)), _untold):
        before = np.searchsorted(batch.places, places) - 1
        for number, index in enumerate(before.tolist()):
            if index >= 0 and batch.places[index] > last[number] and batch.sizes[index] >= _HEADER:
                last[number] = int(batch.places[index])
                stamps[number] = _header_stamp_ns(batch.raw(index))
    return stamps


def _header_stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a header: its first eight bytes."""
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _retunes(told: ParameterChange, stamp_ns: int) -> Iterator[Retune]:
    changes = [
        f"{name} = {_shown(value)}"
        for name, value in told.changed.items()
        if name in LOOP_PARAMETERS
    ]
    if changes:
        yield Retune(stamp_ns, told.node, ", ".join(changes))


def _shown(value: Any) -> str:
    if value is None:
        return "unset"
    return f"{value:g}" if isinstance(value, float) else str(value)
