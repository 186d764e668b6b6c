"""Joints that come in whatever messages, in whatever order."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import MessageError
from hpid_ros.messages.joint_state import GroupReader, JointPart, JointStateTemplate

JOINTS = ("shoulder", "elbow", "wrist")
NAMES = st.permutations([*JOINTS, "wheel", "gripper"])


@given(st.lists(st.tuples(NAMES, st.integers(0, 5), st.booleans()), min_size=1, max_size=30))
def test_each_message_gives_the_joints_that_it_has(messages):
    reader = GroupReader(JOINTS)
    for stamp_ns, (names, count, has_velocity) in enumerate(messages, 10**9 - 5):
        names = names[:count]
        position = [float(len(name)) + stamp_ns % 7 for name in names]
        velocity = [-each for each in position] if has_velocity else []
        template = JointStateTemplate(names, position=True, velocity=has_velocity, effort=True)
        raw = template.encode(stamp_ns, position=position, velocity=velocity, effort=[0.5] * count)
        told, parts = reader.read(raw)
        assert told == stamp_ns
        assert set(parts) == {
            JointPart(j, position[names.index(joint)], -position[names.index(joint)])
            if has_velocity
            else JointPart(j, position[names.index(joint)], None)
            for j, joint in enumerate(JOINTS)
            if joint in names
        }


def test_more_layouts_than_are_remembered_are_still_read():
    reader = GroupReader(JOINTS)
    for count in (*range(40), *range(40)):
        names = [*(f"other_{k}" for k in range(count)), "elbow"]
        template = JointStateTemplate(names, position=True)
        raw = template.encode(7, position=[*range(count), 2.5])
        assert reader.read(raw) == (7, [JointPart(1, 2.5, None)])


@pytest.mark.parametrize("times", [1, 3])
def test_what_is_no_state_of_the_joints_is_refused(times):
    reader = GroupReader(JOINTS)
    good = JointStateTemplate(["elbow"], position=True).encode(7, position=[1.0])
    for _ in range(times):
        with pytest.raises(MessageError, match="'elbow' 2 times"):
            reader.read(JointStateTemplate(["elbow", "elbow"]).encode(7))
        with pytest.raises(MessageError, match=r"must have 1 positions .* not 0 and 0"):
            reader.read(JointStateTemplate(["elbow"], effort=True).encode(7, effort=[1.0]))
        with pytest.raises(MessageError):
            reader.read(good[:-1])
        bad = bytearray(good)
        bad[8:12] = struct.pack("<I", 10**9)
        with pytest.raises(MessageError, match="nanoseconds"):
            reader.read(bytes(bad))
        assert reader.read(good) == (7, [JointPart(1, 1.0, None)])
