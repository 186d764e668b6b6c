"""References from the wire: as the general decoder says, bounded in time, or refused."""

import contextlib
import random
import time

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from harness.trajectories import column_from_bytes, from_message
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.base.errors import HpidError, MessageError, TrajectoryError
from hpid_ros.messages.bounds import LIVE
from hpid_ros.messages.joint_trajectory import decode_float64


def trajectory(joints, points, gives=(True, True, True, False), frame="", stamp=0, seed=0):
    draw = random.Random(seed)
    message = JointTrajectory(joint_names=list(joints))
    message.header.frame_id = frame
    message.header.stamp.sec = stamp
    for k in range(points):
        row = [[draw.random() for _ in joints] if each else [] for each in gives]
        point = JointTrajectoryPoint(
            time_from_start=Duration(sec=k, nanosec=draw.randrange(10**9))
        )
        point.positions, point.velocities, point.accelerations, point.effort = row
        message.points.append(point)
    return message


@given(
    st.lists(st.text("abcé_", min_size=1, max_size=6), min_size=1, max_size=8, unique=True),
    st.integers(1, 9),
    st.tuples(*[st.booleans()] * 3),
    st.text("xy", max_size=9),
    st.integers(0, 100),
)
def test_the_column_is_what_the_general_decoder_says(joints, points, gives, frame, stamp):
    message = trajectory(joints, points, (True, *gives), frame, stamp)
    raw = serialize_message(message)
    for joint in joints:
        assert column_from_bytes(raw, joint) == from_message(message).column(joint)
    assert column_from_bytes(raw, "another") is None


@given(
    st.text("xy", max_size=9),
    st.lists(st.tuples(*[st.booleans()] * 3), min_size=2, max_size=9),
    st.integers(1, 4),
)
def test_points_that_differ_in_their_arrays_are_taken_too(frame, gives, joints):
    names = "abcd"[:joints]
    message = trajectory(names, len(gives), (True, True, True, True), frame)
    for point, (velocities, accelerations, effort) in zip(message.points, gives, strict=True):
        point.velocities = point.velocities if velocities else []
        point.accelerations = point.accelerations if accelerations else []
        point.effort = point.effort if effort else []
    raw = serialize_message(message)
    for joint in names:
        assert column_from_bytes(raw, joint) == from_message(message).column(joint)


@pytest.mark.parametrize("is_mixed", [False, True])
def test_a_foreign_byte_order_says_the_same(is_mixed):
    message = trajectory("abc", 6, frame="world", stamp=7)
    if is_mixed:
        message.points[2].velocities = []
    store = get_typestore(Stores.ROS2_JAZZY)
    time, duration, header, point, kind = (
        store.types[name]
        for name in (
            "builtin_interfaces/msg/Time",
            "builtin_interfaces/msg/Duration",
            "std_msgs/msg/Header",
            "trajectory_msgs/msg/JointTrajectoryPoint",
            "trajectory_msgs/msg/JointTrajectory",
        )
    )
    points = [
        point(
            *(np.array(row) for row in (p.positions, p.velocities, p.accelerations, p.effort)),
            duration(p.time_from_start.sec, p.time_from_start.nanosec),
        )
        for p in message.points
    ]
    foreign = store.serialize_cdr(
        kind(header(time(7, 0), "world"), list("abc"), points),
        kind.__msgtype__,
        little_endian=False,
    )
    assert column_from_bytes(bytes(foreign), "b") == from_message(message).column("b")


def spoiled(index, **changes):
    message = trajectory("ab", 6, stamp=1)
    for name, value in changes.items():
        setattr(message.points[index], name, value)
    return message


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (spoiled(3, positions=[]), "point 3 must have 2 positions, not 0"),
        (spoiled(0, positions=[1.0]), "point 0 must have 2 positions, not 1"),
        (spoiled(4, positions=[0.0, float("nan")]), "must be finite, not nan for 'b'"),
        (spoiled(4, velocities=[float("inf"), 0.0]), "must be finite, not inf for 'a'"),
        (spoiled(5, accelerations=[1e300, 0.0]), "within 1e+09"),
        (spoiled(2, velocities=[1.0]), "0 or 2 velocities, not 1"),
        (spoiled(2, effort=[1.0]), "0 or 2 efforts, not 1"),
        (spoiled(2, effort=[1.0, float("nan")]), "efforts of point 2 must be finite, not nan"),
        (spoiled(3, time_from_start=Duration(sec=0)), "times must increase"),
        (spoiled(0, time_from_start=Duration(sec=-2)), "times must increase"),
        (trajectory("ab", 0), "at least one point"),
        (trajectory("aa", 2), "each of its joints once"),
        (trajectory("ab", 2, stamp=-1), "cannot start at"),
        (trajectory("ab", 2, (False, True, True, False)), "2 positions, not 0"),
    ],
)
def test_a_malformed_trajectory_is_refused_with_its_reason(message, reason):
    with pytest.raises(TrajectoryError, match=reason.replace("+", r"\+")) as refusal:
        column_from_bytes(serialize_message(message), "a")
    assert "\n" not in str(refusal.value)


@given(st.binary(max_size=400))
def test_random_bytes_raise_nothing_but_the_errors_of_this_package(raw):
    for decode in (decode_float64, lambda each: column_from_bytes(each, "a")):
        with contextlib.suppress(HpidError):
            decode(raw)


@given(st.data())
def test_flipped_and_truncated_trajectories_raise_nothing_but_these_errors(data):
    raw = bytearray(serialize_message(trajectory("ab", 4)))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(raw)))
    with contextlib.suppress(HpidError):
        column_from_bytes(bytes(raw[:cut]), "a")


def repeated(message, points):
    """Return the bytes of a trajectory with its last point again and again, without objects."""
    shorter, longer = (serialize_message(trajectory("ab", k)) for k in (4, 5))
    size = len(longer) - len(shorter)
    at = bytes(shorter).index((4).to_bytes(4, "little") + (2).to_bytes(4, "little"))
    raw = bytearray(shorter)
    raw[at : at + 4] = points.to_bytes(4, "little")
    return bytes(raw) + bytes(longer[-size:]) * (points - 4)


def test_a_million_points_are_refused_at_once_and_the_most_that_are_taken_cost_little(faults):
    for points, reason in (100_000, f"{LIVE.points} points"), (1_000_000, f"{LIVE.size} bytes"):
        with pytest.raises(MessageError, match=f"may have {reason}, not"):
            column_from_bytes(repeated("ab", points), "a")
    message = trajectory("abcdef", 2000)
    raw = serialize_message(message)
    began = time.thread_time()
    column_from_bytes(raw, "a")
    each = (time.thread_time() - began) / 2000
    assert each * LIVE.points < 1.0  # [s]; measured below 0.1
    mixed = trajectory("ab", LIVE.mixed_points + 1)
    mixed.points[7].velocities = []
    with pytest.raises(
        MessageError, match=f"{LIVE.mixed_points} points that differ in their arrays"
    ):
        column_from_bytes(serialize_message(mixed), "a")
    faults.count("trajectory points refused", 1_000_000 + LIVE.mixed_points + 1)
