"""The bag writer against rosbags' own writer fed directly."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from benchmarks.figures import Figure, Group, Source
from benchmarks.measuring import time_per_item
from benchmarks.tracking import tracking
from hpid_ros.messages.columns import JOINT_STATE
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.writer import BagWriter, jazzy_types

TOPIC = "/joint_states"

_MESSAGES, _MESSAGES_QUICK = 200_000, 20_000
_BETWEEN_NS = 111_111  # log time between two messages: nine a millisecond, as in the experiment


def group(quick: bool) -> Group:
    """Return the figure of the recorder."""
    messages = _joint_states(_MESSAGES_QUICK if quick else _MESSAGES)
    jazzy_types()  # made once, and not what is measured

    def ours() -> Mapping[str, float]:
        return _in_a_folder(lambda path: _write_with_ours(path, messages), len(messages))

    def peer() -> Mapping[str, float]:
        return _in_a_folder(lambda path: _write_with_rosbags(path, messages), len(messages))

    figure = Figure(
        "recorder.rate",
        "messages/s",
        Source("BagWriter.write", "rate"),
        Source("rosbags Writer.write", "rate"),
        "rosbags' writer (MCAP) fed directly",
    )
    return Group({"BagWriter.write": ours, "rosbags Writer.write": peer}, (figure,))


def _joint_states(count: int) -> list[bytes]:
    joints = tracking().world.joints
    template = JointStateTemplate(joints, position=True, effort=True)
    return [
        template.encode(k * _BETWEEN_NS, position=[1e-6 * k] * len(joints), effort=[0.1] * 8)
        for k in range(count)
    ]


def _in_a_folder(write: Callable[[Path], object], count: int) -> Mapping[str, float]:
    """Time writing a whole bag, its opening and its index included."""
    folder = Path(tempfile.mkdtemp(prefix="hpid_bench_"))
    try:
        return {"rate": 1.0 / time_per_item(lambda: write(folder / "bag"), count)}
    finally:
        shutil.rmtree(folder)


def _write_with_ours(path: Path, messages: list[bytes]) -> None:
    with BagWriter(path) as writer:
        topic, write = writer.add_topic(TOPIC, JOINT_STATE), writer.write
        for k, raw in enumerate(messages):
            write(topic, k * _BETWEEN_NS, raw)


def _write_with_rosbags(path: Path, messages: list[bytes]) -> None:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(TOPIC, JOINT_STATE, typestore=jazzy_types())
        write = writer.write
        for k, raw in enumerate(messages):
            write(connection, k * _BETWEEN_NS, raw)
