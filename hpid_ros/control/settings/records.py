"""Records of parameters: frozen dataclasses whose fields hold parameters of the tables.

A set of parameters by dotted name and a record of records are one thing in two shapes; the
functions here turn one into the other without knowing a single parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar, cast, get_type_hints

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.control.settings.table import PARAMETERS, ParameterSpec, Value

_KEY = "parameter"

AnyRecord = TypeVar("AnyRecord")


def parameter(name: str) -> Any:
    """Declare the field of a record that holds a parameter; its default is the table's."""
    return field(default=PARAMETERS[name].default, metadata={_KEY: name})


class ParameterRecord:
    """A frozen dataclass whose fields are declared by :func:`parameter`, or are records."""

    def __post_init__(self) -> None:
        for name, spec in _layout(cast(Any, type(self))).leaves:
            value = getattr(self, name)
            checked = spec.checked(value)
            if checked is not value:  # a whole number becomes a float
                object.__setattr__(self, name, checked)


def from_values(kind: type[AnyRecord], values: Mapping[str, object]) -> AnyRecord:
    """Return the record that holds a set of parameters."""
    return cast(AnyRecord, _assembled(_layout(cast(Any, kind)), values))


def to_values(record: object) -> dict[str, Value]:
    """Return the parameters that a record holds, by dotted name, in the order of the tables."""
    return {name: get(record) for name, get in _getters(cast(Any, type(record)))}


def with_values(record: AnyRecord, changes: Mapping[str, object]) -> AnyRecord:
    """Return a record with some of its parameters changed, checked again."""
    paths = _paths(cast(Any, type(record)))
    for name in changes:
        if name not in paths:
            raise SettingError(unknown_name("parameter", name, paths))
    return _replaced(record, [(paths[name], value) for name, value in changes.items()])


_Path = tuple[str, ...]  # names of fields, from a record to a value


class _Layout(NamedTuple):
    """The fields of a record."""

    kind: type  # the record
    is_checking: bool  # whether it checks its parameters itself
    # its fields that hold a parameter, and the parameter
    leaves: tuple[tuple[str, ParameterSpec], ...]
    groups: tuple[tuple[str, _Layout], ...]  # its fields that hold records, and their layout

    def paths(self) -> Iterator[tuple[str, _Path]]:
        """Yield each parameter and where it is."""
        yield from ((spec.name, (own,)) for own, spec in self.leaves)
        for group, layout in self.groups:
            yield from ((name, (group, *path)) for name, path in layout.paths())


@cache
def _layout(kind: type, group: str = "") -> _Layout:
    """Return the layout of a record; a field that names no parameter holds its namesake."""
    prefix = f"{group}." if group else ""
    hints = get_type_hints(kind)
    leaves, groups = [], []
    for each in fields(cast(Any, kind)):
        if is_dataclass(hints[each.name]):
            groups.append((each.name, _layout(hints[each.name], each.name)))
        else:
            name = each.metadata.get(_KEY, f"{prefix}{each.name}")
            leaves.append((each.name, PARAMETERS[name]))
    return _Layout(kind, issubclass(kind, ParameterRecord), tuple(leaves), tuple(groups))


@cache
def _paths(kind: type) -> Mapping[str, _Path]:
    """Return where a record holds each of its parameters, in the order of the tables."""
    found = dict(_layout(kind).paths())
    return {name: found[name] for name in PARAMETERS if name in found}


@cache
def _getters(kind: type) -> Sequence[tuple[str, Callable[[object], Value]]]:
    return [(name, attrgetter(".".join(path))) for name, path in _paths(kind).items()]


def _assembled(layout: _Layout, values: Mapping[str, object]) -> object:
    arguments: dict[str, object] = {
        own: values.get(spec.name, spec.default) for own, spec in layout.leaves
    }
    if not layout.is_checking:
        arguments = {own: spec.checked(arguments[own]) for own, spec in layout.leaves}
    for group, inner in layout.groups:
        arguments[group] = _assembled(inner, values)
    return layout.kind(**arguments)


def _replaced(record: AnyRecord, changes: Sequence[tuple[_Path, object]]) -> AnyRecord:
    own = {path[0]: value for path, value in changes if len(path) == 1}
    for group in {path[0] for path, _ in changes if len(path) > 1}:
        within = [(path[1:], value) for path, value in changes if path[0] == group]
        own[group] = _replaced(getattr(record, group), within)
    return cast(AnyRecord, replace(cast(Any, record), **own))
