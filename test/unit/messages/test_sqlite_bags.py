"""SQLite bags that were cut off, linked, numbered oddly, or made to deceive."""

import shutil
import sqlite3
import struct
from pathlib import Path

import pytest
from harness.bags import JOINT_STATE, MS, TYPES, BagReader, command, convert, state, write_bag
from mcap.reader import NonSeekingReader
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer

from hpid_ros.cli.main import main
from hpid_ros.messages.storage import Storage
from hpid_ros.messages.writer import repair_bag

PAGE = 4096
STATES = 1000


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return the file of a bag of states and commands."""
    folder = tmp_path_factory.mktemp("whole")
    log = []
    for k in range(STATES):
        log += [state(k * MS, a=k * 0.1), command(k * MS, a=k * 0.01)]
    write_bag(folder / "ours", log)
    convert(folder / "ours", folder / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    return folder / "bag" / "bag.db3"


def messages(path: Path) -> tuple[list[tuple[str, int, bytes]], list[str]]:
    """Return the messages of a bag in its order, and what could not be read."""
    with Storage(path) as bag:
        found = [
            (int(batch.places[k]), batch.topic, int(batch.log_times_ns[k]), batch.raw(k))
            for batch in bag.batches(frozenset(bag.topics()))
            for k in range(len(batch.starts))
        ]
        return [each[1:] for each in sorted(found)], bag.unreadable


def by_sqlite(path: Path) -> list[tuple[str, int, bytes]]:
    connection = sqlite3.connect(path)
    rows = connection.execute(
        "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id "
        "ORDER BY messages.id"
    ).fetchall()
    connection.close()
    return rows


@pytest.mark.parametrize("missing", [1, 100, PAGE, 7 * PAGE + 17, 0.3, 0.6, 0.8])
def test_a_file_that_is_cut_off_is_read_and_repaired_as_far_as_its_pages_are_whole(
    whole, tmp_path, missing, capsys
):
    raw = whole.read_bytes()
    size = len(raw) - (missing if isinstance(missing, int) else int(missing * len(raw)))
    path = tmp_path / "cut.db3"
    path.write_bytes(raw[:size])
    found, unreadable = messages(path)
    everything = by_sqlite(whole)
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


def test_bytes_after_the_last_page_are_told(whole, tmp_path):
    path = tmp_path / "bag.db3"
    path.write_bytes(whole.read_bytes() + b"x" * 1000)
    found, unreadable = messages(path)
    assert found == by_sqlite(whole)
    assert unreadable == ["bag.db3: it ends within a page of 4096 bytes"]


def test_the_log_of_a_linked_file_is_read(whole, tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    shutil.copy(whole, there / "bag.db3")
    writer = sqlite3.connect(there / "bag.db3")
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("DELETE FROM messages WHERE id > 600")
    writer.commit()
    assert (there / "bag.db3-wal").stat().st_size > 0
    link = tmp_path / "link.db3"
    link.symlink_to(there / "bag.db3")
    found, unreadable = messages(link)
    writer.close()
    assert found == by_sqlite(whole)[:600]
    assert unreadable == []


@pytest.mark.parametrize(
    "change", ["id - 1000", "id - 5000", "-id", "id - 9223372036854775807 - 2"]
)
def test_row_numbers_may_be_negative(whole, tmp_path, change):
    path = tmp_path / "bag.db3"
    shutil.copy(whole, path)
    with sqlite3.connect(path) as connection:
        connection.execute(
            f"CREATE TABLE other AS SELECT {change} AS id, topic_id, timestamp, data FROM messages"
        )
        connection.execute("DELETE FROM messages")
        connection.execute("INSERT INTO messages SELECT * FROM other")
        connection.execute("DROP TABLE other")
    connection.close()
    found, unreadable = messages(path)
    assert found == by_sqlite(path)
    assert len(found) == 2 * STATES
    assert unreadable == []


def test_large_messages_keep_their_order(tmp_path):
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        # In the order of the numbers the names are not sorted.
        topics = [writer.add_connection(f"/{k}", JOINT_STATE, typestore=TYPES) for k in "ba"]
        for k in range(120):
            writer.write(topics[k % 2], k, bytes([k]) * (200_000 if k % 3 == 0 else 90 * k))
    found, unreadable = messages(path / "bag.db3")
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
def test_what_is_computed_in_place_of_a_table_is_refused(whole, tmp_path, capsys, deceit):
    path = tmp_path / "bag.db3"
    shutil.copy(whole, path)
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


def test_pages_that_lead_to_each_other_a_thousandfold_are_left(whole, tmp_path):
    raw = bytearray(whole.read_bytes())
    connection = sqlite3.connect(whole)
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
    found, unreadable = messages(path)
    assert len(found) <= 2 * STATES
    assert any("rows are not in order" in line for line in unreadable)
    with Storage(path) as bag:  # SQLite finds no row of this topic that it could give
        assert not list(bag.batches(frozenset({"/joint_trajectory"})))
        assert any("are left out: interrupted" in line for line in bag.unreadable)
