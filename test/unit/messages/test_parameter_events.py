"""Changes of parameters and texts are read as another implementation writes them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import MessageError
from hpid_ros.messages.messages import PARAMETER_EVENTS, read_event
from hpid_ros.messages.reports import decode_parameter_event, decode_text
from hpid_ros.messages.writer import jazzy_types

TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
INTEGERS, NUMBERS = st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False)
FIELDS = {
    "bool_value": (st.booleans(), False),
    "integer_value": (INTEGERS, 0),
    "double_value": (NUMBERS, 0.0),
    "string_value": (TEXTS, ""),
    "byte_array_value": (st.lists(st.integers(0, 255), max_size=3), np.uint8),
    "bool_array_value": (st.lists(st.booleans(), max_size=3), bool),
    "integer_array_value": (st.lists(INTEGERS, max_size=3), np.int64),
    "double_array_value": (st.lists(NUMBERS, max_size=3), np.float64),
    "string_array_value": (st.lists(TEXTS, max_size=3), list),
}
VALUES = st.one_of(
    st.just((0, None)),
    *(
        st.tuples(st.just(kind), values)
        for kind, (values, _) in enumerate(FIELDS.values(), start=1)
    ),
)
PARAMETERS = st.dictionaries(TEXTS, VALUES, max_size=3)


def new(kind, /, **values):
    return jazzy_types().types[kind](**values)


def parameter(name, kind, value):
    fields = {
        field: np.array([], empty) if isinstance(empty, type) and empty is not list else empty
        for field, (_, empty) in FIELDS.items()
    }
    fields["string_array_value"] = []
    if kind:
        field = list(FIELDS)[kind - 1]
        empty = fields[field]
        fields[field] = np.array(value, empty.dtype) if isinstance(empty, np.ndarray) else value
    content = new("rcl_interfaces/msg/ParameterValue", type=kind, **fields)
    return new("rcl_interfaces/msg/Parameter", name=name, value=content)


def serialised(node, declared, changed):
    event = new(
        PARAMETER_EVENTS,
        stamp=new("builtin_interfaces/msg/Time", sec=1, nanosec=2),
        node=node,
        new_parameters=[parameter(name, *each) for name, each in declared.items()],
        changed_parameters=[parameter(name, *each) for name, each in changed.items()],
        deleted_parameters=[],
    )
    return bytes(jazzy_types().serialize_cdr(event, PARAMETER_EVENTS))


@given(TEXTS, PARAMETERS, PARAMETERS)
def test_an_event_tells_what_was_written(node, declared, changed):
    told = decode_parameter_event(serialised(node, declared, changed))
    assert told.node == node
    assert told.declared == {name: value for name, (_, value) in declared.items()}
    assert told.changed == {name: value for name, (_, value) in changed.items()}


@given(PARAMETERS.filter(bool), st.data())
def test_a_part_of_an_event_is_none(changed, data):
    raw = serialised("/elbow_controller", {}, changed)
    # Without the empty last sequence, and up to three bytes that align it.
    assert read_event(raw[: data.draw(st.integers(0, len(raw) - 4 - 3 - 1))]) is None


@given(st.binary(max_size=60))
def test_bytes_of_strangers_are_an_event_or_an_error_of_ours(tail):
    for raw in (tail, b"\0\1\0\0" + tail, serialised("/a", {}, {})[:16] + tail):
        read_event(raw)


def test_a_count_that_cannot_be_is_refused_before_anything_is_made_of_it():
    raw = serialised("", {}, {})
    with pytest.raises(MessageError, match="cannot hold 4294967295 parameters"):
        decode_parameter_event(raw[:20] + b"\xff" * 4 + raw[24:])


@given(TEXTS)
def test_a_text(text):
    message = new("std_msgs/msg/String", data=text)
    assert decode_text(bytes(jazzy_types().serialize_cdr(message, "std_msgs/msg/String"))) == text
