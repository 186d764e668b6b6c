"""Changes of parameters while a bag was recorded, from ``/parameter_events`` if it is in there."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hpid_ros.analysis.series import Retune
from hpid_ros.bags import BagReader
from hpid_ros.bags.message_types import JOINT_STATE, jazzy_types
from hpid_ros.control import LOOP_PARAMETERS

PARAMETER_EVENTS = "rcl_interfaces/msg/ParameterEvent"
_FIELDS = (
    *("", "bool_value", "integer_value", "double_value", "string_value"),
    *("byte_array_value", "bool_array_value", "integer_array_value", "double_array_value"),
    "string_array_value",
)
"""Fields of a ParameterValue by its type."""


def read_retunes(path: Path) -> tuple[Retune, ...]:
    """Return what was set at the controllers of a bag, each with the state before it.

    Parameters that a node declares when it starts are no changes.

    Args:
        path: The bag.

    Raises:
        BagError: The bag cannot be read.
    """
    with BagReader(path) as bag:
        topics = bag.topics
        events = [name for name, topic in topics.items() if topic.type == PARAMETER_EVENTS]
        states = [name for name, topic in topics.items() if topic.type == JOINT_STATE]
        states = [name for name in states if name.endswith("joint_states")]
        if not events or not states or not any(topics[name].message_count for name in events):
            return ()
        stamp_ns: int | None = None
        found: list[Retune] = []
        for message in bag.messages(*events, states[0]):
            if message.topic == states[0]:
                stamp_ns = _header_stamp_ns(message.raw)
            elif stamp_ns is not None:
                found.extend(_retunes(message.raw, stamp_ns))
    return tuple(found)


def _header_stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a header: its first eight bytes."""
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _retunes(raw: bytes, stamp_ns: int) -> Iterator[Retune]:
    event: Any = jazzy_types().deserialize_cdr(raw, PARAMETER_EVENTS)
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
