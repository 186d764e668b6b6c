"""Records: values that belong together, each declared once in a frozen dataclass.

A field declares its meaning, unit, range and default. From that come the checks of a record that
is made in Python, the reading of a section of a file, the parameters of a node, and in
:mod:`.schema` the JSON Schema with which editors complete and check files, and the tables of the
documentation.

A library would be the better choice, were there one: of those that do all this, pydantic has
another interface on PyPI than in the Ubuntu of Jazzy, and msgspec and cattrs have no rosdep key.
"""

from __future__ import annotations

import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import cache
from operator import attrgetter
from typing import (
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from hpid_ros.base.errors import HpidError, SettingError, unknown_name

_MISSING: Any = object()


class Bounds(NamedTuple):
    """The range of a number; each bound is off where it is infinite."""

    above: float = -math.inf  # it must be greater than this
    least: float = -math.inf  # it must not be less than this
    most: float = math.inf  # it must not be greater than this
    below: float = math.inf  # it must be less than this

    def hold(self, value: float) -> bool:
        """Return whether a number is within them, and finite."""
        try:
            is_finite = math.isfinite(value)
        except OverflowError:  # of a whole number beyond every double
            return False
        is_low = self.above < value and self.least <= value
        return is_finite and is_low and value <= self.most and value < self.below

    def __str__(self) -> str:
        words = [
            f"{word} {bound:g}"
            for word, bound in zip(("above", "at least", "at most", "below"), self, strict=True)
            if math.isfinite(bound)
        ]
        return " and ".join(words) or "finite"

    @property
    def rule(self) -> str:
        """What follows "must" in a message."""
        if math.isfinite(self.least + self.most):
            return f"lie in [{self.least:g}, {self.most:g}]"
        return f"be {self}"

    def schema(self) -> dict[str, float]:
        words = ("exclusiveMinimum", "minimum", "maximum", "exclusiveMaximum")
        pairs = zip(words, self, strict=True)
        return {word: bound for word, bound in pairs if math.isfinite(bound)}


ANY = Bounds()
"""Every finite number."""


class Section:
    """A mapping whose entries are taken one by one; what is left over is unknown."""

    def __init__(self, values: object, where: str, error: type[HpidError]) -> None:
        self.error = error
        self.where = where
        if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
            raise error(f"{where or 'the document'} must be a mapping, not {short_repr(values)}")
        self._values = dict(values)
        self._taken: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def place(self, key: str) -> str:
        return f"{self.where}.{key}" if self.where else key

    def take(self, key: str, default: Any = _MISSING) -> Any:
        """Return an entry as it stands."""
        self._taken.add(key)
        if key in self._values:
            return self._values[key]
        if default is _MISSING:
            raise self.error(f"{self.place(key)} is missing")
        return default

    def number(self, key: str, default: Any = _MISSING, **bounds: float) -> float:
        """Return a finite number; for its bounds see :class:`Bounds`."""
        return _number(self.take(key, default), Bounds(**bounds), self.place(key), self.error)

    def whole(self, key: str, default: Any = _MISSING, **bounds: float) -> int:
        """Return a whole number; for its bounds see :class:`Bounds`."""
        return _whole(self.take(key, default), Bounds(**bounds), self.place(key), self.error)

    def text(self, key: str, default: Any = _MISSING) -> str:
        """Return a text that is not empty."""
        return _text(self.take(key, default), self.place(key), self.error)

    def section(self, key: str, default: Any = _MISSING) -> Section:
        return Section(self.take(key, default), self.place(key), self.error)

    @property
    def values(self) -> dict[str, Any]:
        """All entries as they stand; none is taken."""
        return dict(self._values)

    def items(self) -> dict[str, Any]:
        """Return all entries as they stand; all are taken."""
        self._taken.update(self._values)
        return dict(self._values)

    def finish(self) -> None:
        """Refuse what nobody took."""
        for key in self._values:
            if key not in self._taken:
                raise self.error(
                    unknown_name("key", self.place(key), map(self.place, self._taken))
                )


def _number(value: Any, bounds: Bounds, place: str, error: type[HpidError]) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        better = _dotted(value)
        hint = f": to YAML 1.1 that is a text, write {better}" if better else ""
        raise error(f"{place} must be a number, not {short_repr(value)}{hint}")
    if not bounds.hold(value):
        raise error(f"{place} must {bounds.rule}, not {value}")
    return float(value)


def _dotted(value: object) -> str:
    """Return a number that YAML 1.1 takes for a text, as ``4e-7``, so that it is one; else ""."""
    found = re.fullmatch(r"([-+]?\d[\d_]*)(\.\d*)?[eE]([-+]?)(\d+)", str(value).strip())
    if not isinstance(value, str) or found is None:
        return ""
    whole, fraction, sign, exponent = found.groups()
    return f"{whole}{fraction or '.0'}e{sign or '+'}{exponent}"


_LARGEST_WHOLE = 2**62


def _whole(value: Any, bounds: Bounds, place: str, error: type[HpidError]) -> int:
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if not (is_whole and bounds.hold(value) and value <= _LARGEST_WHOLE):
        range_ = "" if bounds == ANY else f", {bounds}"
        raise error(f"{place} must be a whole number{range_}, not {short_repr(value)}")
    return int(value)


def _text(
    value: Any,
    place: str,
    error: type[HpidError],
    choices: Sequence[str] = (),
    *,
    may_be_empty: bool = False,
) -> str:
    is_text = isinstance(value, str) and bool(value or may_be_empty)
    if not is_text or (choices and value not in choices):
        allowed = f"one of {', '.join(choices)}" if choices else "a text"
        raise error(f"{place} must be {allowed}, not {short_repr(value)}")
    return cast(str, value)


def short_repr(value: object) -> str:
    """Return a value for a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


_KEY = "quantity"
OFF = False
"""What YAML makes of ``off``: a part that is left out although something else names it."""


@dataclass(frozen=True)
class FieldSpec:
    """What a field is."""

    meaning: str  # in words, without a full stop
    unit: str = ""  # for instance "N m"; empty for what has none
    bounds: Bounds = ANY  # of a number, or of each number of a list
    choices: tuple[str, ...] = ()  # of a text; any if empty
    key: str = ""  # its name in a file, where that is no name in Python
    # whether a file has a mapping by name, whose keys are the name of each record
    names: bool = False
    # the ends of a slider in a parameter client, each of them allowed and sensible
    slider: tuple[float, float] | None = None

    @property
    def description(self) -> str:
        """The meaning, with the unit in brackets."""
        return f"{self.meaning} [{self.unit}]" if self.unit else self.meaning


def quantity(
    meaning: str,
    unit: str = "",
    *,
    default: Any = MISSING,
    factory: Any = MISSING,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
    choices: Sequence[str] = (),
    key: str = "",
    names: bool = False,
    slider: tuple[float, float] | None = None,
) -> Any:
    """Declare a field of a :class:`Record`; see :class:`FieldSpec` and :class:`.Bounds`."""
    bounds = Bounds(above, least, most, below)
    metadata = {_KEY: FieldSpec(meaning, unit, bounds, tuple(choices), key, names, slider)}
    return field(default=default, default_factory=factory, metadata=metadata)


def group(kind: Any) -> Any:
    """Declare a field that holds some of a record's parameters, a record itself."""
    return field(default_factory=kind, metadata={_KEY: FieldSpec("")})


class Record:
    """A frozen dataclass all of whose fields are declared by :func:`quantity`.

    A field is a bool, a number, a text, one of some texts (``Literal``), another record, a tuple
    of such (``tuple[float, float, float]``, ``tuple[Brick, ...]``), a mapping by name, a union of
    a number and a mapping, or one of these or None. Values become what their field is declared to
    be.
    """

    _prefix = ""

    def __init_subclass__(cls, prefix: str = "", **options: Any) -> None:
        """Note what the names of the parameters begin with, for instance ``norm.``."""
        super().__init_subclass__(**options)
        cls._prefix = prefix

    def __post_init__(self) -> None:
        for each in record_fields(type(self)):
            value = getattr(self, each.path)
            if value is not None or not each.is_optional:
                object.__setattr__(self, each.path, each.checked(value))


AnyRecord = TypeVar("AnyRecord", bound=Record)


@dataclass(frozen=True, kw_only=True)
class ParameterSpec(FieldSpec):
    """A field of a record, or of a group in it, under a name of its own."""

    name: str  # in a file, and in ROS
    path: str  # of the attribute, from the record
    kind: Any  # its type, None aside
    is_optional: bool  # whether it may be None
    is_needed: bool  # whether it has no default
    declared: Field[Any]  # the dataclass's own entry

    @property
    def default(self) -> Any:
        """Its default; None where it has none."""
        if self.declared.default_factory is not MISSING:
            return self.declared.default_factory()
        return None if self.declared.default is MISSING else self.declared.default

    @property
    def minimum(self) -> float:
        """Least allowed number; -inf where there is none."""
        return self.bounds.least

    @property
    def maximum(self) -> float:
        """Largest allowed number; inf where there is none."""
        return self.bounds.most

    def checked(self, value: object) -> Any:
        """Return the value in the parameter's type."""
        if value is None and self.is_optional:
            return None
        return self.converted(value, self.name, SettingError)

    def converted(self, value: object, place: str, error: type[HpidError]) -> Any:
        """Return a value as it is declared; a text may be empty if its default is."""
        may_be_empty = self.kind is str and self.declared.default == ""
        return _as(self.kind, value, self, place, error, may_be_empty=may_be_empty)


def record_fields(kind: type[Record]) -> tuple[ParameterSpec, ...]:
    found: tuple[ParameterSpec, ...] = _fields_of(cast(Any, kind))
    return found


@cache
def _fields_of(kind: Any) -> tuple[ParameterSpec, ...]:
    hints = get_type_hints(kind)
    found = []
    for each in fields(kind):
        what = dict(vars(each.metadata[_KEY]))
        inner, is_optional = _without_none(hints[each.name])
        if get_origin(inner) is Literal:
            what["choices"], inner = get_args(inner), str
        spec = ParameterSpec(
            **what,
            name=what["key"] or f"{kind._prefix}{each.name}",
            path=each.name,
            kind=inner,
            is_optional=is_optional,
            is_needed=each.default is MISSING and each.default_factory is MISSING,
            declared=each,
        )
        found.append(spec)
    return tuple(found)


def is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Record)


def container_of(kind: Any) -> Any:
    """Return ``tuple`` for lists, ``Mapping`` for mappings by name; None for a single value."""
    origin = get_origin(kind)
    return Mapping if isinstance(origin, type) and issubclass(origin, Mapping) else origin


def from_mapping(
    kind: type[AnyRecord], values: object, where: str, error: type[HpidError]
) -> AnyRecord:
    """Return the record that a section of a file says."""
    section = Section(values, where, error)
    record = take_record(kind, section)
    section.finish()
    return record


def take_record(
    kind: type[AnyRecord], section: Section, known: Mapping[str, object] | None = None
) -> AnyRecord:
    """Return the record that a section says; what else the section says stays for the caller."""
    values = dict(known or {})
    asked = [each for each in record_fields(kind) if each.path not in values]
    for each in asked:
        section.take(each.name, None)
    for each in asked:
        if each.name not in section and not each.is_needed:
            continue
        value = section.take(each.name)
        if value is OFF and each.is_optional and is_record(each.kind):
            values[each.path] = None
        else:
            values[each.path] = each.converted(value, section.place(each.name), section.error)
    try:
        return kind(**values)
    except section.error:
        raise
    except HpidError as error:
        raise section.error(f"{section.where}: {error}" if section.where else str(error)) from None


def take_layered(
    kind: type[AnyRecord], section: Section, names: Sequence[str], what: str = "joint"
) -> tuple[AnyRecord, ...]:
    """Return a record for each name: what a section says of all, but for what it says of one.

    Entries of the section hold for all; those of its ``joints`` for one, key by key also within
    a record; ``off`` leaves a record out. What else the section says stays for the caller.
    """
    own = section.section(f"{what}s", {})
    for name in own.items():
        if name not in names:
            raise section.error(f"{own.where}: {unknown_name(what, name, names)}")
    for each in record_fields(kind):
        section.take(each.name, None)
    records = []
    for name in names:
        layer = own.section(name, {})
        values = {}
        for each in record_fields(kind):
            value, common = layer.take(each.name, None), section.take(each.name, None)
            source = layer if each.name in layer else section
            if each.name not in source:
                continue
            if source is section:
                value = common
            elif isinstance(value, Mapping) and isinstance(common, Mapping):
                value = {**common, **value}
            if not (value is OFF and is_record(each.kind)):
                place = source.place(each.name)
                values[each.path] = each.converted(value, place, section.error)
        layer.finish()
        where = layer.where if name in own else section.where
        records.append(take_record(kind, Section({}, where, section.error), values))
    return tuple(records)


def parameters_of(kind: type[Record]) -> Mapping[str, ParameterSpec]:
    """Return the parameters of a record by name, those of its groups too, in their order."""
    return _parameters(cast(Any, kind))


def names_of(*kinds: type[Record]) -> list[str]:
    """Return the names of the parameters of some records."""
    return [name for kind in kinds for name in parameters_of(kind)]


@cache
def _parameters(kind: Any) -> Mapping[str, ParameterSpec]:
    found = {}
    for each in record_fields(kind):
        if is_record(each.kind):
            for name, spec in parameters_of(each.kind).items():
                found[name] = replace(spec, path=f"{each.path}.{spec.path}")
        else:
            found[each.name] = each
    return found


def to_parameters(record: Record) -> dict[str, Any]:
    """Return the values of a record's parameters by name."""
    return {name: get(record) for name, get in _getters(cast(Any, type(record)))}


@cache
def _getters(kind: Any) -> Sequence[tuple[str, Any]]:
    return [(name, attrgetter(spec.path)) for name, spec in parameters_of(kind).items()]


def from_parameters(kind: type[AnyRecord], values: Mapping[str, object]) -> AnyRecord:
    """Return the record with these values of its parameters; what is left out has its default."""
    known = parameters_of(kind)
    for name in values:
        if name not in known:
            raise SettingError(unknown_name("parameter", name, known))
    return cast(AnyRecord, _assembled(kind, values))


def _assembled(kind: Any, values: Mapping[str, object]) -> Any:
    arguments = {}
    for each in record_fields(kind):
        if is_record(each.kind):
            arguments[each.path] = _assembled(each.kind, values)
        elif each.name in values:
            arguments[each.path] = each.checked(values[each.name])
    return kind(**arguments)


def _without_none(hint: Any) -> tuple[Any, bool]:
    """Return a type without None, and whether None was one of its choices."""
    if get_origin(hint) not in (Union, types.UnionType):
        return hint, False
    rest = tuple(each for each in get_args(hint) if each is not types.NoneType)
    return (rest[0] if len(rest) == 1 else Union[rest]), len(rest) < len(get_args(hint))  # noqa: UP007


def _as(
    kind: Any,
    value: Any,
    what: FieldSpec,
    place: str,
    error: type[HpidError],
    *,
    may_be_empty: bool = False,
) -> Any:
    if kind is object or (is_record(kind) and isinstance(value, kind)):
        return value
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _as(_chosen(get_args(kind), value), value, what, place, error)
    if origin is tuple:
        return _list(get_args(kind), value, what, place, error)
    if container_of(kind) is Mapping:
        section = Section(value, place, error)
        inner = get_args(kind)[1]
        return {
            name: _as(inner, each, what, section.place(name), error)
            for name, each in section.items().items()
        }
    if is_record(kind):
        return from_mapping(kind, value, place, error)
    if kind is bool:
        if not isinstance(value, bool):
            raise error(f"{place} must be true or false, not {short_repr(value)}")
        return value
    if kind is int:
        return _whole(value, what.bounds, place, error)
    if kind is float:
        return _number(value, what.bounds, place, error)
    return _text(value, place, error, what.choices, may_be_empty=may_be_empty)


def _chosen(kinds: tuple[Any, ...], value: Any) -> Any:
    """Return which of a union's types is meant: the mapping, the list, or what is neither."""
    is_mapping, is_list = isinstance(value, Mapping), isinstance(value, list | tuple)
    meant = Mapping if is_mapping else tuple if is_list else None
    containers = {container_of(each): each for each in kinds}
    return containers.get(meant, containers[None])


def _list(
    kinds: tuple[Any, ...], value: Any, what: FieldSpec, place: str, error: type[HpidError]
) -> tuple[Any, ...]:
    if what.names and isinstance(value, Mapping):
        section = Section(value, place, error)
        found = []
        for name in section.items():
            inner = section.section(name)
            found.append(take_record(kinds[0], inner, {"name": name}))
            inner.finish()
        return tuple(found)
    is_list = isinstance(value, list | tuple)
    if kinds[-1] is not Ellipsis:
        if not is_list or len(value) != len(kinds):
            unit = f" [{what.unit}]" if what.unit else ""
            raise error(
                f"{place} must be {_COUNTS[len(kinds)]} numbers{unit}, not {short_repr(value)}"
            )
    elif not is_list:
        raise error(f"{place} must be a list, not {short_repr(value)}")
    return tuple(
        _as(kinds[0], each, what, f"{place}[{index}]", error) for index, each in enumerate(value)
    )


_COUNTS = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}
