"""A joint's loop in C99: header, source, golden vectors and the program that replays them."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hpid_ros import __version__
from hpid_ros.base.errors import SettingError
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings.groups import LEAST_WRAP
from hpid_ros.control.settings.table import LARGEST_MOTION, Value
from hpid_ros.export.golden import golden_vectors
from hpid_ros.export.parameters import FIELDS, Field, exported_values, in_single

Precision = Literal["double", "single"]
"""Of the floating-point numbers, where the macro of the header does not say another."""

_FILES = {"loop.h": ".h", "loop.c": ".c", "golden.h": "_golden.h", "test.c": "_test.c"}
_WIDTH = 80  # columns
_LONGEST_NAME = 60  # characters of a text that somebody else wrote


def c_name(joint: str) -> str:
    """Return what a joint's files and identifiers begin with in C."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", joint).strip("_")
    if not name:
        raise SettingError(
            f"joint {joint!r} cannot have a name in C: it has none of A-Z, a-z and 0-9"
        )
    return f"hpid_{name}"


def file_names(joint: str) -> tuple[str, ...]:
    """Return the names of a joint's files, the header first."""
    return tuple(f"{c_name(joint)}{suffix}" for suffix in _FILES.values())


def require_distinct(joints: Sequence[str]) -> None:
    """Refuse joints that would have the same names in C, or in a folder that ignores case."""
    owners: dict[str, str] = {}
    for joint in joints:
        for name in (c_name(joint), *file_names(joint)):
            other = owners.setdefault(name.casefold(), joint)
            if other is not joint:
                raise SettingError(
                    f"joints {other!r} and {joint!r} would both be {name} in C: name one of them "
                    "with --joint"
                )


def c_files(settings: LoopSettings, precision: Precision, source: str) -> dict[str, str]:
    """Return the files that are a joint's loop in C99."""
    values = exported_values(settings)
    if precision == "single":
        in_single(settings)
    name = c_name(settings.joint)
    fields = [_member(name, field, values[field.parameter]) for field in FIELDS]
    texts = {
        "c": name,
        "C": name.upper(),
        "joint": _plain(settings.joint),
        "source": _plain(source),
        "version": __version__,
        "is_single": precision == "single",
        "fields": fields,
        "choices": [_choice(name, field) for field in FIELDS if field.choices],
        "golden": golden_vectors(settings),
        "turn": _number(math.tau),
        "pi": _number(math.pi),
        "largest_position": _number(LARGEST_POSITION),
        "least_wrap": _number(LEAST_WRAP),
        "largest_motion": _number(LARGEST_MOTION),
        "error_scale": _default("norm.error_scale"),
        "rate_weight": _default("norm.rate_weight"),
    }
    templates = _templates()
    return {
        f"{name}{suffix}": templates.get_template(template).render(texts)
        for template, suffix in _FILES.items()
    }


class _Member(NamedTuple):
    """A member of the settings, as texts of C."""

    name: str
    type: str
    description: str
    value: str
    minimum: str | None
    maximum: str | None


class _Choice(NamedTuple):
    """An enumeration of what a setting may say."""

    field: str
    type: str
    description: str
    enumerators: tuple[str, ...]


def _member(name: str, field: Field, value: Value) -> _Member:
    if field.range is not None:
        number, least, most = (_real(float(each)) for each in (value, *field.range))
        return _Member(field.name, f"{name}_real", field.description, number, least, most)
    kind, text = "bool", "true" if value else "false"
    if field.choices:
        kind, text = f"{name}_{field.name}", _enumerator(name, field, str(value))
    return _Member(field.name, kind, field.description, text, None, None)


def _choice(name: str, field: Field) -> _Choice:
    enumerators = tuple(_enumerator(name, field, each) for each in field.choices)
    return _Choice(field.name, field.name, field.description, enumerators)


def _enumerator(name: str, field: Field, choice: str) -> str:
    return f"{name}_{field.name}_{choice}".upper()


def _default(parameter: str) -> str:
    return _real(float(LOOP_PARAMETERS[parameter].default))


def _number(value: float) -> str:
    """Return a finite number with as many digits as tell it from every other."""
    return repr(float(value))


def _real(value: float) -> str:
    return f"REAL({_number(value)})"


def _double(value: float | None) -> str:
    """Return any number of double precision; one that is not there is 0."""
    if value is None:
        return "0.0"
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    return _number(value)


def _comment(text: str, indent: int = 0) -> str:
    """Return a text for a comment, in lines; the first one begins after the indent."""
    lines = textwrap.wrap(text, _WIDTH - indent - len("/*  */"))
    return f"\n{' ' * indent} * ".join(lines)


def _plain(text: str) -> str:
    """Return a text that somebody else wrote so that it can neither end a comment nor a line."""
    plain = re.sub(r"[^A-Za-z0-9 .,:()+=_-]", "_", text)
    return plain if len(plain) <= _LONGEST_NAME else f"{plain[: _LONGEST_NAME - 3]}..."


@cache
def _templates() -> Environment:
    """Return the templates; whatever is foreign in what they print has been made plain before."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["double"] = _double
    environment.filters["comment"] = _comment
    return environment
