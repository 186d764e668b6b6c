"""Changes of parameters that a bag holds: ``/parameter_events``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.base.errors import MessageError
from hpid_ros.wire.parameter_events import ParameterEvent, decode_parameter_event

PARAMETER_EVENTS = "rcl_interfaces/msg/ParameterEvent"


class ParameterChange(NamedTuple):
    """What one node told of its parameters at once."""

    place: int  # place of the message in the log
    log_time_ns: int  # [ns] when it was recorded
    node: str  # full name of the node
    declared: Mapping[str, Any]  # values of parameters that it declared, by name
    changed: Mapping[str, Any]  # values that were set later


def parameter_changes(bag: Storage) -> list[ParameterChange]:
    """Return what all nodes of a bag told of their parameters, in the order of the log."""
    topics = bag.topics()
    names = frozenset(name for name, each in topics.items() if each.type == PARAMETER_EVENTS)
    return sorted(_changes(bag, names), key=lambda each: each.place) if names else []


def _changes(bag: Storage, names: frozenset[str]) -> Iterator[ParameterChange]:
    for batch in bag.batches(names, lambda share: None):
        for index in range(len(batch.starts)):
            told = read_event(batch.raw(index))
            if told is not None:
                place, log_time_ns = int(batch.places[index]), int(batch.log_times_ns[index])
                yield ParameterChange(place, log_time_ns, *told)


def read_event(raw: bytes) -> ParameterEvent | None:
    """Return what one serialised message tells; None for bytes that are none."""
    try:
        return decode_parameter_event(raw)
    except MessageError:
        return None
