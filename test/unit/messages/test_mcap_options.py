"""Every combination of options that a writer of MCAP has gives what the format's library reads."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path

import pytest
from harness.bag_reader import BagReader
from harness.bags import MS, small_log
from harness.mcap_files import TYPES, write_mcap
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType

from hpid_ros.cli.main import main
from hpid_ros.messages.run import read_run
from hpid_ros.messages.storage import Storage
from hpid_ros.messages.writer import repair_bag

INDEXES = (IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL)
SWITCHES = (
    "use_statistics",
    "use_summary_offsets",
    "repeat_channels",
    "repeat_schemas",
    "enable_crcs",
)
WITHOUT_MESSAGE_INDEX = {"index_types": IndexType.CHUNK}  # noMessageIndex of rosbag2


def by_library(path: Path) -> list[tuple[str, str, int, bytes]]:
    # Its seeking reader raises KeyError where the summary does not repeat the schemas.
    with path.open("rb") as stream:
        return sorted(
            (channel.topic, schema.name, message.log_time, bytes(message.data))
            for schema, channel, message in NonSeekingReader(stream).iter_messages()
        )


def by_us(path: Path, *topics: str) -> list[tuple[str, str, int, bytes]]:
    with Storage(path) as bag:
        types = {name: info.type for name, info in bag.topics().items()}
        found = [
            (batch.topic, types[batch.topic], int(batch.log_times_ns[k]), batch.raw(k))
            for batch in bag.batches(frozenset(topics or types), lambda share: None)
            for k in range(len(batch.starts))
        ]
        assert all("it was read without" in line for line in bag.unreadable)
    return sorted(found)


@pytest.mark.parametrize("index", INDEXES, ids=str)
@pytest.mark.parametrize(
    ("use_chunking", "compression"),
    [(False, CompressionType.NONE), *((True, each) for each in CompressionType)],
)
def test_every_combination_of_options_gives_the_same_messages(
    tmp_path, use_chunking, compression, index
):
    path, log = tmp_path / "bag.mcap", small_log()
    for values in itertools.product((False, True), repeat=len(SWITCHES)):
        options = dict(zip(SWITCHES, values, strict=True))
        write_mcap(
            path,
            log,
            use_chunking=use_chunking,
            compression=compression,
            index_types=index,
            **options,
        )
        expected = by_library(path)
        assert len(expected) == len(log)
        assert by_us(path) == expected, options
        states = [each for each in expected if each[0] == "/joint_states"]
        assert by_us(path, "/joint_states") == states, options


def split_bag(folder: Path, log, *options: dict) -> Path:
    """Write a bag of one file for each of some options, with the metadata of rosbag2."""
    folder.mkdir()
    size = -(-len(log) // len(options))
    names = [f"bag_{k}.mcap" for k in range(len(options))]
    for k, (name, each) in enumerate(zip(names, options, strict=True)):
        write_mcap(folder / name, log[k * size : (k + 1) * size], **each)
    counts = "".join(
        f"    - topic_metadata: {{name: /{name}}}\n"
        f"      message_count: {sum(each[0] == name for each in log)}\n"
        for name in TYPES
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n"
        f"  relative_file_paths: [{', '.join(names)}]\n"
        f"  topics_with_message_count:\n{counts}"
    )
    return folder


def test_a_bag_without_message_index_is_measured_and_repaired_whole(tmp_path, capsys):
    log = small_log()
    path = write_mcap(tmp_path / "bag.mcap", log, **WITHOUT_MESSAGE_INDEX)
    assert main(["metrics", str(path), "--format", "csv"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert all("do not follow their reference" in line for line in lines)
    repair = repair_bag(path, tmp_path / "repaired")
    assert repair.unreadable == ()
    with BagReader(tmp_path / "repaired") as bag:
        assert sorted((m.topic[1:], m.log_time_ns, m.raw) for m in bag.messages()) == sorted(log)


def test_no_half_of_a_split_bag_is_lost(tmp_path):
    bag = split_bag(tmp_path / "bag", small_log(), WITHOUT_MESSAGE_INDEX, {})
    run = read_run(bag, "run")
    assert len(run.joints[0].position) == 59
    assert run.quality.unreadable == ()


def test_messages_that_the_statistics_count_and_the_file_has_not_are_told(tmp_path, capsys):
    path = write_mcap(tmp_path / "bag.mcap", small_log(), enable_crcs=False)
    raw = path.read_bytes()
    counts = raw.rindex(struct.pack("<HQ", 1, 59))  # /joint_states is channel 1
    changed = struct.pack("<HQ", 1, 61)
    path.write_bytes(raw[:counts] + changed + raw[counts + len(changed) :])
    line = "bag.mcap: its statistics count 61 messages on /joint_states, not 59"
    assert read_run(path, "run").quality.unreadable == (line,)
    assert main(["repair", str(path)]) == 0
    assert f"lost: {line}" in capsys.readouterr().out


def test_messages_that_the_metadata_count_and_no_file_has_are_told_in_one_line(tmp_path):
    log = [each for each in small_log() if each[1] < 600 * MS]
    bag = split_bag(tmp_path / "bag", log, {})
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 29", "message_count: 59"))
    with metadata.open("a") as file:
        file.write("    - topic_metadata: {name: /camera}\n      message_count: 7\n")
    assert read_run(bag, "run").quality.unreadable == (
        "metadata.yaml counts 7 messages on /camera, not 0; 59 messages on /joint_commands, "
        "not 29; 59 messages on /joint_states, not 29",
    )
