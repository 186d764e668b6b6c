"""Messages and bags for tests, built from numbers, and read by readers not of the package."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mcap.writer
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.messages import PARAMETER_EVENTS
from hpid_ros.messages.reports import ODOMETRY, Stamp, encode_odometry
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import JointSeries, Losses
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion import JointTrajectory, TrajectoryPoint

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
KINDS = {
    "joint_states": JOINT_STATE,
    "joint_commands": JOINT_STATE,
    "joint_trajectory": JOINT_TRAJECTORY,
}
FLOATS = "std_msgs/msg/Float64MultiArray"
TYPES = get_typestore(Stores.ROS2_JAZZY)
S = 1_000_000_000
MS = 1_000_000

Log = Sequence[tuple[str, int, bytes]]


class Message(NamedTuple):
    topic: str
    log_time_ns: int
    raw: bytes


class BagReader(Reader):
    """A bag as rosbags reads it."""

    def messages(self):
        for connection, log_time_ns, raw in super().messages():
            yield Message(connection.topic, log_time_ns, bytes(raw))


def state(stamp_ns: int, **positions: float) -> tuple[str, int, bytes]:
    template = JointStateTemplate(list(positions), position=True)
    return "joint_states", stamp_ns, template.encode(stamp_ns, position=list(positions.values()))


def command(stamp_ns: int, **efforts: float) -> tuple[str, int, bytes]:
    template = JointStateTemplate(list(efforts), effort=True)
    return "joint_commands", stamp_ns, template.encode(stamp_ns, effort=list(efforts.values()))


def odometry(stamp_ns: int, way: float) -> tuple[str, int, bytes]:
    """Return where a base is that rolls straight on."""
    pose = (way, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    nothing, still = [0.0] * 36, ((0.0,) * 3,) * 2
    raw = encode_odometry(Stamp(stamp_ns, "odom"), "base", pose, nothing, still, nothing)
    return "odom", stamp_ns, raw


def trajectory(log_time_ns: int, what: JointTrajectory) -> tuple[str, int, bytes]:
    types = TYPES.types
    time, duration = types["builtin_interfaces/msg/Time"], types["builtin_interfaces/msg/Duration"]
    header = types["std_msgs/msg/Header"](time(*divmod(what.stamp_ns, S)), "")
    points = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            np.array(point.positions),
            np.array(point.velocities),
            np.array(point.accelerations),
            np.zeros(0),
            duration(*divmod(point.time_from_start_ns, S)),
        )
        for point in what.points
    ]
    message = types[JOINT_TRAJECTORY](header, list(what.joint_names), points)
    raw = TYPES.serialize_cdr(message, JOINT_TRAJECTORY)
    return "joint_trajectory", log_time_ns, bytes(raw)


def ramp(joint: str, *, stamp_ns: int = 0, **at_seconds: float) -> JointTrajectory:
    """Return a piecewise linear trajectory; ``t2=5.0`` is 5 rad two seconds after the start."""
    points = tuple(
        TrajectoryPoint(int(time[1:]) * S, (position,)) for time, position in at_seconds.items()
    )
    return JointTrajectory((joint,), points, stamp_ns)


def write_bag(path: Path, log: Log, namespace: str = "/") -> Path:
    kinds = dict(KINDS)
    if any(name == "odom" for name, _, _ in log):
        kinds["odom"] = ODOMETRY
    with BagWriter(path) as bag:
        topics = {name: bag.add_topic(namespace + name, kind) for name, kind in kinds.items()}
        for name, log_time_ns, raw in log:
            bag.write(topics[name], log_time_ns, raw)
    return path


def write_mcap(path: Path, log, *, end: bool = True, **options) -> Path:
    """Write ``(topic, log time, raw)``; without the end as after a recorder that was killed."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, chunk_size=2000, **options)
        writer.start("ros2", "test")
        schemas = {
            kind: writer.register_schema(kind, "ros2msg", b"float64 x")
            for kind in sorted(set(KINDS.values()))
        }
        channels = {
            name: writer.register_channel(f"/{name}", "cdr", schemas[kind])
            for name, kind in KINDS.items()
        }
        for name, log_time_ns, raw in log:
            writer.add_message(channels[name], log_time_ns, raw, log_time_ns)
        if end:
            writer.finish()
    return path


def convert(source: Path, target: Path, storage: StoragePlugin, mode: CompressionMode) -> None:
    """Write the same messages with rosbags alone."""
    writer = Writer(target, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer, BagReader(source) as bag:
        connections = {
            name: writer.add_connection(
                name,
                topic.msgtype,
                typestore=TYPES,
                offered_qos_profiles=topic.connections[0].ext.offered_qos_profiles,
            )
            for name, topic in bag.topics.items()
        }
        for name, log_time_ns, raw in bag.messages():
            writer.write(connections[name], log_time_ns, raw)


def serialised(kind: str, *values: object, **named: object) -> bytes:
    """Return a message in CDR."""
    return bytes(TYPES.serialize_cdr(TYPES.types[kind](*values, **named), kind))


def floats(*values: float) -> bytes:
    layout = TYPES.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return serialised(FLOATS, layout, np.array(values))


VALUES = {bool: "bool_value", int: "integer_value", float: "double_value", str: "string_value"}


def parameter_event(node: str, **changes: object) -> bytes:
    """Return an event of changed parameters; in their names ``__`` stands for a dot."""
    types, none = TYPES.types, np.empty(0)
    arrays = dict.fromkeys(
        (f"{k}_array_value" for k in ("byte", "bool", "integer", "double")), none
    )
    unset = {field: kind() for kind, field in VALUES.items()} | arrays | {"string_array_value": []}
    changed = []
    for name, value in changes.items():
        own = {"type": 1 + list(VALUES).index(type(value)), VALUES[type(value)]: value}
        content = types["rcl_interfaces/msg/ParameterValue"](**unset | own)
        changed.append(types["rcl_interfaces/msg/Parameter"](name.replace("__", "."), content))
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    return serialised(PARAMETER_EVENTS, stamp, node, [], changed, [])


def small_log(scale: float = 1.0, count: int = 60) -> list[tuple[str, int, bytes]]:
    log = [trajectory(0, ramp("a", t0=0.0, t1=1.0))]
    for k in range(1, count):
        position, effort = scale * k * 0.1, scale * k * 0.01
        log += [state(k * 20 * MS, a=position, b=0.0), command(k * 20 * MS, a=effort)]
    return log


def read_one(path: Path, log: Log, joint: str = "a") -> tuple[JointSeries, Losses]:
    """Write a log, and return what is read of one joint of it."""
    run = read_run(write_bag(path, log), "run", joints=[joint])
    return run.joints[0], run.losses[joint]


def bits(values: Sequence[float]) -> bytes:
    """Return every bit of some numbers."""
    return struct.pack(f"<{len(values)}d", *values)
