"""Changes of parameters that a bag holds: ``/parameter_events``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.message_types import jazzy_types

PARAMETER_EVENTS = "rcl_interfaces/msg/ParameterEvent"
_FIELDS = (
    *("", "bool_value", "integer_value", "double_value", "string_value"),
    *("byte_array_value", "bool_array_value", "integer_array_value", "double_array_value"),
    "string_array_value",
)
"""Fields of a ParameterValue by its type."""


class ParameterChange(NamedTuple):
    """What one node told of its parameters at once.

    Attributes:
        place: Place of the message in the log.
        log_time_ns: When it was recorded, in [ns].
        node: Full name of the node.
        declared: Values of parameters that it declared, by name.
        changed: Values that were set later.
    """

    place: int
    log_time_ns: int
    node: str
    declared: Mapping[str, Any]
    changed: Mapping[str, Any]


def parameter_changes(bag: Storage) -> list[ParameterChange]:
    """Return what all nodes of a bag told of their parameters, in the order of the log.

    Args:
        bag: The bag. A message that is none is left out.

    Raises:
        BagError: The bag cannot be read.
    """
    topics = bag.topics()
    names = frozenset(name for name, each in topics.items() if each.type == PARAMETER_EVENTS)
    return sorted(_changes(bag, names), key=lambda each: each.place) if names else []


def _changes(bag: Storage, names: frozenset[str]) -> Iterator[ParameterChange]:
    read = event_reader()
    for batch in bag.batches(names, lambda share: None):
        for index in range(len(batch.starts)):
            told = read(batch.raw(index))
            if told is not None:
                place, log_time_ns = int(batch.places[index]), int(batch.log_times_ns[index])
                yield ParameterChange(place, log_time_ns, *told)


Told = tuple[str, Mapping[str, Any], Mapping[str, Any]]
"""A node, what it declared, and what was set."""


def event_reader() -> Callable[[bytes], Told | None]:
    """Return what reads one serialised message; it gives None for bytes that are none."""
    types = jazzy_types()

    def read(raw: bytes) -> Told | None:
        try:
            event: Any = types.deserialize_cdr(raw, PARAMETER_EVENTS)
        except Exception:  # whatever rosbags' generated code trips over
            return None
        return str(event.node), _values(event.new_parameters), _values(event.changed_parameters)

    return read


def _values(parameters: Any) -> dict[str, Any]:
    return {each.name: _value(each.value) for each in parameters}


def _value(value: Any) -> Any:
    field = _FIELDS[value.type] if value.type < len(_FIELDS) else ""
    content: Any = getattr(value, field) if field else None
    return content.tolist() if isinstance(content, np.ndarray) else content
