"""Whatever wrote the files, and whatever happened to them: what is readable is read, once."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from harness.bag_reader import BagReader
from harness.bags import JOINT_STATE, MS, command, convert, small_log, state, write_bag
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from hpid_ros.base.errors import BagError
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.storage import Storage

pytestmark = pytest.mark.slow

FIELDS = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort")
COUNT = 400


def long_log(count: int = COUNT) -> list[tuple[str, int, bytes]]:
    log = []
    for k in range(count):
        stamp_ns = 10**18 + k * MS
        log += [("joint_states", stamp_ns, state(stamp_ns, a=k * 0.1, b=-k)[2])]
        log += [("joint_commands", stamp_ns + 7, command(stamp_ns, a=k * 0.01)[2])]
        log += [("joint_commands", stamp_ns + 8, command(stamp_ns, b=k * 0.02)[2])]
    return log


def write_mcap(path: Path, log, *, end: bool = True, **options) -> Path:
    """Write one MCAP file with the library of the format's authors."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=8000, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        channels: dict[str, int] = {}
        for name, log_time_ns, raw in log:
            if name not in channels:
                channels[name] = writer.register_channel(f"/{name}", "cdr", schema)
            writer.add_message(channels[name], log_time_ns, raw, log_time_ns)
        if end:
            writer.finish()
    return path


def same(run: RunSeries, other: RunSeries) -> None:
    assert run.joint_names == other.joint_names
    for one, two in zip(run.joints, other.joints, strict=True):
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    assert run.losses == other.losses


def part_of(run: RunSeries, whole: RunSeries) -> None:
    """Every number of a run is the whole run's at the same stamp."""
    for one in run.joints:
        (other,) = (series for series in whole.joints if series.joint == one.joint)
        for stamps, values in (("state_stamps_ns", "position"), ("command_stamps_ns", "effort")):
            known = dict(zip(getattr(other, stamps), getattr(other, values), strict=True))
            for stamp, value in zip(getattr(one, stamps), getattr(one, values), strict=True):
                assert known[stamp] == value


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> RunSeries:
    return read_run(write_bag(tmp_path_factory.mktemp("whole") / "bag", long_log()), "run")


NO_INDEX = IndexType.NONE


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.NONE, "use_chunking": False},
        {"compression": CompressionType.NONE, "index_types": NO_INDEX},
        {"compression": CompressionType.ZSTD, "index_types": IndexType.MESSAGE},
        {"use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_chunking": False},
    ],
    ids=str,
)
def test_every_shape_of_mcap_gives_the_same_run(tmp_path, whole, options):
    run = read_run(write_mcap(tmp_path / "bag.mcap", long_log(), **options), "run")
    same(run, whole)
    assert len(run.joints[0].position) == COUNT
    assert not [line for line in run.quality.unreadable if "without" not in line]


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        (StoragePlugin.MCAP, CompressionMode.NONE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_messages_are_those_that_another_reader_finds(tmp_path, storage, mode):
    write_bag(tmp_path / "ours", small_log())
    convert(tmp_path / "ours", tmp_path / "bag", storage, mode)
    with BagReader(tmp_path / "bag") as bag:
        expected = sorted((m.topic, m.log_time_ns, m.raw) for m in bag.messages())
    shares: list[float] = []
    with Storage(tmp_path / "bag") as bag:
        found = [
            (batch.topic, int(batch.log_times_ns[k]), batch.raw(k))
            for batch in bag.batches(frozenset(bag.topics()), shares.append)
            for k in range(len(batch.starts))
        ]
        assert bag.unreadable == []
    assert sorted(found) == expected
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE])
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_without_metadata_the_files_are_read_as_they_are(tmp_path, storage, mode):
    write_bag(tmp_path / "ours", small_log())
    convert(tmp_path / "ours", tmp_path / "bag", storage, mode)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    run = read_run(tmp_path / "bag", "run")
    same(run, read_run(tmp_path / "ours", "run"))
    assert run.quality.unreadable == (
        "metadata.yaml is missing, as after a recorder that was stopped by force",
    )


def split(folder: Path, log, parts: int) -> Path:
    """Write a bag in several files, numbered as rosbag2 does, beyond nine."""
    folder.mkdir()
    size = -(-len(log) // parts)
    for k in range(parts):
        write_mcap(folder / f"bag_{k}.mcap", log[k * size : (k + 1) * size])
    return folder


def test_a_bag_in_several_files_is_one_run(tmp_path, whole):
    path = split(tmp_path / "bag", long_log(), 12)
    same(read_run(path, "run"), whole)
    with Storage(path) as bag:
        batches = bag.batches(frozenset({"/joint_states"}), lambda share: None)
        times = [time for batch in batches for time in batch.log_times_ns.tolist()]
    assert times == sorted(times)
    assert len(times) == COUNT


def test_a_missing_file_is_named_and_the_others_are_read(tmp_path, whole):
    bag = split(tmp_path / "bag", long_log(), 12)
    names = "".join(f"\n  - bag_{k}.mcap" for k in range(12))
    metadata = f"rosbag2_bagfile_information:\n  relative_file_paths:{names}\n"
    (bag / "metadata.yaml").write_text(metadata.replace("\n  -", "\n    -"))
    (bag / "bag_3.mcap").unlink()
    run = read_run(bag, "run")
    assert run.quality.unreadable == ("bag_3.mcap: the file is missing",)
    part_of(run, whole)
    quality = run.quality.joints["a"].states
    assert quality.gaps == 1
    assert quality.lost == COUNT - len(run.joints[0].position)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_recorder_that_was_killed_leaves_all_chunks_that_it_wrote(tmp_path, whole, compression):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), end=False, compression=compression)
    run = read_run(path, "run")
    part_of(run, whole)
    assert len(run.joints[0].position) > COUNT // 2
    assert any("the end is missing" in line for line in run.quality.unreadable)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("kept", [0.2, 0.5, 0.77, 0.9])
def test_a_file_that_is_cut_off_gives_everything_before_the_cut(
    tmp_path, whole, compression, kept
):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), compression=compression)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(kept * len(raw))])
    run = read_run(path, "run")
    part_of(run, whole)
    assert len(run.joints[0].position) > 0.6 * kept * COUNT
    assert run.quality.unreadable


def test_a_chunk_with_a_wrong_checksum_is_left_out_and_named(tmp_path, whole):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), compression=CompressionType.NONE)
    raw = bytearray(path.read_bytes())
    target = struct.pack("<d", 200 * 0.1)  # a position in the middle
    raw[raw.index(target) + 6] ^= 1
    path.write_bytes(raw)
    run = read_run(path, "run")
    part_of(run, whole)
    damaged, counted = run.quality.unreadable
    assert "left out: wrong checksum" in damaged
    lost = COUNT - len(run.joints[0].position)
    assert f"{COUNT} messages on /joint_states, not {COUNT - lost}" in counted
    assert run.quality.joints["a"].states.gaps == 1


@pytest.mark.parametrize("damaged", [200, COUNT - 2])
def test_nothing_of_a_damaged_chunk_is_taken_without_its_checksum(tmp_path, whole, damaged):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), compression=CompressionType.NONE)
    raw = bytearray(path.read_bytes())
    position = raw.index(struct.pack("<d", damaged * 0.1))
    with path.open("rb") as stream:
        chunks = [
            chunk.chunk_start_offset for chunk in make_reader(stream).get_summary().chunk_indexes
        ]
    frame = max(chunk for chunk in chunks if chunk < position)
    raw[frame + 1 + 7] = 0xFF  # the chunk's length
    raw[position + 6] ^= 1
    path.write_bytes(raw)
    run = read_run(path, "run")
    part_of(run, whole)
    assert 0.8 * COUNT < len(run.joints[0].position) < COUNT
    assert any("left out" in line for line in run.quality.unreadable)


def test_an_index_that_names_a_message_twice_is_not_believed(tmp_path, whole):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), compression=CompressionType.NONE)
    raw = bytearray(path.read_bytes())
    first, second = (struct.pack("<Q", 10**18 + k * MS) for k in (200, 201))
    at, other = raw.rindex(first), raw.rindex(second)
    assert other == at + 16, "entries of the index of one chunk"
    raw[at : at + 16] = raw[other : other + 16]
    path.write_bytes(raw)
    same(read_run(path, "run"), whole)


def test_records_after_a_damaged_one_are_found_again(tmp_path, whole):
    options = {"compression": CompressionType.NONE, "enable_crcs": False}
    for use_chunking in (True, False):
        path = write_mcap(tmp_path / "bag.mcap", long_log(), use_chunking=use_chunking, **options)
        raw = bytearray(path.read_bytes())
        frame = raw.index(struct.pack("<d", 100 * 0.1)) - 8 * 20
        raw[frame : frame + 60] = b"\xff" * 60
        path.write_bytes(raw)
        run = read_run(path, "run")
        part_of(run, whole)
        samples = len(run.joints[0].position) + sum(len(joint.effort) for joint in run.joints)
        assert 3 * COUNT - 5 < samples < 3 * COUNT
        assert any("damaged" in line for line in run.quality.unreadable)


def test_a_damaged_page_of_sqlite_costs_little_more_than_itself(tmp_path, whole):
    write_bag(tmp_path / "ours", long_log())
    convert(tmp_path / "ours", tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    path = tmp_path / "bag" / "bag.db3"
    raw = bytearray(path.read_bytes())
    page = raw.index(struct.pack("<d", 200 * 0.1)) // 4096
    raw[page * 4096 : page * 4096 + 16] = b"\xff" * 16
    path.write_bytes(raw)
    run = read_run(path, "run")
    part_of(run, whole)
    assert 0.8 * COUNT < len(run.joints[0].position) < COUNT
    assert any("are damaged, left out" in line for line in run.quality.unreadable)


def test_a_write_ahead_log_that_was_left_behind_is_read(tmp_path, whole):
    write_bag(tmp_path / "ours", long_log())
    convert(tmp_path / "ours", tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    path = tmp_path / "bag" / "bag.db3"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("DELETE FROM messages WHERE id > 1000")
    rows = sqlite3.connect(path)
    with sqlite3.connect(path) as writer:
        writer.execute("DELETE FROM messages WHERE id > 900")
        writer.commit()
        assert path.with_name("bag.db3-wal").stat().st_size > 0
        run = read_run(path, "run")
    rows.close()
    part_of(run, whole)
    assert sum(len(j.effort) for j in run.joints) + len(run.joints[0].position) == 900


def test_what_is_no_recording_at_all_is_one_line(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(BagError, match=r"no topic of states .*the end is missing"):
        read_run(tmp_path / "bag.mcap", "run")


@pytest.fixture(scope="module")
def damaged(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("whole")
    chunked = {"enable_crcs": True, "compression": CompressionType.NONE}
    write_bag(folder / "ours", long_log())
    convert(folder / "ours", folder / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    return [
        write_mcap(folder / "chunks.mcap", long_log(), **chunked),
        write_mcap(folder / "zstd.mcap", long_log(), compression=CompressionType.ZSTD),
        write_mcap(folder / "loose.mcap", long_log(), use_chunking=False),
        folder / "bag" / "bag.db3",
    ]


@examples(2)
@given(
    st.integers(0, 3),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
    st.floats(0.01, 1.0),
)
def test_damage_gives_a_run_or_one_line(damaged, number, damage, kept):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / damaged[number].name
        shutil.copy(damaged[number], path)
        raw = bytearray(path.read_bytes())
        for where, value in damage:
            raw[int(where * len(raw))] = value
        path.write_bytes(raw[: int(kept * len(raw))])
        try:
            read_run(path, "run")
        except BagError as error:
            line = str(error)
        else:
            line = ""
        assert "\n" not in line


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4))
def test_what_checksums_cover_is_never_silently_wrong(damaged, whole, damage):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.mcap"
        raw = bytearray(damaged[0].read_bytes())
        for where, value in damage:
            raw[int(where * len(raw))] = value
        path.write_bytes(raw)
        try:
            run = read_run(path, "run")
        except BagError:
            return
        part_of(run, whole)
        if len(run.joints[0].position) < COUNT or run.joint_names != ("a", "b"):
            assert run.quality.unreadable
