"""Whatever wrote the files, and whatever happened to them: what is readable is read, once."""

import itertools
import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    KINDS,
    MS,
    BagReader,
    command,
    convert,
    small_log,
    state,
    write_bag,
    write_mcap,
)
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from hpid_ros.base.errors import BagError
from hpid_ros.cli.main import main
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.storage import Storage

pytestmark = pytest.mark.slow

FIELDS = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort")
COUNT = 400
PLAIN = {"compression": CompressionType.NONE}
SWITCHES = (
    *("use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas"),
    "enable_crcs",
)


def long_log(count: int = COUNT) -> list[tuple[str, int, bytes]]:
    log = []
    for k in range(count):
        stamp_ns = 10**18 + k * MS
        log += [("joint_states", stamp_ns, state(stamp_ns, a=k * 0.1, b=-k)[2])]
        log += [("joint_commands", stamp_ns + 7, command(stamp_ns, a=k * 0.01)[2])]
        log += [("joint_commands", stamp_ns + 8, command(stamp_ns, b=k * 0.02)[2])]
    return log


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


def stored(path: Path, *topics: str) -> tuple[list[tuple[str, str, int, bytes]], list[str]]:
    """Return topic, type, log time and bytes of all messages, and what could not be read."""
    shares: list[float] = []
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        found = [
            (batch.topic, types[batch.topic], int(batch.log_times_ns[k]), batch.raw(k))
            for batch in bag.batches(frozenset(topics or types), shares.append)
            for k in range(len(batch.starts))
        ]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
        return sorted(found), bag.unreadable


def damage(path: Path, at: int, new: bytes) -> None:
    raw = bytearray(path.read_bytes())
    raw[at : at + len(new)] = new
    path.write_bytes(raw)


def flip(path: Path, at: int) -> None:
    damage(path, at, bytes([path.read_bytes()[at] ^ 1]))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> RunSeries:
    return read_run(write_bag(tmp_path_factory.mktemp("whole") / "bag", long_log()), "run")


@pytest.mark.parametrize("index", [IndexType.NONE, IndexType.ALL], ids=str)
@pytest.mark.parametrize(
    ("use_chunking", "compression"),
    [(False, CompressionType.NONE), *((True, each) for each in CompressionType)],
)
def test_every_combination_of_options_of_mcap_gives_the_same_messages(
    tmp_path, use_chunking, compression, index
):
    path, log = tmp_path / "bag.mcap", small_log()
    for values in itertools.product((False, True), repeat=len(SWITCHES)):
        options = dict(zip(SWITCHES, values, strict=True), use_chunking=use_chunking)
        write_mcap(path, log, compression=compression, index_types=index, **options)
        # Its seeking reader raises KeyError where the summary does not repeat the schemas.
        with path.open("rb") as stream:
            expected = sorted(
                (channel.topic, schema.name, message.log_time, bytes(message.data))
                for schema, channel, message in NonSeekingReader(stream).iter_messages()
            )
        assert len(expected) == len(log)
        found, unreadable = stored(path)
        assert found == expected, options
        assert all("it was read without" in line for line in unreadable)
        states = [each for each in expected if each[0] == "/joint_states"]
        assert stored(path, "/joint_states")[0] == states, options


@pytest.mark.parametrize(
    ("storage", "mode"),
    [(StoragePlugin.MCAP, mode) for mode in CompressionMode]
    + [(StoragePlugin.SQLITE3, m) for m in CompressionMode if m != CompressionMode.STORAGE],
)
def test_messages_are_those_that_another_reader_finds(tmp_path, storage, mode):
    ours, theirs = write_bag(tmp_path / "ours", small_log()), tmp_path / "bag"
    convert(ours, theirs, storage, mode)
    with BagReader(theirs) as bag:
        expected = sorted((m.topic, m.log_time_ns, m.raw) for m in bag.messages())
    found, unreadable = stored(theirs)
    assert [(topic, *rest) for topic, _, *rest in found] == expected
    assert unreadable == []
    if mode in (CompressionMode.NONE, CompressionMode.FILE):
        (theirs / "metadata.yaml").unlink()
        run = read_run(theirs, "run")
        same(run, read_run(ours, "run"))
        (line,) = run.quality.unreadable
        assert "metadata.yaml is missing" in line


def split(folder: Path, log, *options: dict) -> Path:
    """Write a bag of one file for each of some options, numbered and counted as rosbag2 does."""
    folder.mkdir()
    size = -(-len(log) // len(options))
    names = [f"bag_{k}.mcap" for k in range(len(options))]
    for k, (name, each) in enumerate(zip(names, options, strict=True)):
        write_mcap(folder / name, log[k * size : (k + 1) * size], **each)
    counts = "".join(
        f"    - topic_metadata: {{name: /{name}}}\n"
        f"      message_count: {sum(each[0] == name for each in log)}\n"
        for name in KINDS
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n"
        f"  relative_file_paths: [{', '.join(names)}]\n"
        f"  topics_with_message_count:\n{counts}"
    )
    return folder


@pytest.mark.parametrize("has_metadata", [True, False])
def test_a_bag_in_several_files_is_one_run(tmp_path, whole, has_metadata):
    path = split(tmp_path / "bag", long_log(), *[{}] * 12)
    if not has_metadata:
        (path / "metadata.yaml").unlink()
    run = read_run(path, "run")
    same(run, whole)
    assert len(run.quality.unreadable) == 1 - has_metadata
    with Storage(path) as bag:
        batches = bag.batches(frozenset({"/joint_states"}))
        times = [time for batch in batches for time in batch.log_times_ns.tolist()]
    assert times == sorted(times)  # the files beyond nine, too
    assert len(times) == COUNT


def test_a_missing_file_is_named_and_the_others_are_read(tmp_path, whole):
    bag = split(tmp_path / "bag", long_log(), *[{}] * 12)
    (bag / "bag_3.mcap").unlink()
    run = read_run(bag, "run")
    assert run.quality.unreadable[0] == "bag_3.mcap: the file is missing"
    part_of(run, whole)
    quality = run.quality.joints["a"].states
    assert quality.gaps == 1
    assert quality.lost == COUNT - len(run.joints[0].position)


def test_messages_that_are_counted_and_not_there_are_reported(tmp_path, capsys):
    path = write_mcap(tmp_path / "bag.mcap", small_log(), enable_crcs=False)
    # /joint_states is channel 1
    damage(path, path.read_bytes().rindex(struct.pack("<HQ", 1, 59)), struct.pack("<HQ", 1, 61))
    line = "bag.mcap: its statistics count 61 messages on /joint_states, not 59"
    assert read_run(path, "run").quality.unreadable == (line,)
    assert main(["repair", str(path)]) == 0
    assert f"lost: {line}" in capsys.readouterr().out

    log = [each for each in small_log() if each[1] < 600 * MS]
    bag = split(tmp_path / "bag", log, {})
    metadata = bag / "metadata.yaml"
    metadata.write_text(
        metadata.read_text().replace("message_count: 29", "message_count: 59")
        + "    - topic_metadata: {name: /camera}\n      message_count: 7\n"
    )
    assert read_run(bag, "run").quality.unreadable == (
        "metadata.yaml counts 7 messages on /camera, not 0; 59 messages on /joint_commands, "
        "not 29; 59 messages on /joint_states, not 29",
    )


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("kept", [0.2, 0.77, 0.9])
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
    path = write_mcap(tmp_path / "bag.mcap", long_log(), **PLAIN)
    flip(path, path.read_bytes().index(struct.pack("<d", 200 * 0.1)) + 6)
    run = read_run(path, "run")
    part_of(run, whole)
    damaged, counted = run.quality.unreadable
    assert "left out: wrong checksum" in damaged
    lost = COUNT - len(run.joints[0].position)
    assert f"{COUNT} messages on /joint_states, not {COUNT - lost}" in counted
    assert run.quality.joints["a"].states.gaps == 1


@pytest.mark.parametrize("damaged", [200, COUNT - 2])
def test_nothing_of_a_damaged_chunk_is_taken_without_its_checksum(tmp_path, whole, damaged):
    path = write_mcap(tmp_path / "bag.mcap", long_log(), **PLAIN)
    position = path.read_bytes().index(struct.pack("<d", damaged * 0.1))
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    frame = max(c.chunk_start_offset for c in chunks if c.chunk_start_offset < position)
    damage(path, frame + 1 + 7, b"\xff")  # the chunk's length
    flip(path, position + 6)
    run = read_run(path, "run")
    part_of(run, whole)
    assert 0.8 * COUNT < len(run.joints[0].position) < COUNT
    assert any("left out" in line for line in run.quality.unreadable)


@pytest.mark.parametrize("use_chunking", [True, False])
def test_records_after_a_damaged_one_are_found_again(tmp_path, whole, use_chunking):
    options = {**PLAIN, "enable_crcs": False, "use_chunking": use_chunking}
    path = write_mcap(tmp_path / "bag.mcap", long_log(), **options)
    damage(path, path.read_bytes().index(struct.pack("<d", 100 * 0.1)) - 8 * 20, b"\xff" * 60)
    run = read_run(path, "run")
    part_of(run, whole)
    samples = len(run.joints[0].position) + sum(len(joint.effort) for joint in run.joints)
    assert 3 * COUNT - 5 < samples < 3 * COUNT
    assert any("damaged" in line for line in run.quality.unreadable)


def test_a_damaged_page_of_sqlite_costs_little_more_than_itself(tmp_path, whole):
    write_bag(tmp_path / "ours", long_log())
    convert(tmp_path / "ours", tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    path = tmp_path / "bag" / "bag.db3"
    page = path.read_bytes().index(struct.pack("<d", 200 * 0.1)) // 4096
    damage(path, page * 4096, b"\xff" * 16)
    run = read_run(path, "run")
    part_of(run, whole)
    assert 0.8 * COUNT < len(run.joints[0].position) < COUNT
    assert any("are damaged, left out" in line for line in run.quality.unreadable)


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> list[tuple[Path, str]]:
    """Return bags, each with the name of the file that is damaged."""
    folder = tmp_path_factory.mktemp("whole")
    ours = write_bag(folder / "ours", long_log())
    convert(ours, folder / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    write_mcap(folder / "chunks.mcap", long_log(), enable_crcs=True, **PLAIN)
    write_mcap(folder / "zstd.mcap", long_log(), compression=CompressionType.ZSTD)
    write_mcap(folder / "loose.mcap", long_log(), use_chunking=False)
    shutil.copy(folder / "bag" / "bag.db3", folder)
    files = ("chunks.mcap", "zstd.mcap", "loose.mcap", "bag.db3")
    return [(folder / name, "") for name in files] + [(ours, "metadata.yaml")]


DAMAGE = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4)


def damaged_copy(bag: Path, name: str, folder: str, bytes_changed, kept: float = 1.0) -> Path:
    path = Path(folder) / bag.name
    (shutil.copytree if bag.is_dir() else shutil.copy)(bag, path)
    file = path / name if name else path
    raw = bytearray(file.read_bytes())
    for where, value in bytes_changed:
        raw[int(where * len(raw))] = value
    file.write_bytes(raw[: int(kept * len(raw))])
    return path


@examples(2)
@given(st.integers(0, 4), DAMAGE, st.floats(0.0, 1.0))
def test_damage_gives_a_run_or_one_line(bags, number, changes, kept):
    with tempfile.TemporaryDirectory() as folder:
        path = damaged_copy(*bags[number], folder, changes, kept)
        line = ""
        try:
            read_run(path, "run")
        except BagError as error:
            line = str(error)
        assert "\n" not in line


@given(DAMAGE)
def test_what_checksums_cover_is_never_silently_wrong(bags, whole, changes):
    with tempfile.TemporaryDirectory() as folder:
        try:
            run = read_run(damaged_copy(*bags[0], folder, changes), "run")
        except BagError:
            return
        part_of(run, whole)
        if len(run.joints[0].position) < COUNT or run.joint_names != ("a", "b"):
            assert run.quality.unreadable
