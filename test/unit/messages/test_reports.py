"""Reports, group commands, parameter events and texts are what another serialiser writes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.base.errors import MessageError
from hpid_ros.messages import reports
from hpid_ros.messages.messages import PARAMETER_EVENTS, read_event

NUMBERS = st.floats(allow_nan=False)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
POSES = st.tuples(VECTORS, st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS))
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
HEADERS = st.builds(reports.Stamp, STAMPS, TEXTS)
COVARIANCES = st.lists(NUMBERS, min_size=36, max_size=36)
INTERFACES, DYNAMIC = "control_msgs/msg/InterfaceValue", "control_msgs/msg/DynamicJointState"
ALL_TYPES = get_typestore(Stores.ROS2_JAZZY)
ALL_TYPES.register(get_types_from_msg("string[] interface_names\nfloat64[] values\n", INTERFACES))
ALL_TYPES.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n",
        DYNAMIC,
    )
)


def new(kind, /, *values, **named):
    return ALL_TYPES.types[kind](*values, **named)


def serialised(kind, /, **values):
    return bytes(ALL_TYPES.serialize_cdr(new(kind, **values), kind))


def time(stamp_ns):
    return new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))


def header(stamp):
    return new("std_msgs/msg/Header", time(stamp.stamp_ns), stamp.frame)


def vector(values):
    return new("geometry_msgs/msg/Vector3", *values)


def pose(values):
    point, turn = values
    point, turn = (
        new("geometry_msgs/msg/Point", *point),
        new("geometry_msgs/msg/Quaternion", *turn),
    )
    return new("geometry_msgs/msg/Pose", point, turn)


@given(HEADERS, TEXTS, POSES, COVARIANCES, st.tuples(VECTORS, VECTORS), COVARIANCES)
def test_clock_and_odometry(stamp, child, place, place_covariance, twist, twist_covariance):
    clock = serialised(reports.CLOCK, clock=time(stamp.stamp_ns))
    assert reports.encode_clock(stamp.stamp_ns) == clock
    covariances = np.array(place_covariance), np.array(twist_covariance)
    moving = new("geometry_msgs/msg/Twist", *map(vector, twist))
    raw = reports.encode_odometry(stamp, child, place, place_covariance, twist, twist_covariance)
    assert raw == serialised(
        reports.ODOMETRY,
        header=header(stamp),
        child_frame_id=child,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose(place), covariances[0]),
        twist=new("geometry_msgs/msg/TwistWithCovariance", moving, covariances[1]),
    )


@given(HEADERS, VECTORS, st.lists(POSES, max_size=3))
def test_vectors_and_poses(stamp, values, poses):
    head = {"header": header(stamp)}
    expected = serialised(reports.VECTOR, **head, vector=vector(values))
    assert reports.encode_vector(stamp, values) == expected
    for each in poses:
        expected = serialised(reports.POSE, **head, pose=pose(each))
        assert reports.encode_pose(stamp, each) == expected
    expected = serialised(reports.POSES, **head, poses=[pose(each) for each in poses])
    assert reports.encode_poses(stamp, poses) == expected


@given(STAMPS, st.integers(0, 3), TEXTS, TEXTS, st.dictionaries(TEXTS, TEXTS, max_size=3))
def test_statuses(stamp_ns, level, name, message, values):
    pairs = [new("diagnostic_msgs/msg/KeyValue", *pair) for pair in values.items()]
    status = new("diagnostic_msgs/msg/DiagnosticStatus", level, name, message, "", pairs)
    raw = reports.encode_status(reports.Status(stamp_ns, level, name, message, values))
    of_array = header(reports.Stamp(stamp_ns, ""))
    assert raw == serialised(reports.STATUSES, header=of_array, status=[status])


@given(st.lists(NUMBERS, min_size=1, max_size=9))
def test_efforts_of_a_group(efforts):
    layout = new("std_msgs/msg/MultiArrayLayout", [], 0)
    expected = serialised("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(efforts))
    assert reports.MultiArrayTemplate(len(efforts)).encode(0, effort=efforts) == expected


@given(
    HEADERS,
    st.lists(st.text(alphabet="abcé_0", min_size=1, max_size=9), min_size=1, max_size=7),
    st.data(),
)
def test_efforts_as_a_dynamic_joint_state(stamp, names, data):
    template = reports.DynamicJointStateTemplate(names, stamp.frame)
    for _ in range(2):  # nothing of the message before is left
        efforts = data.draw(st.lists(NUMBERS, min_size=len(names), max_size=len(names)))
        values = [new(INTERFACES, ["effort"], np.array([each])) for each in efforts]
        assert template.encode(stamp.stamp_ns, effort=efforts) == serialised(
            DYNAMIC, header=header(stamp), joint_names=names, interface_values=values
        )


@pytest.mark.parametrize("count", [0, 2, 4])
def test_no_group_of_another_size_can_be_made(count):
    with pytest.raises(struct.error):
        reports.MultiArrayTemplate(3).encode(0, effort=[0.0] * count)
    with pytest.raises(ValueError, match="zip"):
        reports.DynamicJointStateTemplate(["a", "b", "c"]).encode(0, effort=[0.0] * count)


INTEGERS = st.integers(-(2**63), 2**63 - 1)
FIELDS = {
    "bool_value": (st.booleans(), False),
    "integer_value": (INTEGERS, 0),
    "double_value": (NUMBERS, 0.0),
    "string_value": (TEXTS, ""),
    "byte_array_value": (st.lists(st.integers(0, 255), max_size=3), np.empty(0, np.uint8)),
    "bool_array_value": (st.lists(st.booleans(), max_size=3), np.empty(0, bool)),
    "integer_array_value": (st.lists(INTEGERS, max_size=3), np.empty(0, np.int64)),
    "double_array_value": (st.lists(NUMBERS, max_size=3), np.empty(0)),
    "string_array_value": (st.lists(TEXTS, max_size=3), []),
}
VALUES = st.one_of(
    st.just((0, None)),
    *(st.tuples(st.just(k), values) for k, (values, _) in enumerate(FIELDS.values(), start=1)),
)
PARAMETERS = st.dictionaries(TEXTS, VALUES, max_size=3)


def parameter(name, kind, value):
    fields = {field: empty for field, (_, empty) in FIELDS.items()}
    if kind:
        field = list(FIELDS)[kind - 1]
        empty = fields[field]
        fields[field] = np.array(value, empty.dtype) if isinstance(empty, np.ndarray) else value
    content = new("rcl_interfaces/msg/ParameterValue", type=kind, **fields)
    return new("rcl_interfaces/msg/Parameter", name, content)


def event(node, declared, changed):
    return serialised(
        PARAMETER_EVENTS,
        stamp=time(10**9 + 2),
        node=node,
        new_parameters=[parameter(name, *each) for name, each in declared.items()],
        changed_parameters=[parameter(name, *each) for name, each in changed.items()],
        deleted_parameters=[],
    )


@given(TEXTS, PARAMETERS, PARAMETERS, st.data())
def test_a_parameter_event_is_read_whole_or_not_at_all(node, declared, changed, data):
    raw = event(node, declared, changed)
    assert read_event(raw) == reports.ParameterEvent(
        node, *({name: value for name, (_, value) in each.items()} for each in (declared, changed))
    )
    if changed:  # without the empty last sequence, and up to three bytes that align it
        assert read_event(raw[: data.draw(st.integers(0, len(raw) - 4 - 3 - 1))]) is None


@given(st.binary(max_size=60))
def test_bytes_of_strangers_are_an_event_or_an_error_of_ours(tail):
    for raw in (tail, b"\0\1\0\0" + tail, event("/a", {}, {})[:16] + tail):
        read_event(raw)


def test_a_count_that_cannot_be_is_refused_before_anything_is_made_of_it():
    raw = event("", {}, {})
    with pytest.raises(MessageError, match="cannot hold 4294967295 parameters"):
        reports.decode_parameter_event(raw[:20] + b"\xff" * 4 + raw[24:])


@given(TEXTS)
def test_a_text(text):
    assert reports.decode_text(serialised("std_msgs/msg/String", data=text)) == text
