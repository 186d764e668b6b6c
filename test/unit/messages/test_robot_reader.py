"""The reader of a whole robot's state finds what the general decoder finds, or says why not."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import MessageError
from hpid_ros.messages.joint_state import JointStateTemplate, RobotReader, decode_joint_state

NAMES = ("shoulder", "elbow", "wrist", "gripper")


def encode(names=NAMES, velocity=True, effort=True, stamp_ns=1_000, first=1.0):
    template = JointStateTemplate(names, position=True, velocity=velocity, effort=effort)
    count = len(names)
    arrays = {"position": [first + k for k in range(count)]}
    if velocity:
        arrays["velocity"] = [first + 10 + k for k in range(count)]
    if effort:
        arrays["effort"] = [first + 20 + k for k in range(count)]
    return template.encode(stamp_ns, **arrays)


@given(
    order=st.permutations(NAMES),
    asked=st.permutations(NAMES).flatmap(
        lambda names: st.integers(1, 4).map(lambda count: names[:count])
    ),
    velocity=st.booleans(),
    effort=st.booleans(),
)
def test_it_reads_what_the_general_decoder_reads(order, asked, velocity, effort):
    reader = RobotReader(asked)
    for first in (1.0, 2.5, -7.0):  # the first message is learned, the others read at offsets
        raw = encode(order, velocity, effort, first=first)
        found, fields = reader.read(raw), decode_joint_state(raw)
        places = [fields.names.index(name) for name in asked]
        assert list(found.position) == [fields.position[k] for k in places]
        assert (found.velocity is None) == (not velocity)
        assert (found.effort is None) == (not effort)
        if velocity:
            assert list(found.velocity) == [fields.velocity[k] for k in places]
        if effort:
            assert list(found.effort) == [fields.effort[k] for k in places]


def test_another_layout_is_learned_anew_and_forgotten_again():
    reader = RobotReader(["elbow", "wrist"])
    for names in (NAMES, NAMES[::-1], ("extra", *NAMES), NAMES):
        for velocity in (True, False):
            raw = encode(names, velocity)
            fields = decode_joint_state(raw)
            assert list(reader.read(raw).position) == [
                fields.position[names.index(name)] for name in ("elbow", "wrist")
            ]


def test_nan_is_passed_on_for_others_to_judge():
    raw = encode(first=math.nan)
    assert all(math.isnan(each) for each in RobotReader(NAMES).read(raw).effort)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (encode(NAMES[:3]), "'gripper' 0 times"),
        (encode(("gripper", *NAMES)), "'gripper' 2 times"),
        (b"\x00\x01\x00\x00", "ends before"),
        (b"", "CDR header"),
    ],
)
def test_a_state_that_is_not_whole_is_refused_in_one_line(raw, words):
    reader = RobotReader(NAMES)
    reader.read(encode())
    with pytest.raises(MessageError, match=words) as refusal:
        reader.read(raw)
    assert "\n" not in str(refusal.value)
    assert reader.read(encode(first=3.0)).position == (3.0, 4.0, 5.0, 6.0)


def test_efforts_of_another_number_than_the_names_are_refused():
    whole = encode()
    short = bytearray(whole[:-8])  # one effort less, and its count says so
    struct.pack_into("<I", short, whole.rindex(struct.pack("<I", 4)), 3)
    with pytest.raises(MessageError, match="4 positions and 0 or 4 velocities and efforts"):
        RobotReader(NAMES).read(bytes(short))
