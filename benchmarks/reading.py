"""From a bag to arrays, against rosbags deserialising it and against reading its bytes.

The bag is as a robot of eight joints leaves it: states and stamped commands at 1 kHz. Stamps
jitter as a real clock's do, commands come in any order, and every number is drawn from the seed.
Each turn has a process of its own: ``python -m benchmarks.reading CONTENDER BAG``.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.processes import ROOT
from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.messages.mcap_file import zstd_library
from hpid_ros.messages.run import read_run
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion import JointTrajectory, TrajectoryPoint

MIB = 1 << 20
_MINUTES, _MINUTES_QUICK = 2.0, 0.1
_ROUNDS_AT_MOST = 3  # rosbags takes ten seconds and more a turn
_KINDS = {
    "mcap": ("mcap", "none"),
    "mcap_zstd": ("mcap", "storage"),
    "sqlite3": ("sqlite3", "none"),
}


def group(quick: bool) -> Group:
    """Return the figures of reading."""
    minutes = _MINUTES_QUICK if quick else _MINUTES
    contenders: dict[str, Measure] = {}
    figures = []
    for kind in _KINDS:
        for name in ("arrays", "messages", "bytes"):
            contenders[f"{name}, {kind}"] = partial(_turn, name, kind, minutes)
        figures += _figures(kind)
    for name in PEERS:
        if find_spec(PEERS[name][0]) is not None:
            contenders[f"{name}, mcap"] = partial(_turn, name, "mcap", minutes)
            figures.append(_against(name))
    return Group(contenders, tuple(figures), rounds_at_most=_ROUNDS_AT_MOST)


def _figures(kind: str) -> list[Figure]:
    arrays = f"arrays, {kind}"
    return [
        Figure(
            f"bags.{kind}",
            "messages/s",
            Source(arrays, "rate"),
            Source(f"messages, {kind}", "rate"),
            "rosbags deserialising every message",
            (Bound("ratio", least=20.0),),
            ("peak",),
        ),
        Figure(
            f"bags.{kind}.bytes",
            "s",
            Source(arrays, "seconds"),
            Source(f"bytes, {kind}", "seconds"),
            "reading and decompressing the file, which the page cache holds",
            (Bound("ratio", most=2.0),),
        ),
    ]


def _against(name: str) -> Figure:
    return Figure(
        f"bags.mcap.{name.replace('-', '_')}",
        "s",
        Source("arrays, mcap", "seconds"),
        Source(f"{name}, mcap", "seconds"),
        f"{name}, every state and command",
        (Bound("ratio", most=1.0),),
    )


@cache
def _bag(kind: str, minutes: float) -> tuple[Path, tempfile.TemporaryDirectory[str]]:
    """Return a generated bag, and the folder that must live as long."""
    storage, compression = _KINDS[kind]
    folder = tempfile.TemporaryDirectory(prefix="hpid_bench_")
    bag = Path(folder.name) / "bag"
    generate(bag, minutes, storage, compression)
    return bag, folder


def _turn(name: str, kind: str, minutes: float) -> Mapping[str, float]:
    """Let one contender read the bag in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.reading", name, str(_bag(kind, minutes)[0])]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    result: Mapping[str, float] = json.loads(done.stdout)
    return result


def read_bytes(bag: Path) -> int:
    """Read and decompress everything, without looking at it; return the number of bytes."""
    count, unpack = 0, zstd_library().decompress
    for path in sorted(bag.iterdir()):
        if path.suffix == ".mcap":
            with path.open("rb") as stream:
                summary = make_reader(stream).get_summary()
                for chunk in summary.chunk_indexes if summary else ():
                    stream.seek(
                        chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size
                    )
                    raw = stream.read(chunk.compressed_size)
                    count += len(unpack(raw) if chunk.compression else raw)
        elif path.suffix == ".db3":
            with path.open("rb", buffering=0) as stream:
                while block := stream.read(MIB):
                    count += len(block)
    return count


def read_arrays(bag: Path) -> int:
    """Read the run; return its number of states and commands."""
    run = read_run(bag, "run")
    return len(run.joints[0].position) + sum(len(joint.effort) for joint in run.joints)


def read_messages(bag: Path) -> int:
    """Deserialise every state and command with rosbags; return their number."""
    count = 0
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/JointState"]
        for connection, _, raw in reader.messages(wanted):
            reader.deserialize(raw, connection.msgtype)
            count += 1
    return count


_TOPICS = ("/joint_states", "/joint_commands")


def _file_of(bag: Path) -> Path:
    (file,) = bag.glob("*.mcap")
    return file


def read_with_mcap_ros2(bag: Path) -> int:
    """Decode every state and command with mcap-ros2-support; return their number."""
    from mcap_ros2.reader import read_ros2_messages

    return sum(1 for _ in read_ros2_messages(str(_file_of(bag)), topics=_TOPICS))


def read_with_small_mcap(bag: Path) -> int:
    """Decode them with small-mcap and mcap-ros2-support-fast."""
    from mcap_ros2_support_fast.decoder import DecoderFactory
    from small_mcap import include_topics, read_message_decoded

    with _file_of(bag).open("rb") as stream:
        messages = read_message_decoded(
            stream,
            decoder_factories=[DecoderFactory()],
            should_include=include_topics(list(_TOPICS)),
        )
        return sum(1 for each in messages if each.decoded_message is not None)


def read_with_arrow(bag: Path) -> int:
    """Decode them with roboto-mcap-codec into Arrow's columns; return the number of rows."""
    import mcap_codec

    count = 0
    with _file_of(bag).open("rb") as stream:

        def read(offset: int, length: int) -> bytes:
            stream.seek(offset)
            return stream.read(length)

        size = _file_of(bag).stat().st_size
        for topic in _TOPICS:
            with mcap_codec.open_mcap_file(
                read,
                size,
                channel=mcap_codec.TopicName(topic),
                timestamp=mcap_codec.TimestampSource("message_log_time"),
            ) as cursor:
                count += sum(batch.num_rows for batch in cursor)
    return count


PEERS: dict[str, tuple[str, Callable[[Path], int]]] = {
    "roboto-mcap-codec": ("mcap_codec", read_with_arrow),
    "small-mcap": ("mcap_ros2_support_fast", read_with_small_mcap),
    "mcap-ros2-support": ("mcap_ros2", read_with_mcap_ros2),
}
"""Other readers, each with the module that it needs: measured where they are installed."""

CONTENDERS: dict[str, Callable[[Path], int]] = {
    "bytes": read_bytes,
    "arrays": read_arrays,
    "messages": read_messages,
    **{name: read for name, (_, read) in PEERS.items()},
}


def take_turn(name: str, bag: Path) -> dict[str, float]:
    """Run one contender in this process; return its CPU time in [s], rate and peak in [MiB]."""
    begun = time.process_time()
    count = CONTENDERS[name](bag)
    seconds = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"seconds": seconds, "rate": count / seconds, "peak": peak}


JOINTS = ("wheel_left", "wheel_right", *(f"arm_joint_{number}" for number in range(1, 7)))
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_000_000
STAMP_JITTER_NS = 20_000
BLOCK = 10_000
"""States that are drawn at once."""


def messages(minutes: float, seed: int = 0) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time in [ns] and bytes of every message."""
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


def generate(bag: Path, minutes: float, storage: str, compression: str) -> None:
    """Write a bag."""
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


if __name__ == "__main__":
    print(json.dumps(take_turn(sys.argv[1], Path(sys.argv[2]))))
