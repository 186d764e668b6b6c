"""Reports are serialised as two other implementations do it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.messages import reports
from hpid_ros.messages.writer import jazzy_types

NUMBERS = st.floats(allow_nan=False)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
POSES = st.tuples(VECTORS, st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS))
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
HEADERS = st.builds(reports.Stamp, STAMPS, TEXTS)
COVARIANCES = st.lists(NUMBERS, min_size=36, max_size=36)


def new(kind, /, **values):
    return jazzy_types().types[kind](**values)


def serialised(kind, /, **values):
    return bytes(jazzy_types().serialize_cdr(new(kind, **values), kind))


def time(stamp_ns):
    return new(
        "builtin_interfaces/msg/Time",
        **dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True)),
    )


def header(stamp):
    return new("std_msgs/msg/Header", stamp=time(stamp.stamp_ns), frame_id=stamp.frame)


def numbered(kind, names, values):
    return new(f"geometry_msgs/msg/{kind}", **dict(zip(names, values, strict=True)))


def pose(values):
    point, turn = numbered("Point", "xyz", values[0]), numbered("Quaternion", "xyzw", values[1])
    return new("geometry_msgs/msg/Pose", position=point, orientation=turn)


@given(STAMPS)
def test_clock(stamp_ns):
    assert reports.encode_clock(stamp_ns) == serialised(reports.CLOCK, clock=time(stamp_ns))


@given(HEADERS, TEXTS, POSES, COVARIANCES, st.tuples(VECTORS, VECTORS), COVARIANCES)
def test_odometry(stamp, child, place, place_covariance, twist, twist_covariance):
    raw = reports.encode_odometry(stamp, child, place, place_covariance, twist, twist_covariance)
    linear, angular = (numbered("Vector3", "xyz", each) for each in twist)
    assert raw == serialised(
        reports.ODOMETRY,
        header=header(stamp),
        child_frame_id=child,
        pose=new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose(place),
            covariance=np.array(place_covariance),
        ),
        twist=new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=new("geometry_msgs/msg/Twist", linear=linear, angular=angular),
            covariance=np.array(twist_covariance),
        ),
    )


@given(HEADERS, VECTORS, st.lists(POSES, max_size=3))
def test_vectors_and_poses(stamp, vector, poses):
    values = {"header": header(stamp)}
    assert reports.encode_vector(stamp, vector) == serialised(
        reports.VECTOR, **values, vector=numbered("Vector3", "xyz", vector)
    )
    for each in poses:
        expected = serialised(reports.POSE, **values, pose=pose(each))
        assert reports.encode_pose(stamp, each) == expected
    expected = serialised(reports.POSES, **values, poses=[pose(each) for each in poses])
    assert reports.encode_poses(stamp, poses) == expected


@given(STAMPS, st.integers(0, 3), TEXTS, TEXTS, st.dictionaries(TEXTS, TEXTS, max_size=3))
def test_statuses(stamp_ns, level, name, message, values):
    status = new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=name,
        message=message,
        hardware_id="",
        values=[
            new("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in values.items()
        ],
    )
    raw = reports.encode_status(reports.Status(stamp_ns, level, name, message, values))
    of_array = header(reports.Stamp(stamp_ns, ""))
    assert raw == serialised(reports.STATUSES, header=of_array, status=[status])
