"""The codec against rosbags' own serialiser and against bytes that are no message."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from hpid_ros.base.errors import MessageError
from hpid_ros.messages.joint_state import (
    EffortReader,
    JointReader,
    JointStateLayout,
    JointStateTemplate,
    decode_joint_state,
)

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMPS = st.integers(min_value=-(2**31) * 10**9, max_value=2**31 * 10**9 - 1)
NAMES = st.lists(st.text(alphabet="abcdé_0", min_size=1, max_size=7), max_size=5, unique=True)
FLOATS = st.floats(allow_nan=False)


def serialise(stamp_ns, frame_id, names, position, velocity, effort, little_endian=True):
    types = STORE.types
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    message = types["sensor_msgs/msg/JointState"](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds),
            frame_id=frame_id,
        ),
        name=list(names),
        position=np.array(position, dtype=np.float64),
        velocity=np.array(velocity, dtype=np.float64),
        effort=np.array(effort, dtype=np.float64),
    )
    name = "sensor_msgs/msg/JointState"
    return bytes(STORE.serialize_cdr(message, name, little_endian=little_endian))


@st.composite
def messages(draw):
    names = draw(NAMES)
    arrays = [
        draw(st.lists(FLOATS, min_size=count, max_size=count))
        for count in draw(st.tuples(*[st.sampled_from([0, len(names)])] * 3))
    ]
    return (draw(STAMPS), draw(st.sampled_from(["", "base", "odom_x"])), tuple(names), *arrays)


@given(messages(), st.booleans())
def test_decoder_agrees_with_an_independent_serialiser(fields, little_endian):
    decoded = decode_joint_state(serialise(*fields, little_endian=little_endian))
    assert decoded == (*fields[:3], *map(tuple, fields[3:]))


@given(messages())
def test_template_gives_the_same_bytes_as_an_independent_serialiser(fields):
    stamp_ns, frame_id, names, position, velocity, effort = fields
    template = JointStateTemplate(
        names, frame_id, position=bool(position), velocity=bool(velocity), effort=bool(effort)
    )
    raw = template.encode(stamp_ns, position=position, velocity=velocity, effort=effort)
    assert raw == serialise(*fields)


@given(st.lists(messages(), min_size=1, max_size=6), st.data())
def test_joint_reader_follows_every_change_of_layout(sequence, data):
    joint = data.draw(st.sampled_from(sorted({n for m in sequence for n in m[2]}) or ["a"]))
    reader = JointReader(joint)
    for fields in sequence:
        stamp_ns, _, names, position, velocity, _ = fields
        raw = serialise(*fields)
        if joint not in names:
            assert reader.read(raw) is None
        elif not position:
            with pytest.raises(MessageError):
                reader.read(raw)
        else:
            index = names.index(joint)
            expected = (stamp_ns, position[index], velocity[index] if velocity else None)
            assert reader.read(raw) == expected
            assert reader.read(raw) == expected  # now at fixed offsets


@given(st.lists(st.tuples(STAMPS, st.sampled_from("abc"), FLOATS), max_size=8))
def test_effort_reader_tells_publishers_apart(commands):
    reader = EffortReader()
    for stamp_ns, name, effort in commands:
        raw = JointStateTemplate([name], effort=True).encode(stamp_ns, effort=[effort])
        assert reader.read(raw) == (stamp_ns, (name,), (effort,))
        assert reader.sender == ""
        raw = JointStateTemplate([name], "/who", effort=True).encode(stamp_ns, effort=[effort])
        assert reader.read(raw) == reader.read(raw) == (stamp_ns, (name,), (effort,))
        assert reader.sender == "/who"


def test_effort_reader_takes_a_command_of_several_joints():
    raw = JointStateTemplate(["a", "b"], effort=True).encode(5, effort=[1.0, 2.0])
    assert EffortReader().read(raw) == (5, ("a", "b"), (1.0, 2.0))


def test_effort_reader_remembers_no_long_names_of_strangers():
    reader = EffortReader()
    for k in range(200):
        name = f"{'x' * 100_000}{k}"
        raw = JointStateTemplate([name], "/who", effort=True).encode(k, effort=[1.0])
        assert reader.read(raw) == reader.read(raw) == (k, (name,), (1.0,))
        assert reader.sender == "/who"
    remembered = sum(len(key) for key in reader._known)
    assert remembered < 1_000_000


def test_swapped_arrays_of_equal_length_are_another_layout():
    velocity = JointStateTemplate(["a"], position=True, velocity=True).encode(
        1, position=[1.0], velocity=[2.0]
    )
    effort = JointStateTemplate(["a"], position=True, effort=True).encode(
        1, position=[1.0], effort=[2.0]
    )
    reader = JointReader("a")
    assert reader.read(velocity).velocity == 2.0
    assert reader.read(effort).velocity is None


@given(st.binary(max_size=300))
def test_random_bytes_never_raise_anything_but_a_message_error(raw):
    for read in (decode_joint_state, JointReader("a").read, EffortReader().read):
        with contextlib.suppress(MessageError):
            read(raw)


@given(messages(), st.data())
def test_a_truncated_message_is_refused(fields, data):
    raw = serialise(*fields)
    cut = data.draw(st.integers(min_value=0, max_value=len(raw) - 1))
    with pytest.raises(MessageError):
        decode_joint_state(raw[:cut])


@given(messages(), st.data())
def test_a_learned_reader_is_never_fooled_by_flipped_bytes(fields, data):
    joint = data.draw(st.sampled_from([*fields[2], "a"]))
    raw = bytearray(serialise(*fields))
    reader = JointReader(joint)
    try:
        reader.read(bytes(raw))
    except MessageError:
        return
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        fresh = JointReader(joint).read(bytes(raw))
    except MessageError:
        with pytest.raises(MessageError):
            reader.read(bytes(raw))
    else:
        assert repr(reader.read(bytes(raw))) == repr(fresh)  # repr: a NaN equals itself


def test_a_count_that_lies_is_refused():
    raw = bytearray(JointStateTemplate(["a"], effort=True).encode(1, effort=[1.0]))
    struct.pack_into("<I", raw, 20, 2**31)  # two thousand million names
    with pytest.raises(MessageError, match="names"):
        decode_joint_state(bytes(raw))


def test_layout_needs_little_endian():
    with pytest.raises(MessageError, match="little-endian"):
        JointStateLayout.of(serialise(1, "", ("a",), [1.0], [], [], little_endian=False))


def test_a_state_that_names_the_joint_twice_or_has_an_impossible_stamp_is_refused():
    twice = JointStateTemplate(["a", "b", "a"], position=True).encode(1, position=[1.0, 2.0, 3.0])
    assert JointReader("b").read(twice).position == 2.0
    with pytest.raises(MessageError, match="once, not 'a' twice"):
        JointReader("a").read(twice)
    reader = JointReader("b")
    reader.read(twice)
    late = bytearray(twice)
    late[8:12] = struct.pack("<I", 10**9)
    for read in (reader.read, JointReader("b").read, decode_joint_state):
        with pytest.raises(MessageError, match="nanoseconds must be below 1e9"):
            read(bytes(late))
