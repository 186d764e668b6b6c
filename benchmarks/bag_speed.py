"""The time from a bag to arrays, beside reading its bytes and beside rosbags on the same file.

Run it as ``python benchmarks/bag_speed.py --minutes 2``. Three contenders take turns, each in a
process of its own: ``bytes`` reads the file and decompresses it, ``arrays`` is
:func:`~hpid_ros.messages.run.read_run`, ``messages`` is rosbags, deserialising each message.
The figures are the medians over the rounds; ``--cold`` drops the file from the page cache before
each turn.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from hpid_ros.messages.batches import zstd_library
from hpid_ros.messages.run import read_run

MIB = 1 << 20


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


CONTENDERS: dict[str, Callable[[Path], int]] = {
    "bytes": read_bytes,
    "arrays": read_arrays,
    "messages": read_messages,
}


def take_turn(name: str, bag: Path) -> dict[str, float]:
    """Run one contender in this process and return what it took."""
    contender = CONTENDERS[name]
    wall, cpu = time.perf_counter(), time.process_time()
    count = contender(bag)
    return {
        "count": count,
        "wall": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def in_own_process(name: str, bag: Path, is_cold: bool) -> dict[str, float]:
    """Run one contender in a process of its own."""
    if is_cold:
        for path in bag.iterdir():
            descriptor = os.open(path, os.O_RDONLY)
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(descriptor)
    command = [sys.executable, __file__, "--turn", name, str(bag)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    result: dict[str, float] = json.loads(done.stdout)
    return result


def measure(bag: Path, rounds: int, is_cold: bool, names: list[str]) -> None:
    """Let the contenders take turns and print medians and ratios."""
    turns: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for _ in range(rounds):
        for name in names:
            turns[name].append(in_own_process(name, bag, is_cold))
    medians = {
        name: {key: statistics.median(turn[key] for turn in of_name) for key in of_name[0]}
        for name, of_name in turns.items()
    }
    for name, found in medians.items():
        print(
            f"{name:10s} {found['wall']:8.2f} s wall {found['cpu']:8.2f} s CPU "
            f"{found['peak']:6.0f} MiB peak  {found['count']:.0f}"
        )
    arrays = medians["arrays"]
    print(f"arrays     {arrays['count'] / arrays['cpu']:.3g} messages/s of CPU time")
    for clock in ("wall", "cpu"):
        line = f"{clock:4s}: arrays take {arrays[clock] / medians['bytes'][clock]:.2f} x bytes"
        if "messages" in medians:
            line += f", messages take {medians['messages'][clock] / arrays[clock]:.1f} x arrays"
        print(line)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=2.0, help="of generated data")
    parser.add_argument("--bag", type=Path, help="an existing bag instead of a generated one")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument("--compression", choices=("none", "storage"), default="none")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cold", action="store_true", help="drop the page cache before each turn")
    parser.add_argument("--without-messages", action="store_true", help="leave rosbags out")
    parser.add_argument("--turn", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.turn:
        print(json.dumps(take_turn(options.turn[0], Path(options.turn[1]))))
        return
    names = [name for name in CONTENDERS if name != "messages" or not options.without_messages]
    with tempfile.TemporaryDirectory(prefix="bag_speed_") as folder:
        bag = options.bag
        if bag is None:
            bag = Path(folder) / "bag"
            generator = Path(__file__).with_name("generate_bag.py")
            command = [sys.executable, str(generator), str(bag), "--minutes", str(options.minutes)]
            command += ["--storage", options.storage, "--compression", options.compression]
            subprocess.run(command, check=True)
        measure(bag, options.rounds, options.cold, names)


if __name__ == "__main__":
    main()
