"""``hpid metrics`` on large recordings, the whole process: time and memory.

Two recordings of thirty joints at 1 kHz. In ``joints`` each tick has a state and a command of each
joint, as a robot of many controllers leaves it; in ``states`` there are states alone, 1.5 kB each,
with measured efforts: as many as make 1 GB. What ``hpid metrics`` takes is compared with a loop of
rosbags over the same file that looks at nothing, and its memory with an interpreter that has
imported numpy.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.processes import ROOT
from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion import JointTrajectory, TrajectoryPoint

JOINTS = tuple(f"a_robots_arm_joint_{number}" for number in range(1, 31))
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_000_000
_MOST = 660_000  # messages
_QUICK = 20
"""By which a quick turn has fewer."""
_ROUNDS_AT_MOST = 3
_BEGIN = """
import atexit, sys
def tell(file=sys.argv.pop(1)):  # not by rusage, which has the parent's peak, too
    lines = open("/proc/self/status").read().splitlines()
    open(file, "w").write(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
atexit.register(tell)
"""
_NUMPY = "import numpy"
_LOOP = """
from pathlib import Path
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    for _ in reader.messages():
        pass
"""
_METRICS = """
from hpid_bench.cli.main import main
sys.exit(main(["metrics", *sys.argv[1:]]))
"""


def group(quick: bool) -> Group:
    """Return the figures of large recordings."""
    count = _MOST // _QUICK if quick else _MOST
    contenders: dict[str, Measure] = {"numpy": partial(_process, _NUMPY)}
    for shape in ("joints", "states"):
        for storage in ("mcap", "sqlite3"):
            for name in ("metrics", "report", "loop"):
                contenders[f"{name}, {shape}, {storage}"] = partial(
                    _turn, name, shape, storage, count
                )
    return Group(contenders, tuple(_figures()), rounds_at_most=_ROUNDS_AT_MOST)


def _figures() -> Iterator[Figure]:
    for shape in ("joints", "states"):
        for storage in ("mcap", "sqlite3"):
            ours = f"metrics, {shape}, {storage}"
            yield Figure(
                f"large.{shape}.{storage}",
                "s",
                Source(ours, "seconds"),
                Source(f"loop, {shape}, {storage}", "seconds"),
                "a loop of rosbags that looks at nothing",
                (Bound("ratio", most=2.0),),
                ("peak",),
            )
            yield Figure(
                f"large.{shape}.{storage}.report",
                "s",
                Source(f"report, {shape}, {storage}", "seconds"),
                Source(ours, "seconds"),
                "hpid metrics without a report",
                (Bound("ratio", most=1.5),),
                ("peak",),
            )
        yield Figure(
            f"large.{shape}.memory",
            "MiB",
            Source(f"report, {shape}, mcap", "peak"),
            Source("numpy", "peak"),
            "an interpreter with numpy",
            (Bound("ours", most=300.0),),
        )
        yield Figure(
            f"large.{shape}.storages",
            "s",
            Source(f"metrics, {shape}, sqlite3", "seconds"),
            Source(f"metrics, {shape}, mcap", "seconds"),
            "hpid metrics of MCAP",
            (Bound("ratio", most=1.5),),
        )


@cache
def _bag(shape: str, storage: str, count: int) -> tuple[Path, tempfile.TemporaryDirectory[str]]:
    """Return a generated bag, and the folder that must live as long."""
    folder = tempfile.TemporaryDirectory(prefix="hpid_bench_")
    bag = Path(folder.name) / "bag"
    generate(bag, shape, storage, count)
    return bag, folder


def _turn(name: str, shape: str, storage: str, count: int) -> Mapping[str, float]:
    bag = str(_bag(shape, storage, count)[0])
    if name == "loop":
        return _process(_LOOP, bag)
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
        report = ["--report", f"{folder}/report.html"] if name == "report" else []
        return _process(_METRICS, bag, "--format", "json", *report)


def _process(code: str, *arguments: str) -> Mapping[str, float]:
    """Run Python; return its processor time and wall time in [s], and its peak in [MiB]."""
    with tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder:
        peak, begun = Path(folder) / "peak", time.perf_counter()
        child = subprocess.Popen(
            [sys.executable, "-c", _BEGIN + code, str(peak), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - begun
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise RuntimeError(f"{' '.join(arguments)[:200]}: {child.returncode}")
        seconds = usage.ru_utime + usage.ru_stime
        return {"seconds": seconds, "wall": wall, "peak": int(peak.read_text()) / 1024}


def messages(shape: str, count: int, seed: int = 0) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time in [ns] and bytes of so many messages."""
    random = np.random.default_rng(seed)
    states = JointStateTemplate(JOINTS, position=True, velocity=True, effort=True)
    commands = [JointStateTemplate([joint], effort=True) for joint in JOINTS]
    per_tick = 1 if shape == "states" else 1 + len(JOINTS)
    ticks = count // per_tick
    yield "/joint_trajectory", START_NS, encode_joint_trajectory(_trajectory(ticks))
    for tick in range(ticks):
        stamp = START_NS + PERIOD_NS * tick
        noise, velocity, effort = random.normal(0.0, 1.0, (3, len(JOINTS))).tolist()
        position = [
            math.sin(5e-4 * tick + joint) + 1e-4 * each for joint, each in enumerate(noise)
        ]
        raw = states.encode(stamp, position=position, velocity=velocity, effort=effort)
        yield "/joint_states", stamp + 50_000, raw
        for place, joint in enumerate(commands if shape == "joints" else ()):
            raw = joint.encode(stamp, effort=(effort[place],))
            yield "/joint_commands", stamp + 100_000 + 9_000 * place, raw


def generate(bag: Path, shape: str, storage: str, count: int) -> None:
    """Write a bag."""
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    types["/joint_trajectory"] = JOINT_TRAJECTORY
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(bag, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        topics = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in types.items()
            if shape == "joints" or name != "/joint_commands"
        }
        for name, log_time_ns, raw in messages(shape, count):
            writer.write(topics[name], log_time_ns, raw)


def _trajectory(ticks: int) -> JointTrajectory:
    seconds = max(ticks * PERIOD_NS // 1_000_000_000, 1)
    points = tuple(
        TrajectoryPoint(
            second * 1_000_000_000,
            tuple(np.sin(0.5 * second + np.arange(len(JOINTS))).tolist()),
            (0.0,) * len(JOINTS),
        )
        for second in range(seconds + 1)
    )
    return JointTrajectory(JOINTS, points)
