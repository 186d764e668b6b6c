"""Whatever wrote the files, and whatever happened to them: what is readable is read, once."""

import itertools
import shutil
import sqlite3
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    KINDS,
    MS,
    TYPES,
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
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer

from hpid_bench.cli.main import main
from hpid_ros.base.errors import BagError
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.storage import Storage
from hpid_ros.messages.writer import repair_bag

pytestmark = pytest.mark.slow

FIELDS = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort")
COUNT = 400
PLAIN = {"compression": CompressionType.NONE}
SWITCHES = (
    "use_statistics",
    "use_summary_offsets",
    "repeat_channels",
    "repeat_schemas",
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
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
    found, unreadable = in_order(path, *topics)
    return sorted((topic, types[topic], *rest) for topic, *rest in found), unreadable


def in_order(path: Path, *topics: str) -> tuple[list[tuple[str, int, bytes]], list[str]]:
    """Return the messages of a bag in its order, and what could not be read."""
    shares: list[float] = []
    with Storage(path) as bag:
        found = [
            (int(batch.places[k]), batch.topic, int(batch.log_times_ns[k]), batch.raw(k))
            for batch in bag.batches(frozenset(topics or bag.topics()), shares.append)
            for k in range(len(batch.starts))
        ]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
        return [each[1:] for each in sorted(found)], bag.unreadable


def damage(path: Path, at: int, new: bytes) -> None:
    raw = bytearray(path.read_bytes())
    raw[at : at + len(new)] = new
    path.write_bytes(raw)


def flip(path: Path, at: int) -> None:
    damage(path, at, bytes([path.read_bytes()[at] ^ 1]))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> RunSeries:
    return read_run(write_bag(tmp_path_factory.mktemp("whole") / "bag", long_log()), "run")


@pytest.fixture(scope="module")
def sqlite(tmp_path_factory) -> Path:
    """Return the same as a file of SQLite."""
    folder = tmp_path_factory.mktemp("sqlite")
    write_bag(folder / "ours", long_log())
    convert(folder / "ours", folder / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    return folder / "bag" / "bag.db3"


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
    if mode != CompressionMode.STORAGE:
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


def test_a_damaged_page_of_sqlite_costs_little_more_than_itself(tmp_path, whole, sqlite):
    path = Path(shutil.copy(sqlite, tmp_path))
    page = path.read_bytes().index(struct.pack("<d", 200 * 0.1)) // 4096
    damage(path, page * 4096, b"\xff" * 16)
    run = read_run(path, "run")
    part_of(run, whole)
    assert 0.8 * COUNT < len(run.joints[0].position) < COUNT
    assert any("are damaged, left out" in line for line in run.quality.unreadable)


@pytest.fixture(scope="module")
def bags(tmp_path_factory, sqlite) -> list[tuple[Path, str]]:
    """Return bags, each with the name of the file that is damaged."""
    folder = tmp_path_factory.mktemp("whole")
    ours = write_bag(folder / "ours", long_log())
    write_mcap(folder / "chunks.mcap", long_log(), enable_crcs=True, **PLAIN)
    write_mcap(folder / "zstd.mcap", long_log(), compression=CompressionType.ZSTD)
    write_mcap(folder / "loose.mcap", long_log(), use_chunking=False)
    shutil.copy(sqlite, folder)
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


PAGE = 4096


def by_sqlite(path: Path) -> list[tuple[str, int, bytes]]:
    connection = sqlite3.connect(path)
    rows = connection.execute(
        "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id "
        "ORDER BY messages.id"
    ).fetchall()
    connection.close()
    return rows


@pytest.mark.parametrize("missing", [1, PAGE, 7 * PAGE + 17, 0.6])
def test_a_file_that_is_cut_off_is_read_and_repaired_as_far_as_its_pages_are_whole(
    sqlite, tmp_path, missing, capsys
):
    raw = sqlite.read_bytes()
    size = len(raw) - (missing if isinstance(missing, int) else int(missing * len(raw)))
    path = tmp_path / "cut.db3"
    path.write_bytes(raw[:size])
    found, unreadable = in_order(path)
    everything = by_sqlite(sqlite)
    assert found == everything[: len(found)]
    # A fifth of the file is the index of times, and the first pages are tables of text.
    assert len(found) >= 0.9 * (size - 12 * PAGE) / len(raw) * len(everything)
    cut, left_out = unreadable
    assert cut == f"cut.db3: it is cut off: {size} of {len(raw)} bytes are there"
    assert left_out.startswith(f"cut.db3: rows from {len(found) + 1} on are left out")
    assert main(["repair", str(path)]) == 0
    assert f"lost: {unreadable[0]}" in capsys.readouterr().out
    with BagReader(tmp_path / "cut_repaired") as bag:
        assert [(m.topic, m.log_time_ns, m.raw) for m in bag.messages()] == found


def test_bytes_after_the_last_page_are_told(sqlite, tmp_path):
    path = tmp_path / "bag.db3"
    path.write_bytes(sqlite.read_bytes() + b"x" * 1000)
    found, unreadable = in_order(path)
    assert found == by_sqlite(sqlite)
    assert unreadable == ["bag.db3: it ends within a page of 4096 bytes"]


def test_the_log_of_a_linked_file_is_read(sqlite, tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    shutil.copy(sqlite, there / "bag.db3")
    writer = sqlite3.connect(there / "bag.db3")
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("DELETE FROM messages WHERE id > 600")
    writer.commit()
    assert (there / "bag.db3-wal").stat().st_size > 0
    link = tmp_path / "link.db3"
    link.symlink_to(there / "bag.db3")
    found, unreadable = in_order(link)
    writer.close()
    assert found == by_sqlite(sqlite)[:600]
    assert unreadable == []


@pytest.mark.parametrize("change", ["id - 1000", "-id", "id - 9223372036854775807 - 2"])
def test_row_numbers_may_be_negative(sqlite, tmp_path, change):
    path = tmp_path / "bag.db3"
    shutil.copy(sqlite, path)
    with sqlite3.connect(path) as connection:
        connection.execute(
            f"CREATE TABLE other AS SELECT {change} AS id, topic_id, timestamp, data FROM messages"
        )
        connection.execute("DELETE FROM messages")
        connection.execute("INSERT INTO messages SELECT * FROM other")
        connection.execute("DROP TABLE other")
    connection.close()
    found, unreadable = in_order(path)
    assert found == by_sqlite(path)
    assert len(found) == len(by_sqlite(sqlite))
    assert unreadable == []


def test_large_messages_keep_their_order(tmp_path):
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        # In the order of the numbers the names are not sorted.
        topics = [writer.add_connection(f"/{k}", JOINT_STATE, typestore=TYPES) for k in "ba"]
        for k in range(120):
            writer.write(topics[k % 2], k, bytes([k]) * (200_000 if k % 3 == 0 else 90 * k))
    found, unreadable = in_order(path / "bag.db3")
    assert found == by_sqlite(path / "bag.db3")
    assert unreadable == []
    repair = repair_bag(path, tmp_path / "repaired")
    (file,) = repair.target.glob("*.mcap")
    with file.open("rb") as stream:
        saved = NonSeekingReader(stream).iter_messages(log_time_order=False)
        assert [message.log_time for _, _, message in saved] == list(range(120))
    assert repair.unreadable == ()


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
DECEITS = {
    "messages": (
        "DROP TABLE messages",
        f"CREATE VIEW messages AS {ENDLESS} SELECT x AS id, 1 AS topic_id, x AS timestamp, "
        "zeroblob(9) AS data FROM n",
    ),
    "topics": (
        "DROP TABLE topics",
        f"CREATE VIEW topics AS {ENDLESS} SELECT x AS id, '/' || x AS name, '' AS type, '' AS "
        "serialization_format FROM n",
    ),
    "message_definitions": (
        "DROP TABLE IF EXISTS message_definitions",
        f"CREATE VIEW message_definitions AS {ENDLESS} SELECT '' || x AS topic_type, '' AS "
        "encoded_message_definition FROM n",
    ),
    "columns": (
        "DROP TABLE messages",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data AS (zeroblob(900000000)))",
        "INSERT INTO messages(topic_id, timestamp) SELECT id, id FROM topics",
    ),
}


@pytest.mark.parametrize("deceit", DECEITS)
def test_what_is_computed_in_place_of_a_table_is_refused(sqlite, tmp_path, capsys, deceit):
    path = tmp_path / "bag.db3"
    shutil.copy(sqlite, path)
    connection = sqlite3.connect(path)
    for statement in DECEITS[deceit]:
        connection.execute(statement)
    connection.commit()
    connection.close()
    table = "messages" if deceit == "columns" else deceit
    for verb in ("metrics", "repair"):
        assert main([verb, str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{table} is no plain table, but computed when it is read" in line


def interior(below: int, cells: int) -> bytes:
    """Return a page of a table all of whose children are one page."""
    places = [PAGE - 8 * (k + 1) for k in range(cells)]
    page = bytearray(PAGE)
    struct.pack_into(f">BHHHBI{cells}H", page, 0, 5, 0, cells, places[-1], 0, below, *places)
    for k, place in enumerate(places):
        struct.pack_into(">IBB", page, place, below, 0x80 | (k >> 7), k & 0x7F)
    return bytes(page)


def test_pages_that_lead_to_each_other_a_thousandfold_are_left(sqlite, tmp_path):
    raw = bytearray(sqlite.read_bytes())
    connection = sqlite3.connect(sqlite)
    query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
    (root,) = connection.execute(query).fetchone()
    connection.close()
    (leaf,) = struct.unpack_from(">I", raw, (root - 1) * PAGE + 8)
    levels = 12
    for _ in range(levels):  # 300 ** 12 rows
        raw += interior(leaf, 300)
        leaf = len(raw) // PAGE
    raw[(root - 1) * PAGE : root * PAGE] = raw[-PAGE:]
    struct.pack_into(">I", raw, 28, len(raw) // PAGE)
    path = tmp_path / "bag.db3"
    path.write_bytes(raw)
    found, unreadable = in_order(path)
    assert len(found) <= 3 * COUNT
    assert any("rows are not in order" in line for line in unreadable)
    with Storage(path) as bag:  # SQLite finds no row of this topic that it could give
        assert not list(bag.batches(frozenset({"/joint_trajectory"})))
        assert any("are left out: interrupted" in line for line in bag.unreadable)
