"""Small files that would fill memory, run for ever or crash: each ends in one line."""

import math
import os
import resource
import socket
import struct
import subprocess
import sys
from pathlib import Path

import lz4.frame
import pytest
from harness.bags import convert, small_log, write_bag, write_mcap
from mcap.writer import CompressionType
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from benchmarks.bounds import CASES, costs
from hpid_bench.cli.main import main
from hpid_ros.base.errors import ExperimentError
from hpid_ros.base.files import LARGEST_JSON
from hpid_ros.base.yaml_files import MOST_LEVELS, load_yaml
from hpid_ros.messages.mcap_file import LIMIT_VARIABLE, zstd_library
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY
from hpid_ros.messages.run import read_run
from hpid_ros.messages.writer import BagWriter

pytestmark = pytest.mark.faults
zstd = zstd_library()
MIB = 1 << 20
MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(compression: bytes, packed: bytes, size: int) -> bytes:
    head = struct.pack("<QQQII", 0, 1, size, 0, len(compression))
    return record(6, head + compression + struct.pack("<Q", len(packed)) + packed)


def mcap_of(path: Path, *records: bytes) -> Path:
    end = record(15, bytes(4)) + record(2, bytes(20))
    path.write_bytes(MAGIC + record(1, bytes(8)) + b"".join(records) + end + MAGIC)
    return path


def packed_zeros(compression: str, mebibytes: int) -> bytes:
    compress = zstd.compress if compression == "zstd" else lz4.frame.compress
    return compress(bytes(MIB)) * mebibytes  # one frame after the other


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1000, 1024 * MIB, 2**63])
def test_a_chunk_unpacks_to_what_it_declares_within_the_limit(
    tmp_path, refused, monkeypatch, compression, declared
):
    monkeypatch.setenv(LIMIT_VARIABLE, str(MIB))
    packed = packed_zeros(compression, 1024)
    bomb = chunk(compression.encode(), packed, declared)
    path = mcap_of(tmp_path / "bag.mcap", bomb)
    reason = (
        "left out: 1000 bytes and more instead of 1000"
        if declared == 1000
        else f"would unpack to more than {MIB + 100 * len(packed)}; {LIMIT_VARIABLE} (now {MIB}"
    )
    for verb in ("metrics", "repair"):
        assert reason in refused(verb, path)


def test_many_chunks_share_one_allowance(tmp_path, refused, monkeypatch):
    monkeypatch.setenv(LIMIT_VARIABLE, str(4 * MIB))
    bomb = chunk(b"zstd", packed_zeros("zstd", 3), 3 * MIB)
    path = mcap_of(tmp_path / "bag.mcap", *[bomb] * 1000)
    line = refused("metrics", path)
    assert line.count("would unpack to more than") < 60
    assert "further lines like these" in line


def test_a_file_unpacks_within_the_limit(tmp_path, refused, monkeypatch):
    monkeypatch.setenv(LIMIT_VARIABLE, str(MIB))
    path = tmp_path / "bag.mcap.zstd"
    path.write_bytes(packed_zeros("zstd", 1024))
    for verb in ("metrics", "repair"):
        line = refused(verb, path)
        assert "would unpack to more than" in line
    write_mcap(tmp_path / "good.mcap", small_log(), compression=CompressionType.NONE)
    good = tmp_path / "good.mcap.zstd"
    good.write_bytes(zstd.compress((tmp_path / "good.mcap").read_bytes()))
    assert main(["metrics", str(good)]) == 0
    monkeypatch.setenv(LIMIT_VARIABLE, "a lot")
    assert f"{LIMIT_VARIABLE} must be a number of bytes, not 'a lot'" in refused("metrics", good)


def test_a_message_unpacks_within_the_limit(tmp_path, monkeypatch):
    bomb = packed_zeros("zstd", 64)
    write_bag(tmp_path / "ours", small_log())
    convert(tmp_path / "ours", tmp_path / "bag", StoragePlugin.MCAP, CompressionMode.MESSAGE)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    log = [(name, stamp_ns, zstd.compress(raw)) for name, stamp_ns, raw in small_log()]
    write_mcap(file, [*log, ("joint_states", log[-1][1], bomb)])
    monkeypatch.setenv(LIMIT_VARIABLE, str(MIB))
    run = read_run(tmp_path / "bag", "run")
    assert len(run.joints[0].position) == 59
    line = next(line for line in run.quality.unreadable if "decompressed" in line)
    assert f"{len(bomb)} bytes would unpack to more than" in line


@pytest.mark.parametrize("name", ["chunk.mcap", "file.mcap.zstd"])
def test_the_default_limit_bounds_the_memory_of_a_process(tmp_path, name):
    packed = zstd.compress(bytes(64 * MIB)) * 128  # 8 GiB
    path = mcap_of(tmp_path / name, chunk(b"zstd", packed, 1000))
    if name.endswith("zstd"):
        path.write_bytes(packed)
    limits = 3072 * MIB, 3072 * MIB
    run = subprocess.run(
        [sys.executable, "-m", "hpid_bench.cli.main", "metrics", str(path)],
        **{"capture_output": True, "text": True, "timeout": 60, "check": False},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, limits),
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1


def test_what_is_no_file_is_no_bag(tmp_path, refused, monkeypatch):
    os.mkfifo(tmp_path / "fifo.mcap")
    os.mkfifo(tmp_path / "fifo.db3")
    (tmp_path / "null.mcap").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listener:
        monkeypatch.chdir(tmp_path)  # names of sockets are short
        listener.bind("socket.db3")
    kinds = {"fifo.mcap": "FIFO", "fifo.db3": "FIFO", "null.mcap": "device"}
    for name, kind in {**kinds, "socket.db3": "socket"}.items():
        for verb in ("metrics", "repair"):
            line = refused(verb, tmp_path / name)
            assert f"{name}: it is a {kind}, not a file" in line
    (tmp_path / "bag" / "inner.mcap").mkdir(parents=True)
    os.mkfifo(tmp_path / "bag" / "metadata.yaml")
    line = refused("metrics", tmp_path / "bag")
    assert "inner.mcap: it is a folder, not a file" in line


LAUGHS = "a0: &a0 [ha]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)
)
OF_ONE_HASH = "".join(f"{k * (2**61 - 1)}: 0\n" for k in range(20_000))
TEXTS = {
    "brackets": ("[" * 100_000, f"more than {MOST_LEVELS} levels"),
    "braces": ("{a: " * 100_000, f"more than {MOST_LEVELS} levels"),
    "dashes": ("- " * 100_000, f"more than {MOST_LEVELS} levels"),
    "keys": ("? " * 100_000, f"more than {MOST_LEVELS} levels"),
    "laughs": (LAUGHS, "values, aliases expanded"),
    "merges": (LAUGHS.replace("[", "{<<: [").replace("]", "]}").replace("[ha]", "{}"), "values"),
    "itself": ("a: &a {b: *a}\n", "alias 'a' is part of itself or unknown"),
    "itself_again": ("a: &a [1]\nb: &a [*a]\n", "alias 'a' is part of itself or unknown"),
    "digits": (f"a: {'1' * 5000}\n", "a number of more than 1000 characters"),
    "hexadecimal": (f"a: 0x{'f' * 5000}\n", "a number of more than 1000 characters"),
    "tagged": (f"a: !!int '0b{'1' * 20000}'\n", "a number of more than 1000 characters"),
    "month": ("a: 2001-13-01\n", "a value is not what its tag says"),
    "tags": ("a: !!bool perhaps\n", "a value is not what its tag says"),
    "objects": ("a: !!python/object/apply:os.getcwd []\n", "could not determine a constructor"),
    "long": ("a: " + "b" * (17 * MIB), "it has more than 16777216 bytes"),
    "hashes": (
        "".join(f"{k * (2**61 - 1)}: 0\n" for k in range(20_000)),
        "18 characters as a key",
    ),
    "hash": ("? !!int '9223372036854775808'\n: 0\n", "18 characters as a key"),
    "alias": ("a: &a -9223372036854775808\nb: {x: 1, *a : 0}\n", "18 characters as a key"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_yaml_file_is_a_document_or_one_line(tmp_path, kind):
    text, reason = TEXTS[kind]
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ExperimentError, match="cannot read") as refusal:
        load_yaml(path, ExperimentError)
    assert reason in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_whatever_reads_a_document_refuses_such_a_one(tmp_path, refused):
    text, reason = TEXTS["laughs"]
    (tmp_path / "file.yaml").write_text(text)
    assert reason in refused("compare", tmp_path / "file.yaml")
    assert "it is a device, not a file" in refused("compare", "/dev/zero")
    bag = write_bag(tmp_path / "bag", small_log())
    (bag / "metadata.yaml").write_text(text)
    (line,) = read_run(bag, "run").quality.unreadable
    assert "metadata.yaml is damaged; the files were read without it" in line
    assert reason in line
    with BagWriter(tmp_path / "controlled", metadata={CONTROLLERS_ENTRY: text}) as writer:
        for name in ("joint_states", "joint_commands"):
            writer.add_topic(name, "sensor_msgs/msg/JointState")
    line = refused("replay", tmp_path / "controlled")
    assert CONTROLLERS_ENTRY in line
    assert reason in line
    (tmp_path / "saved.json").write_text("[" * 100_000)
    assert "saved.json is no JSON" in refused("metrics", tmp_path / "saved.json")
    for name in ("endless.json", "endless.yaml", "endless.urdf"):
        (tmp_path / name).symlink_to("/dev/zero")
    assert "it is a device, not a file" in refused("metrics", tmp_path / "endless.json")
    assert "it is a device, not a file" in refused("compare", tmp_path / "endless.yaml")
    assert "there is no file" in refused("robot", tmp_path / "endless.urdf")
    os.mkfifo(tmp_path / "fifo.json")
    assert "it is a FIFO, not a file" in refused("metrics", tmp_path / "fifo.json")
    (tmp_path / "large.json").write_bytes(b"[" + b"0," * (LARGEST_JSON // 2) + b"0]")
    assert f"it has more than {LARGEST_JSON} bytes" in refused("metrics", tmp_path / "large.json")


@pytest.mark.parametrize(
    "what", ["joints of a state", "joints of a URDF", "keys", "points", "points without numbers"]
)
def test_what_strangers_send_costs_time_and_memory_in_proportion(tmp_path, what):
    """In the benchmark the time of eight times the size is at most twice as much for each item."""
    case = CASES[what]
    first = min(case.first, 2000)
    small, large = (costs(case.make(tmp_path, size)) for size in (first, 8 * first))
    assert large[0] < 40.0 * small[0]  # a square would be 64
    assert large[1] < 12.0 * small[1]


def test_aliases_that_people_write_are_read(tmp_path):
    path = tmp_path / "file.yaml"
    keys = "20261128123456789: 1.234567890123456789, 3.141592653589793238: [98765432109876543210]"
    path.write_text(f"a: &a {{p: 1}}\nb: {{<<: *a, d: 2}}\nc: [*a, *a]\nd: {{{keys}}}\n")
    expected = {"a": {"p": 1}, "b": {"p": 1, "d": 2}, "c": [{"p": 1}, {"p": 1}]}
    expected["d"] = {20261128123456789: 1.234567890123456789, math.pi: [98765432109876543210]}
    assert load_yaml(path, ExperimentError) == expected
