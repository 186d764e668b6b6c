"""All other messages are what another serialiser writes; parameter events in a bag are found."""

import struct

import numpy as np
import pytest
from harness.bags import JOINT_STATE, JOINT_TRAJECTORY, MS, command, parameter_event, state
from harness.foreign_bags import in_order, states, write
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.main import main
from hpid_ros.base.errors import MessageError
from hpid_ros.messages import reports
from hpid_ros.messages.joint_trajectory import decode_trajectory, encode_trajectory
from hpid_ros.messages.messages import PARAMETER_EVENTS, read_event, read_retunes

NUMBERS = st.floats(allow_nan=False)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
POSES = st.tuples(VECTORS, st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS))
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
HEADERS = st.builds(reports.Stamp, STAMPS, TEXTS)
COVARIANCES = st.integers(0, 99).map(lambda seed: np.random.default_rng(seed).normal(size=36))
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
    moving = new("geometry_msgs/msg/Twist", *map(vector, twist))
    raw = reports.encode_odometry(stamp, child, place, place_covariance, twist, twist_covariance)
    assert raw == serialised(
        reports.ODOMETRY,
        header=header(stamp),
        child_frame_id=child,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose(place), place_covariance),
        twist=new("geometry_msgs/msg/TwistWithCovariance", moving, twist_covariance),
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


@given(NUMBERS)
def test_an_effort_alone(effort):
    expected = serialised("std_msgs/msg/Float64", data=effort)
    assert reports.Float64Template().encode(0, effort=[effort]) == expected


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


@st.composite
def trajectories(draw):
    """Names, times, and arrays of which each point has the same, or its own."""
    names = draw(st.lists(st.text("abcé_", min_size=1, max_size=6), min_size=1, max_size=5))
    gaps = draw(st.lists(st.integers(1, 10**10), min_size=1, max_size=9))
    times_ns = np.cumsum(gaps) + draw(st.integers(-(10**10), 10**10))
    seed = np.random.default_rng(draw(st.integers(0, 99)))
    arrays = [seed.normal(size=(len(gaps), len(names))) for _ in range(4)]
    is_mixed = draw(st.booleans())
    for each in arrays[1:]:
        given_by = [draw(st.booleans()) for _ in (gaps if is_mixed else gaps[:1])]
        each[~np.resize(given_by, len(gaps))] = np.nan
    return names, times_ns, tuple(arrays)


@given(trajectories(), st.integers(0, 2**31 * 10**9 - 1))
def test_ros_and_our_decoder_read_the_trajectory_that_was_encoded(trajectory, stamp_ns):
    names, times_ns, arrays = trajectory
    raw = encode_trajectory(stamp_ns, names, times_ns, arrays)
    message = ALL_TYPES.deserialize_cdr(raw, JOINT_TRAJECTORY)
    assert bytes(ALL_TYPES.serialize_cdr(message, JOINT_TRAJECTORY)) == raw
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
    assert message.joint_names == names
    assert len(message.points) == len(times_ns)
    for k, point in enumerate(message.points):
        time = point.time_from_start
        assert time.sec * 10**9 + time.nanosec == times_ns[k]
        given_ = point.positions, point.velocities, point.accelerations, point.effort
        for values, each in zip(given_, arrays, strict=True):
            assert list(values) == ([] if np.isnan(each[k, 0]) else list(each[k]))
    decoded = decode_trajectory(raw)
    assert (decoded.stamp_ns, decoded.names) == (stamp_ns, tuple(names))
    assert np.array_equal(decoded.times_ns, times_ns)
    for got, meant in zip(decoded.arrays, arrays, strict=True):
        assert np.array_equal(got, meant, equal_nan=True)


WALL_NS = 1_700_000_000_000_000_000  # the recorder's clock, far from the states'


@pytest.fixture
def bag(tmp_path):
    """A bag of one joint: a parameter set before the first state, others after two of them."""
    log = [("/parameter_events", WALL_NS, parameter_event("/elbow_controller", mu=0.1))]
    for k in range(200):
        now = WALL_NS + 1 + k * MS
        log.append(("/joint_states", now, state(k * MS, elbow=0.01 * k)[2]))
        log.append(("/joint_commands", now + 1, command(k * MS, elbow=1.0 / (1 + k))[2]))
    for k, node, changes in (
        (50, "/elbow_controller", {"mu": -0.2, "gains__p": 60.0}),
        (120, "/elbow_controller", {"law": "pid"}),
        (120, "/camera", {"exposure": 3.0}),
    ):
        log.append(("/parameter_events", WALL_NS + k * MS + 3, parameter_event(node, **changes)))
    types = dict.fromkeys(("/joint_states", "/joint_commands"), JOINT_STATE)
    return write(tmp_path / "run", {**types, "/parameter_events": PARAMETER_EVENTS}, in_order(log))


def test_retunes_stand_at_the_state_before_them_and_foreign_ones_are_left_out(bag):
    found = [(each.stamp_ns, each.node, each.change) for each in read_retunes(bag)]
    assert found == [
        (50 * MS, "/elbow_controller", "mu = -0.2, gains.p = 60"),
        (120 * MS, "/elbow_controller", "law = pid"),
    ]


def test_the_report_of_a_bag_with_retunes_lists_them(bag, tmp_path):
    page = tmp_path / "report.html"
    assert main(["metrics", str(bag), "--report", str(page)]) == DONE
    text = page.read_text(encoding="utf-8")
    assert "Retuned while running" in text
    assert '"marks":[{"run":0,"x":0.05},{"run":0,"x":0.12}]' in text


def test_a_bag_without_parameter_events_has_no_retunes(tmp_path):
    assert read_retunes(write(tmp_path / "run", {"/joint_states": JOINT_STATE}, states())) == ()
