"""Time and memory by size, of what strangers may send: ``python -m benchmarks.bounds [WHAT ...]``.

Four sizes each, every one twice the one before: joints, keys, points, messages. Printed are the
processor's time and the most memory for each item, and how many times those of the smallest size
they are: 1 is in proportion, 2 from one size to the next the square. Exit codes: 0 all are in
proportion, 1 one is not, 2 unusable arguments, 130 interrupted.
"""

from __future__ import annotations

import argparse
import gc
import struct
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.processes import FAILED, exit_code
from hpid_ros.base.errors import ExperimentError, HpidError, require_known
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.messages.bounds import RECORDED
from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointReader, JointStateTemplate, Writer
from hpid_ros.messages.joint_trajectory import decode_trajectory, encode_trajectory
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.writer import BagWriter
from hpid_ros.metrics.measure import Measuring, measure
from hpid_ros.robot.description import RobotDescription

SIZES = 4
MOST = 2.5
"""How many times the cost of an item may grow over eight times the size; a square gives 8."""

_TURNS = 3  # the least of them counts
_PERIOD_NS = 1_000_000
_START_NS = 1_700_000_000_000_000_000
_HEADER = f"{'what':32s}{'items':>9s}{'us/item':>10s}{'times':>7s}{'bytes/item':>12s}{'times':>7s}"


class Case(NamedTuple):
    """Something that is read, in a size."""

    first: int  # its smallest size, in items
    make: Callable[[Path, int], Callable[[], object]]  # writes it, and returns what reads it


def _state(_: Path, joints: int) -> Callable[[], object]:
    names = [f"joint_{number}" for number in range(joints)]
    raw = JointStateTemplate(names, position=True).encode(1, position=[0.0] * joints)
    return lambda: JointReader(names[-1]).read(raw)


def _recorded_joints(folder: Path, joints: int) -> Callable[[], object]:
    names = [f"joint_{number}" for number in range(joints)]
    template = JointStateTemplate(names, position=True)
    return _measured(
        folder,
        (
            (
                JOINT_STATE,
                _START_NS + k * _PERIOD_NS,
                template.encode(k + 1, position=[0.1] * joints),
            )
            for k in range(3)
        ),
    )


def _recorded_messages(folder: Path, count: int) -> Callable[[], object]:
    template = JointStateTemplate(["elbow", "wrist"], position=True)
    stamps = range(_START_NS, _START_NS + count * _PERIOD_NS, _PERIOD_NS)
    return _measured(
        folder,
        ((JOINT_STATE, each, template.encode(each, position=[0.1, 0.2])) for each in stamps),
    )


def _recorded_trajectories(folder: Path, count: int) -> Callable[[], object]:
    template = JointStateTemplate(["elbow"], position=True)
    times_ns, none = np.arange(1, 11) * _PERIOD_NS, np.full((10, 1), np.nan)
    messages = []
    for stamp_ns in range(_START_NS, _START_NS + count * _PERIOD_NS, _PERIOD_NS):
        arrays = (np.full((10, 1), 0.1), none, none, none)
        raw = encode_trajectory(stamp_ns, ["elbow"], times_ns, arrays)
        messages.append((JOINT_TRAJECTORY, stamp_ns, raw))
        messages.append((JOINT_STATE, stamp_ns, template.encode(stamp_ns, position=[0.1])))
    return _measured(folder, messages, reference="auto")


def _measured(
    folder: Path, messages: Iterable[tuple[str, int, bytes]], reference: str = "hold"
) -> Callable[[], object]:
    """Write a bag, and return what computes its indices."""
    names = {JOINT_STATE: "/joint_states", JOINT_TRAJECTORY: "/joint_trajectory"}
    with BagWriter(folder / "bag") as writer:
        topics = {kind: writer.add_topic(name, kind) for kind, name in names.items()}
        for kind, stamp_ns, raw in messages:
            writer.write(topics[kind], stamp_ns, raw)
    how = Measuring(BagSelection(reference=reference), keeps_series=False)
    return lambda: measure(folder / "bag", "bag", how)


def _urdf(folder: Path, joints: int) -> Callable[[], object]:
    moments = "".join(f' {name}="{int(name[1] == name[2])}"' for name in _MOMENTS)
    body = f'<inertial><mass value="1"/><inertia{moments}/></inertial>'
    links = "".join(f'<link name="link_{number}">{body}</link>' for number in range(joints + 1))
    each = "".join(
        f'<joint name="joint_{number}" type="continuous"><parent link="link_0"/>'
        f'<child link="link_{number + 1}"/></joint>'
        for number in range(joints)
    )
    text = f'<robot name="robot">{links}{each}</robot>'
    names = [f"joint_{number}" for number in range(joints)]
    return lambda: RobotDescription.load(text).select(names)


_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def _keys(folder: Path, count: int, key: Callable[[int], object] = str) -> Callable[[], object]:
    file = folder / "document.yaml"
    file.write_text("".join(f"{key(number)}: 0\n" for number in range(count)))
    return lambda: _refused(lambda: load_yaml(file, ExperimentError))


def _keys_of_one_hash(folder: Path, count: int) -> Callable[[], object]:
    return _keys(folder, count, lambda number: number * sys.hash_info.modulus)


def _points(_: Path, points: int) -> Callable[[], object]:
    names = [f"joint_{number}" for number in range(6)]
    values = np.random.default_rng(1).normal(size=(points, len(names)))
    raw = encode_trajectory(1, names, np.arange(1, points + 1), (values,) * 4)

    def read() -> object:
        decoded = decode_trajectory(raw, RECORDED)
        decoded.require()
        return decoded.column("joint_3")

    return read


def _points_without_numbers(_: Path, count: int) -> Callable[[], object]:
    """As many names without a letter, in a message that once took the product of both."""
    writer = Writer()
    for code, value in ("i", 0), ("I", 0), ("I", 0), ("I", count):
        writer.scalar(code, value)
    raw = writer.raw + bytes(4 * count) + struct.pack("<I", count) + bytes(24 * count)
    return lambda: _refused(lambda: decode_trajectory(raw, RECORDED))


def _refused(read: Callable[[], object]) -> object:
    with suppress(HpidError):
        return read()
    return None


CASES: Mapping[str, Case] = {
    "joints of a state": Case(2000, _state),
    "joints of a bag": Case(250, _recorded_joints),
    "joints of a URDF": Case(125, _urdf),
    "keys": Case(5000, _keys),
    "keys of one hash": Case(5000, _keys_of_one_hash),
    "points": Case(10_000, _points),
    "points without numbers": Case(5000, _points_without_numbers),
    "messages of a bag": Case(20_000, _recorded_messages),
    "trajectories of a bag": Case(250, _recorded_trajectories),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name, or all."""
    options = _parser().parse_args(arguments)

    def run() -> int:
        require_known("case", options.what, CASES)
        print(_HEADER)
        grown = [name for name in options.what or CASES if not _is_in_proportion(name)]
        if grown:
            print(f"more than in proportion: {', '.join(grown)}")
        return FAILED if grown else 0

    return exit_code("bounds", run)


def _is_in_proportion(name: str) -> bool:
    """Measure a case in all sizes, print them, and tell whether none costs too much."""
    case, least = CASES[name], None
    worst = 0.0
    for turn in range(SIZES):
        size = case.first << turn
        with tempfile.TemporaryDirectory(prefix="hpid_bounds_") as folder:
            cost = [each / size for each in costs(case.make(Path(folder), size))]
        least = least or cost
        times = [one / first for one, first in zip(cost, least, strict=True)]
        worst = max(worst, *times)
        time_cells = f"{cost[0] * 1e6:10.2f}{times[0]:7.2f}"
        print(f"{name:32s}{size:9d}{time_cells}{cost[1]:12.0f}{times[1]:7.2f}", flush=True)
    return worst <= MOST


def costs(read: Callable[[], object]) -> tuple[float, float]:
    """Return the processor's time [s] and the most memory [bytes] of reading something."""
    read()  # what is made once is made
    times = []
    for _ in range(_TURNS):
        gc.collect()
        begun = time.process_time()
        read()
        times.append(time.process_time() - begun)
    tracemalloc.start()
    try:
        read()
        return min(times), float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bounds", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    listed = ", ".join(CASES)
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"one of: {listed}; all")
    return parser


if __name__ == "__main__":
    sys.exit(main())
