"""The codec against rosbags' own serialiser; its readers against the codec; bytes of strangers."""

import contextlib
import math
import struct

import numpy as np
import pytest
from harness.bags import JOINT_STATE, TYPES
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import MessageError
from hpid_ros.messages.joint_state import (
    EffortReader,
    GroupReader,
    JointPart,
    JointReader,
    JointStateTemplate,
    RobotReader,
    decode_joint_state,
)

JOINTS = ("shoulder", "elbow", "wrist", "gripper")
STAMPS = st.integers(min_value=-(2**31) * 10**9, max_value=2**31 * 10**9 - 1)
NAMES = st.lists(st.text(alphabet="abcdé_0", min_size=1, max_size=7), max_size=5, unique=True)
FLOATS = st.floats(allow_nan=False)


def serialise(stamp_ns, frame_id, names, *arrays, little_endian=True):
    types = TYPES.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = types["std_msgs/msg/Header"](stamp, frame_id)
    numbers = (np.array(each, dtype=np.float64) for each in arrays)
    message = types[JOINT_STATE](header, list(names), *numbers)
    return bytes(TYPES.serialize_cdr(message, JOINT_STATE, little_endian=little_endian))


def encode(names=JOINTS, velocity=True, effort=True, first=1.0, stamp_ns=1_000):
    """Return a state whose positions, velocities and efforts count from some number on."""
    template = JointStateTemplate(names, position=True, velocity=velocity, effort=effort)
    arrays = ([first + 10 * k + j for j in range(len(names))] for k in range(3))
    fields = ("position", "velocity", "effort")
    return template.encode(stamp_ns, **dict(zip(fields, arrays, strict=True)))


def with_stamp_beyond_a_second(raw):
    return raw[:8] + struct.pack("<I", 10**9) + raw[12:]


@st.composite
def messages(draw):
    names = draw(NAMES)
    arrays = [
        draw(st.lists(FLOATS, min_size=count, max_size=count))
        for count in draw(st.tuples(*[st.sampled_from([0, len(names)])] * 3))
    ]
    return (draw(STAMPS), draw(st.sampled_from(["", "base", "odom_x"])), tuple(names), *arrays)


@given(messages(), st.booleans())
def test_decoder_and_template_agree_with_an_independent_serialiser(fields, little_endian):
    stamp_ns, frame_id, names, *arrays = fields
    decoded = decode_joint_state(serialise(*fields, little_endian=little_endian))
    assert decoded == (*fields[:3], *map(tuple, arrays))
    values = dict(zip(("position", "velocity", "effort"), arrays, strict=True))
    template = JointStateTemplate(names, frame_id, **{k: bool(v) for k, v in values.items()})
    assert template.encode(stamp_ns, **values) == serialise(*fields)


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
        for sender in ("", "/who"):
            template = JointStateTemplate([name], sender, effort=True)
            raw = template.encode(stamp_ns, effort=[effort])
            assert reader.read(raw) == reader.read(raw) == (stamp_ns, (name,), (effort,))
            assert reader.sender == sender
    raw = JointStateTemplate(["a", "b"], effort=True).encode(5, effort=[1.0, 2.0])
    assert reader.read(raw) == (5, ("a", "b"), (1.0, 2.0))


def test_effort_reader_remembers_no_command_whose_effort_is_not_its_last_bytes():
    reader, fields = EffortReader(), (5, "", ["a"], [], [], [1.5])
    for raw in (serialise(*fields, little_endian=False), serialise(*fields) + bytes(8)):
        assert reader.read(raw) == reader.read(raw) == (5, ("a",), (1.5,))


def test_effort_reader_remembers_no_long_names_of_strangers():
    reader = EffortReader()
    for k in range(50):
        name = f"{'x' * 100_000}{k}"
        raw = JointStateTemplate([name], "/who", effort=True).encode(k, effort=[1.0])
        assert reader.read(raw) == reader.read(raw) == (k, (name,), (1.0,))
    assert sum(len(key) for key in reader._known) < 1_000_000


def test_swapped_arrays_of_equal_length_are_another_layout():
    reader = JointReader("a")
    assert reader.read(encode(["a"], effort=False)).velocity == 11.0
    assert reader.read(encode(["a"], velocity=False)).velocity is None


@given(
    st.permutations(JOINTS),
    st.permutations(JOINTS).flatmap(lambda names: st.integers(1, 4).map(lambda n: names[:n])),
    st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=3),
)
def test_robot_reader_reads_what_the_general_decoder_reads(order, asked, layouts):
    reader = RobotReader(asked)
    for velocity, effort in layouts:
        for first in (1.0, 2.5):  # the first message is learned, the others read at offsets
            raw = encode(order, velocity, effort, first)
            fields = decode_joint_state(raw)
            places = [fields.names.index(name) for name in asked]
            for found, array in zip(reader.read(raw), fields[3:], strict=True):
                wanted = [array[k] for k in places] if array else None
                assert (None if found is None else list(found)) == wanted


def test_nan_is_passed_on_for_others_to_judge():
    read = RobotReader(JOINTS).read(encode(first=math.nan))
    assert all(math.isnan(each) for each in read.effort)


GROUP = st.permutations([*JOINTS[:3], "wheel", "finger"])


@given(st.lists(st.tuples(GROUP, st.integers(0, 5), st.booleans()), min_size=1, max_size=30))
def test_group_reader_gives_the_joints_that_a_message_has(messages):
    reader = GroupReader(JOINTS)
    for stamp_ns, (names, count, has_velocity) in enumerate(messages, 10**9 - 5):
        names = names[:count]
        found, parts = reader.read(encode(names, has_velocity, stamp_ns=stamp_ns))
        assert found == stamp_ns
        assert set(parts) == {
            JointPart(JOINTS.index(name), 1.0 + k, 11.0 + k if has_velocity else None)
            for k, name in enumerate(names)
            if name in JOINTS
        }


def test_group_reader_reads_more_layouts_than_it_remembers():
    reader = GroupReader(JOINTS)
    for count in (*range(40), *range(40)):
        names = [*(f"other_{k}" for k in range(count)), "elbow"]
        raw = encode(names, velocity=False, effort=False, stamp_ns=7)
        assert reader.read(raw) == (7, [JointPart(1, 1.0 + count, None)])


def one_effort_less(raw):
    """Return a state with one effort less, and whose count says so."""
    short = bytearray(raw[:-8])
    struct.pack_into("<I", short, raw.rindex(struct.pack("<I", len(JOINTS))), len(JOINTS) - 1)
    return bytes(short)


TWICE = encode(("elbow", "elbow", "wrist"), velocity=False, effort=False)


@pytest.mark.parametrize(
    ("reader", "raw", "word"),
    [
        (JointReader("elbow"), TWICE, "2 times"),
        (JointReader("elbow"), with_stamp_beyond_a_second(encode()), "nanoseconds"),
        (GroupReader(JOINTS), TWICE, "'elbow' 2 times"),
        (GroupReader(JOINTS), JointStateTemplate(["elbow"]).encode(7), "not 0, 0"),
        (GroupReader(JOINTS), encode()[:-1], "ends before"),
        (GroupReader(JOINTS), with_stamp_beyond_a_second(encode()), "nanoseconds"),
        (RobotReader(JOINTS), encode(JOINTS[:3]), "'gripper' 0 times"),
        (RobotReader(JOINTS), encode(("gripper", *JOINTS)), "'gripper' 2 times"),
        (RobotReader(JOINTS), one_effort_less(encode()), "not 4, 4, 3"),
        (RobotReader(JOINTS), b"\x00\x01\x00\x00", "ends before"),
        (RobotReader(JOINTS), b"", "CDR header"),
    ],
)
def test_what_is_no_state_of_the_joints_is_refused_before_and_after_learning(reader, raw, word):
    for _ in range(3):
        with pytest.raises(MessageError, match=word) as refusal:
            reader.read(raw)
        assert "\n" not in str(refusal.value)
        assert reader.read(encode()) is not None


@given(st.binary(max_size=300))
def test_random_bytes_never_raise_anything_but_a_message_error(raw):
    readers = JointReader("a"), EffortReader(), RobotReader("a"), GroupReader("a")
    for read in (decode_joint_state, *(each.read for each in readers)):
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
    raw = bytearray(encode(["a"]))
    struct.pack_into("<I", raw, 20, 2**31)  # two thousand million names
    with pytest.raises(MessageError, match="names"):
        decode_joint_state(bytes(raw))
