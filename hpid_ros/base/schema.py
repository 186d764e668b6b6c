"""Descriptions of records, from what their fields declare: JSON Schemas, and rows of tables."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Union, get_args, get_origin

from hpid_ros.base.records import (
    ANY,
    OFF,
    FieldSpec,
    ParameterSpec,
    Record,
    container_of,
    is_record,
    record_fields,
)

_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", object: None}


def json_schema(kind: type[Record]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a section, all of it in one piece."""
    named = {each.name: each for each in record_fields(kind)}
    schema: dict[str, Any] = {
        "type": "object",
        "description": _summary(kind),
        "properties": {key: field_schema(each) for key, each in named.items()},
        "additionalProperties": False,
    }
    needed = [key for key, each in named.items() if each.is_needed and each.name != "name"]
    return schema | ({"required": needed} if needed else {})


def layered_schema(kind: type[Record]) -> dict[str, Any]:
    """Return the JSON Schema of what :func:`take_layered` reads."""
    own = partial_schema(json_schema(kind))
    joints = {"type": "object", "additionalProperties": own}
    return {**own, "properties": {**own["properties"], "joints": joints}}


def partial_schema(schema: dict[str, Any], *, is_nullable: bool = False) -> dict[str, Any]:
    """Return a schema in which nothing is needed, in its mappings neither."""

    def loosened(each: dict[str, Any]) -> dict[str, Any]:
        inner = partial_schema(each, is_nullable=is_nullable)
        return {"anyOf": [inner, {"type": "null"}]} if is_nullable else inner

    result = {key: value for key, value in schema.items() if key != "required"}
    if "properties" in result:
        result["properties"] = {key: loosened(each) for key, each in result["properties"].items()}
    if isinstance(result.get("additionalProperties"), dict):
        result["additionalProperties"] = loosened(result["additionalProperties"])
    elif "additionalProperties" in result and is_nullable:
        result["additionalProperties"] = {"type": "null"}
    choices = [*result.pop("oneOf", ()), *result.pop("anyOf", ())]
    if choices:
        result["anyOf"] = [partial_schema(each, is_nullable=is_nullable) for each in choices]
    return result


class TableRow(NamedTuple):
    """One key of a section, for a person."""

    key: str  # its name, with those of the sections that it is in
    default: str  # what it is when it is left out; needed where it must not be
    range: str  # what it may be; empty for whatever fits
    meaning: str  # what it is, with its unit


def table(kind: type[Record], prefix: str = "") -> Iterator[TableRow]:
    """Yield each key of a section, those of records within it too."""
    for each in record_fields(kind):
        inner, place = _inner(each.kind, each)
        if each.name == "name":  # stands for NAME in the other keys
            continue
        bounds = ", ".join(each.choices)
        if each.bounds != ANY:
            bounds = str(each.bounds)
        default = "needed" if each.is_needed else _shown_default(each.default)
        yield TableRow(f"{prefix}{each.name}", default, bounds, each.description)
        if is_record(inner):
            yield from table(inner, f"{prefix}{each.name}{place}.")


def _inner(kind: Any, what: FieldSpec) -> tuple[Any, str]:
    """Return what a list or mapping holds, and how its entries are named; else the type itself."""
    container = container_of(kind)
    if container is tuple:
        return get_args(kind)[0], ".NAME" if what.names else "[]"
    if container is Mapping:
        return get_args(kind)[1], ".NAME"
    return kind, ""


def _shown_default(value: Any) -> str:
    if value is None or value in ({}, ()) or isinstance(value, Record):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else f"{value}"


def field_schema(each: ParameterSpec) -> dict[str, Any]:
    schema = _schema_of(each.kind, each)
    if each.is_optional and is_record(each.kind):
        schema = {"anyOf": [schema, {"const": OFF}]}
    schema = {**schema, "description": each.description}
    if each.kind is str and not each.choices and (each.is_needed or each.default != ""):
        schema["minLength"] = 1
    if not each.is_needed and isinstance(each.default, bool | int | float | str):
        schema["default"] = each.default
    return schema


def _schema_of(kind: Any, what: FieldSpec) -> dict[str, Any]:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return {"anyOf": [_schema_of(each, what) for each in inner]}
    if origin is tuple and what.names:
        entries = json_schema(inner[0])
        entries["properties"].pop("name")
        return {"type": "object", "additionalProperties": entries}
    if origin is tuple:
        sizes = {} if inner[-1] is Ellipsis else {"minItems": len(inner), "maxItems": len(inner)}
        return {"type": "array", "items": _schema_of(inner[0], what), **sizes}
    if container_of(kind) is Mapping:
        return {"type": "object", "additionalProperties": _schema_of(inner[1], what)}
    if is_record(kind):
        return json_schema(kind)
    name = _TYPES[kind]
    if name is None:
        return {}
    if kind is str:
        return {"type": name} | ({"enum": list(what.choices)} if what.choices else {})
    return {"type": name} | ({} if kind is bool else what.bounds.schema())


def _summary(kind: type[Record]) -> str:
    return (kind.__doc__ or kind.__name__).strip().splitlines()[0]
