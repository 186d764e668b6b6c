"""Changes of parameters while a bag was recorded, from ``/parameter_events`` if it is in there."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.message_types import JOINT_STATE, jazzy_types
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import LOOP_PARAMETERS
from hpid_ros.recordings.series import Retune

PARAMETER_EVENTS = "rcl_interfaces/msg/ParameterEvent"
_FIELDS = (
    *("", "bool_value", "integer_value", "double_value", "string_value"),
    *("byte_array_value", "bool_array_value", "integer_array_value", "double_array_value"),
    "string_array_value",
)
"""Fields of a ParameterValue by its type."""
_HEADER = 12
"""Bytes of an encapsulation header and a stamp."""


def read_retunes(path: Path) -> tuple[Retune, ...]:
    """Return what was set at the controllers of a bag, each with the state before it.

    Parameters that a node declares when it starts are no changes.

    Args:
        path: The bag.

    Raises:
        BagError: The bag cannot be read.
    """
    with Storage(path) as bag:
        topics = bag.topics()
        events = [name for name, topic in topics.items() if topic.type == PARAMETER_EVENTS]
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        if not events or not states:
            return ()
        told = [
            (int(batch.places[k]), batch.raw(k))
            for batch in bag.batches(frozenset(events), _untold)
            for k in range(len(batch.starts))
        ]
        if not told:
            return ()
        told.sort()
        stamps = _stamps_before([place for place, _ in told], bag, states[0])
    pairs = zip(told, stamps, strict=True)
    return tuple(
        retune
        for (_, raw), stamp_ns in pairs
        if stamp_ns is not None
        for retune in _retunes(raw, stamp_ns)
    )


def _untold(share: float) -> None:
    """Tell nobody how much was read."""


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


def _retunes(raw: bytes, stamp_ns: int) -> Iterator[Retune]:
    try:
        event: Any = jazzy_types().deserialize_cdr(raw, PARAMETER_EVENTS)
    except Exception:  # whatever rosbags' generated code trips over: no event, no mark in a figure
        return
    changes = [
        f"{parameter.name} = {_value(parameter.value)}"
        for parameter in event.changed_parameters
        if parameter.name in LOOP_PARAMETERS
    ]
    if changes:
        yield Retune(stamp_ns, str(event.node), ", ".join(changes))


def _value(value: Any) -> str:
    field = _FIELDS[value.type] if value.type < len(_FIELDS) else ""
    content = getattr(value, field) if field else "unset"
    return f"{content:g}" if isinstance(content, float) else str(content)
