"""Bags as other people's recorders write them, message by message."""

from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from harness.bags import TYPES, S, command, serialised, state
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection

FLOAT64 = "std_msgs/msg/Float64"
LATENCY = 2000  # [ns]


def float64(value: float) -> bytes:
    return serialised(FLOAT64, value)


def write(path: Path, types, log, store=TYPES) -> Path:
    """Write ``(topic, log time, raw)``."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in types.items()
        }
        for name, log_time_ns, raw in log:
            writer.write(connections[name], log_time_ns, raw)
    return path


def states(count: int = 5, topic: str = "/joint_states", offset: float = 0.0):
    """Return states of a and b, one a second from 1 s on, received 2 us after their stamps."""
    return [
        (topic, k * S + LATENCY, state(k * S, a=k + offset, b=-k - offset)[2])
        for k in range(1, count + 1)
    ]


def commands(count: int = 5, topic: str = "/joint_commands"):
    return [
        (topic, k * S + 2 * LATENCY, command(k * S, **{j: 10.0 * k})[2])
        for k in range(1, count + 1)
        for j in "ab"
    ]


def read(path: Path, **selection):
    return read_run(path, "run", selection=BagSelection(**selection))


def in_order(log):
    return sorted(log, key=lambda message: message[1])
