"""Codec of what nodes tell of themselves: texts and changes of their parameters.

Source: ``std_msgs/msg/String``, ``rcl_interfaces/msg/ParameterEvent``, ``ParameterValue`` and
``ParameterType``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from hpid_ros.base.errors import MessageError
from hpid_ros.wire.cdr import Cursor

ParameterContent = bool | int | float | str | list[int] | list[bool] | list[float] | list[str]

_EVENT = "ParameterEvent"
_LEAST_PARAMETER = 4 + 1
"""Bytes of a name's length and a type."""


class ParameterEvent(NamedTuple):
    """What one node told of its parameters at once."""

    node: str  # its full name
    declared: Mapping[str, ParameterContent | None]  # values of parameters that are new, by name
    changed: Mapping[str, ParameterContent | None]  # values that were set later


def decode_text(raw: bytes) -> str:
    """Return the text of a serialised ``std_msgs/msg/String``."""
    return Cursor(raw, "String").string()


def decode_parameter_event(raw: bytes) -> ParameterEvent:
    """Return what a serialised ``rcl_interfaces/msg/ParameterEvent`` tells."""
    cursor = Cursor(raw, _EVENT)
    cursor.scalar("i")
    cursor.scalar("I")  # the stamp is that of the sender's clock
    node = cursor.string()
    return ParameterEvent(node, _parameters(cursor, len(raw)), _parameters(cursor, len(raw)))


def _parameters(cursor: Cursor, size: int) -> dict[str, ParameterContent | None]:
    count = cursor.scalar("I")
    if count * _LEAST_PARAMETER > size:
        raise MessageError(f"a {_EVENT} of {size} bytes cannot hold {count} parameters")
    return dict(_parameter(cursor) for _ in range(count))


def _parameter(cursor: Cursor) -> tuple[str, ParameterContent | None]:
    """Read a parameter: all fields are there, and its type says which one counts."""
    name, kind = cursor.string(), cursor.scalar("B")
    values = [read(cursor) for read in _FIELDS]
    return name, values[kind - 1] if 1 <= kind <= len(values) else None


_FIELDS: tuple[Callable[[Cursor], ParameterContent], ...] = (
    lambda cursor: bool(cursor.scalar("B")),
    lambda cursor: cursor.scalar("q"),
    lambda cursor: cursor.double(),
    lambda cursor: cursor.string(),
    lambda cursor: list(cursor.integers("B")),
    lambda cursor: [bool(each) for each in cursor.integers("B")],
    lambda cursor: list(cursor.integers("q")),
    lambda cursor: list(cursor.doubles()),
    lambda cursor: list(cursor.strings()),
)
"""Fields of a ParameterValue, in the order of its types from 1 on."""
