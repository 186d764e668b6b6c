"""Efforts of a group against rosbags' own serialiser."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.messages.reports import DynamicJointStateTemplate, MultiArrayTemplate

STORE = get_typestore(Stores.ROS2_JAZZY)
INTERFACES, DYNAMIC = "control_msgs/msg/InterfaceValue", "control_msgs/msg/DynamicJointState"
STORE.register(get_types_from_msg("string[] interface_names\nfloat64[] values\n", INTERFACES))
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n",
        DYNAMIC,
    )
)
FLOATS = st.floats(allow_nan=False)
NAMES = st.lists(st.text(alphabet="abcé_0", min_size=1, max_size=9), min_size=1, max_size=7)
STAMPS = st.integers(min_value=0, max_value=2**31 * 10**9 - 1)


@given(st.lists(FLOATS, min_size=1, max_size=9))
def test_an_array_is_what_the_independent_serialiser_writes(efforts):
    types = STORE.types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    message = types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(efforts))
    expected = bytes(STORE.serialize_cdr(message, "std_msgs/msg/Float64MultiArray"))
    assert MultiArrayTemplate(len(efforts)).encode(0, effort=efforts) == expected


@given(STAMPS, st.sampled_from(["", "/merger", "x"]), NAMES, st.data())
def test_a_dynamic_joint_state_is_what_the_independent_serialiser_writes(
    stamp_ns, frame_id, names, data
):
    template = DynamicJointStateTemplate(names, frame_id)
    for _ in range(2):  # nothing of the message before is left
        efforts = data.draw(st.lists(FLOATS, min_size=len(names), max_size=len(names)))
        types = STORE.types
        message = types[DYNAMIC](
            header=types["std_msgs/msg/Header"](
                types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id
            ),
            joint_names=names,
            interface_values=[types[INTERFACES](["effort"], np.array([e])) for e in efforts],
        )
        expected = bytes(STORE.serialize_cdr(message, DYNAMIC))
        assert template.encode(stamp_ns, effort=efforts) == expected


@pytest.mark.parametrize("count", [0, 2, 4])
def test_no_message_of_another_size_can_be_made(count):
    with pytest.raises(struct.error):
        MultiArrayTemplate(3).encode(0, effort=[0.0] * count)
    with pytest.raises(ValueError, match="zip"):
        DynamicJointStateTemplate(["a", "b", "c"]).encode(0, effort=[0.0] * count)
