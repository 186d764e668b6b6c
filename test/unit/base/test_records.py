"""Records: what is declared once is checked, read, written and described alike."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import jsonschema
import pytest

from hpid_ros.base.errors import BagError, ExperimentError, SettingError, unknown_name
from hpid_ros.base.records import Record, Section, from_mapping, quantity, take_layered
from hpid_ros.base.schema import json_schema, layered_schema, table


@dataclass(frozen=True)
class Part(Record):
    """A part."""

    name: str = quantity("Its name")
    size: tuple[float, float] = quantity("Its edges", "m", default=(1.0, 1.0), above=0.0)


@dataclass(frozen=True)
class Motor(Record):
    """A motor."""

    torque: float = quantity("Its torque", "N m", above=0.0, most=1e3)
    loss: float = quantity("A share", default=0.0, least=0.0, below=1.0)
    kind: str = quantity("Its kind", default="fast", choices=("fast", "slow"))


@dataclass(frozen=True)
class Machine(Record):
    """A machine."""

    count: int = quantity("How many", least=0, most=9)
    begin: float = quantity("When", "s", default=0.0, key="from")
    is_on: bool = quantity("Whether it runs", default=True)
    motor: Motor | None = quantity("Its motor", default=None)
    limit: float | None = quantity("Its limit", "N m", default=None, above=0.0)
    parts: tuple[Part, ...] = quantity("Its parts", default=(), names=True)
    places: tuple[float, ...] = quantity("Where", "m", default=())
    levels: int | Mapping[str, int] = quantity("One, or by name", default=0, least=0)


GOOD = {
    "count": 3,
    "from": 2,
    "is_on": False,
    "motor": {"torque": 5, "kind": "slow"},
    "limit": 4.0,
    "parts": {"a": {"size": [1, 2]}, "b": {}},
    "places": [1, 2.5],
    "levels": {"low": 1},
}


def test_a_section_is_read_as_it_is_declared_and_fits_the_schema():
    found = from_mapping(Machine, GOOD, "machine", ExperimentError)
    parts = (Part("a", (1.0, 2.0)), Part("b"))
    motor = Motor(5.0, kind="slow")
    expected = Machine(3, 2.0, False, motor, 4.0, parts, (1.0, 2.5), {"low": 1})
    assert found == expected
    assert isinstance(found.begin, float)
    jsonschema.validate(GOOD, json_schema(Machine))
    assert from_mapping(Machine, {"count": 1}, "machine", ExperimentError) == Machine(1)


WHOLE = "machine.count must be a whole number, at least 0 and at most 9, not "
WRONG = [
    ({}, "machine.count is missing"),
    *(({"count": value}, f"{WHOLE}{value}") for value in (10, 1.0, True)),
    *(
        ({"count": 1, **values}, message)
        for values, message in (
            ({"begin": 0}, "unknown key 'machine.begin';"),
            ({"from": "x"}, "machine.from must be a number, not 'x'"),
            ({"from": math.inf}, "machine.from must be finite, not inf"),
            ({"from": 10**400}, "machine.from must be finite, not 1000"),
            ({"is_on": 1}, "machine.is_on must be true or false, not 1"),
            ({"motor": {}}, "machine.motor.torque is missing"),
            ({"motor": {"torque": 1, "los": 0}}, "did you mean 'machine.motor.loss'?"),
            ({"motor": {"torque": 1, "loss": 1}}, "loss must be at least 0 and below 1, not 1"),
            ({"motor": {"torque": 1, "kind": "fist"}}, "must be one of fast, slow, not 'fist'"),
            ({"motor": True}, "machine.motor must be a mapping, not True"),
            ({"limit": 0}, "machine.limit must be above 0, not 0"),
            ({"parts": {"a": {"size": [1]}}}, "machine.parts.a.size must be two numbers [m]"),
            ({"parts": [1]}, "machine.parts[0] must be a mapping, not 1"),
            ({"places": [1, "x"]}, "machine.places[1] must be a number, not 'x'"),
            ({"levels": {"a": -1}}, "machine.levels.a must be a whole number, at least 0"),
        )
    ),
]


@pytest.mark.parametrize(("values", "message"), WRONG)
def test_what_is_wrong_is_named_with_its_place_and_the_schema_refuses_it_as_well(values, message):
    with pytest.raises(ExperimentError) as caught:
        from_mapping(Machine, values, "machine", ExperimentError)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    if values.get("from") in (math.inf, 10**400) or values == {"count": 1.0}:
        return  # JSON has no infinity, and takes 1.0 for a whole number
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(values, json_schema(Machine))


def test_a_record_made_in_python_is_checked_and_has_the_declared_types():
    machine = Machine(1, begin=2, places=[1, 2], parts=[Part("a", (1, 2))])
    assert isinstance(machine.begin, float)
    assert machine.places == (1.0, 2.0)
    assert machine.parts == (Part("a", (1.0, 2.0)),)
    with pytest.raises(SettingError, match="torque must be above 0 and at most 1000, not -1"):
        Motor(-1)
    with pytest.raises(SettingError, match=r"torque must be .* not nan"):
        Motor(math.nan)


def layered(values):
    section = Section(values, "motors", ExperimentError)
    records = take_layered(Motor, section, ("one", "two"))
    section.finish()
    return records


def test_a_layer_of_one_joint_lies_over_what_is_said_of_all():
    values = {"torque": 2.0, "kind": "slow", "joints": {"two": {"torque": 3.0}}}
    jsonschema.validate(values, layered_schema(Motor))
    assert layered(values) == (Motor(2.0, kind="slow"), Motor(3.0, kind="slow"))
    with pytest.raises(ExperimentError, match=r"motors\.torque is missing"):
        layered({"joints": {"two": {"torque": 3.0}}})
    with pytest.raises(ExperimentError, match="unknown joint 'three'"):
        layered({"torque": 1.0, "joints": {"three": {}}})


def test_a_table_has_a_row_for_each_key_also_within():
    rows = {row.key: row for row in table(Machine, "machine.")}
    assert rows["machine.from"] == ("machine.from", "0.0", "", "When [s]")
    assert rows["machine.motor.torque"][1:] == (
        "needed",
        "above 0 and at most 1000",
        "Its torque [N m]",
    )
    assert rows["machine.parts.NAME.size"][1:] == ("[1.0, 1.0]", "above 0", "Its edges [m]")
    assert rows["machine.motor.kind"].range == "fast, slow"
    assert "machine.parts.NAME.name" not in rows


@pytest.mark.parametrize("letter", ["a", "\x1b"], ids=["letters", "escapes"])
def test_a_message_is_one_line_that_has_an_end_whatever_a_name_in_it_is(letter):
    name = 100_000 * letter
    text = str(BagError(unknown_name("joint", name, [name, "b"])))
    assert text.isprintable()
    assert len(text) < 40_000
    assert text.startswith("unknown joint")
    assert text.endswith("b")
