"""Writes a bag as a robot of eight joints leaves it: states and stamped commands at 1 kHz.

Run it as ``python benchmarks/generate_bag.py BAG --minutes 6``; an hour is about 4.4 GB. Stamps
jitter as a real clock's do, commands come in any order, and every number is drawn from the seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion import JointTrajectory, TrajectoryPoint

JOINTS = ("wheel_left", "wheel_right", *(f"arm_joint_{number}" for number in range(1, 7)))
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_000_000
STAMP_JITTER_NS = 20_000
BLOCK = 10_000
"""States that are drawn at once."""


def messages(minutes: float, seed: int = 0) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time in [ns] and bytes of every message.

    Args:
        minutes: Length of the recording, in [min].
        seed: Of the numbers.
    """
    random = np.random.default_rng(seed)
    states = JointStateTemplate(JOINTS, position=True, effort=True)
    commands = [JointStateTemplate([joint], effort=True) for joint in JOINTS]
    yield "/joint_trajectory", START_NS, encode_joint_trajectory(_trajectory(minutes))
    count = round(minutes * 60_000)
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        ticks = START_NS + PERIOD_NS * np.arange(first, first + size)
        stamps = (ticks + random.integers(0, STAMP_JITTER_NS, size)).tolist()
        positions = random.normal(0.0, 1.0, (size, len(JOINTS))).tolist()
        efforts = random.normal(0.0, 10.0, (size, len(JOINTS))).tolist()
        orders = random.permuted(np.tile(np.arange(len(JOINTS)), (size, 1)), axis=1).tolist()
        for stamp, position, effort, order in zip(stamps, positions, efforts, orders, strict=True):
            yield (
                "/joint_states",
                stamp + 50_000,
                states.encode(stamp, position=position, effort=effort),
            )
            for place, joint in enumerate(order):
                raw = commands[joint].encode(stamp, effort=(effort[joint],))
                yield "/joint_commands", stamp + 100_000 + 9_000 * place, raw


def generate(bag: Path, minutes: float, storage: str = "mcap", compression: str = "none") -> None:
    """Write a bag.

    Args:
        bag: The new folder.
        minutes: Length of the recording, in [min].
        storage: ``"mcap"`` or ``"sqlite3"``.
        compression: ``"none"``, ``"storage"`` (chunks of MCAP), ``"file"`` or ``"message"``.
    """
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    types["/joint_trajectory"] = JOINT_TRAJECTORY
    if (storage, compression) == ("mcap", "none"):
        with BagWriter(bag) as ours:
            topics = {name: ours.add_topic(name, kind) for name, kind in types.items()}
            for name, log_time_ns, raw in messages(minutes):
                ours.write(topics[name], log_time_ns, raw)
        return
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression != "none":
        mode = CompressionMode[compression.upper()]
        writer.set_compression(mode, CompressionFormat.ZSTD)
    store = get_typestore(Stores.ROS2_JAZZY)
    with writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in types.items()
        }
        for name, log_time_ns, raw in messages(minutes):
            writer.write(connections[name], log_time_ns, raw)


def _trajectory(minutes: float) -> JointTrajectory:
    points = tuple(
        TrajectoryPoint(
            second * 1_000_000_000,
            tuple(np.sin(0.5 * second + np.arange(len(JOINTS))).tolist()),
            (0.0,) * len(JOINTS),
        )
        for second in range(0, max(round(minutes * 60), 1) + 1)
    )
    return JointTrajectory(JOINTS, points)


def main() -> None:
    """Write the bag that the command line describes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag", type=Path, help="the new folder")
    parser.add_argument("--minutes", type=float, default=6.0, help="length in minutes")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument(
        "--compression", choices=("none", "storage", "file", "message"), default="none"
    )
    options = parser.parse_args()
    generate(options.bag, options.minutes, options.storage, options.compression)


if __name__ == "__main__":
    main()
