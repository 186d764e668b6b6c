"""The JSON Schema of an experiment file, with which editors complete and check it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from hpid_ros.base.schema import field_schema, partial_schema
from hpid_ros.base.yaml_files import EXTENDS
from hpid_ros.control.settings import PARAMETERS
from hpid_ros.motion.references import task_schema
from hpid_ros.simulation.world_file import world_schema

_OF_THE_NODE = "joint"
_NEEDED = ("name", "duration", "robot", "reference", "controllers", "compare")


def experiment_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12).

    A file that extends another one may leave out whatever it likes, and remove keys by null.
    """
    parameters = parameters_schema()
    whole = _mapping(_sections("parameters"), _NEEDED)
    extending = partial_schema(
        _mapping(_sections("extending_parameters"), _NEEDED), is_nullable=True
    )
    extending["properties"][EXTENDS] = {
        "type": "string",
        "minLength": 1,
        "description": "The file whose document this one is laid over",
    }
    extending["required"] = [EXTENDS]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Experiment of hpid_ros",
        "type": "object",
        "if": {"required": [EXTENDS]},
        "then": extending,
        "else": whole,
        "$defs": {
            "parameters": parameters,
            "extending_parameters": partial_schema(parameters, is_nullable=True),
            "joints": _joints("parameters"),
            "extending_joints": _joints("extending_parameters"),
            "compared": _compared(parameters, "joints"),
            "extending_compared": partial_schema(
                _compared(parameters, "extending_joints"), is_nullable=True
            ),
        },
    }


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _joints(parameters: str) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": _ref(parameters)}


def _compared(parameters: dict[str, Any], joints: str) -> dict[str, Any]:
    return {**parameters, "properties": {**parameters["properties"], "joints": _ref(joints)}}


def _sections(parameters: str) -> dict[str, Any]:
    """Return the sections, those of controllers by reference to parameters of this name."""
    prefix = parameters.removesuffix("parameters")
    return {
        "name": {"type": "string", "minLength": 1, "description": "Of the experiment"},
        "duration": {
            "type": "number",
            "exclusiveMinimum": 0,
            "maximum": 1e5,
            "description": "Stamp of the last state [s]",
        },
        **world_schema(),
        "reference": {"description": "What the joints follow", **task_schema()},
        "controllers": _mapping({"common": _ref(parameters), "joints": _ref(f"{prefix}joints")}),
        "compare": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": _ref(f"{prefix}compared"),
            "description": "The controllers by label; the first is the baseline",
        },
        "judge": _mapping(
            {"joints": {"type": "array", "minItems": 1, "items": {"type": "string"}}}, ("joints",)
        ),
    }


def parameters_schema() -> dict[str, Any]:
    """Return the schema of a controller's parameters, whose names may be nested or dotted."""
    specs = [spec for name, spec in PARAMETERS.items() if name != _OF_THE_NODE]
    properties = {spec.name: field_schema(spec.field) for spec in specs}
    for prefix in dict.fromkeys(name.partition(".")[0] for name in properties if "." in name):
        inner = {
            name.partition(".")[2]: schema
            for name, schema in properties.items()
            if name.startswith(f"{prefix}.")
        }
        properties[prefix] = _mapping(inner)
    return _mapping(properties)


def _mapping(properties: dict[str, Any], needed: Iterable[str] = ()) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        **({"required": list(needed)} if needed else {}),
    }
