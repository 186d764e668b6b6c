"""A bag holds every byte that was written, whatever ended it, and other readers open it."""

import math
import os
import signal
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import pytest
import yaml
from harness.bags import JOINT_STATE, MS, BagReader, bits
from harness.chores import heeded_interrupts
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hpid_bench.cli.main import main
from hpid_bench.report.page import Paragraph, data_quality
from hpid_ros.base.errors import BagError, LibraryError, ResultExistsError
from hpid_ros.base.libraries import optional_libraries
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.metadata import (
    MISSED_ENTRY,
    STOOD_STILL_ENTRY,
    custom_data,
    missed_entries,
    missed_messages,
    time_stood_still,
)
from hpid_ros.messages.quality_lines import quality_lines
from hpid_ros.messages.run import read_run
from hpid_ros.messages.writer import BagTopic, BagWriter, TopicQos, jazzy_types, repair_bag

COMMAND = JointStateTemplate(["elbow"], effort=True)


def add_joint_commands(bag: BagWriter) -> BagTopic:
    return bag.add_topic("/joint_commands", JOINT_STATE)


def read_raw(path: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(path) as bag:
        return [tuple(message) for message in bag.messages()]


def mcap_file(bag: Path) -> Path:
    return bag / f"{bag.name}.mcap"


messages = st.lists(
    st.tuples(
        st.sampled_from(["/a", "/b"]), st.integers(0, 2**62), st.binary(min_size=1, max_size=40)
    )
)


def test_an_interrupt_in_the_middle_of_a_chunk_waits_for_its_end(tmp_path, monkeypatch):
    checksum = zlib.crc32

    def interrupted(data):
        os.kill(os.getpid(), signal.SIGTERM)
        return checksum(data)

    with heeded_interrupts(), BagWriter(tmp_path / "bag") as bag:
        bag.write(add_joint_commands(bag), MS, COMMAND.encode(MS, effort=[1.0]))
        with monkeypatch.context() as patched:
            patched.setattr(zlib, "crc32", interrupted)
            with pytest.raises(KeyboardInterrupt):
                bag.flush()
    assert len(read_raw(tmp_path / "bag")) == 1


@given(messages)
def test_every_byte_comes_back_in_the_order_of_the_log_times(written):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        with BagWriter(path) as bag:
            topics = {name: bag.add_topic(name, JOINT_STATE) for name in ("/a", "/b")}
            for name, log_time_ns, raw in written:
                bag.write(topics[name], log_time_ns, raw)
        assert bag.counts == {name: sum(m[0] == name for m in written) for name in topics}
        assert read_raw(path) == sorted(written, key=lambda message: message[1])


def test_another_reader_decodes_equal_values(tmp_path):
    values = (5e-324, -0.0, 1.7976931348623157e308, math.pi)
    names, stamp_ns = ["a", "bb", "ccc", "dddd"], 1_700_000_000_123_456_789
    template = JointStateTemplate(names, "base_link", position=True, effort=True)
    raw = template.encode(stamp_ns, position=values, effort=values[::-1])
    times = [stamp_ns + k * MS for k in range(1000)]
    with BagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("/arm/joint_states", JOINT_STATE)
        for time in times:
            bag.write(topic, time, raw)
    with mcap_file(tmp_path / "bag").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_summary().statistics.message_count == 1000
        decoded = list(reader.iter_decoded_messages())
    assert [message.log_time for _, _, message, _ in decoded] == times
    schema, channel, _, state = decoded[-1]
    assert (schema.name, channel.topic) == (JOINT_STATE, "/arm/joint_states")
    stamp = state.header.stamp
    assert (state.header.frame_id, stamp.sec * 10**9 + stamp.nanosec) == ("base_link", stamp_ns)
    assert list(state.name) == names
    assert bits(state.position) == bits(values)
    assert bits(state.effort) == bits(values[::-1])
    assert list(state.velocity) == []


def test_metadata_and_quality_of_service_are_kept(tmp_path):
    with BagWriter(tmp_path / "bag", metadata={"seed": "7", "law": "hpid μ=-0.3"}) as bag:
        bag.add_topic(
            "/joint_trajectory",
            "trajectory_msgs/msg/JointTrajectory",
            TopicQos(transient_local=True, depth=1),
        )
        bag.write(
            bag.add_topic("/odom", "nav_msgs/msg/Odometry", TopicQos(reliable=False)), 5, b"x"
        )
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics["/joint_trajectory"].msgcount == 0
        odom = bag.topics["/odom"]
        assert (odom.msgtype, odom.msgcount) == ("nav_msgs/msg/Odometry", 1)
    assert custom_data(tmp_path / "bag") == {"seed": "7", "law": "hpid μ=-0.3"}
    information = yaml.safe_load((tmp_path / "bag/metadata.yaml").read_text())
    trajectory, odom = information["rosbag2_bagfile_information"]["topics_with_message_count"]
    (offered,) = trajectory["topic_metadata"]["offered_qos_profiles"]
    assert (offered["durability"], offered["depth"]) == ("transient_local", 1)
    (offered,) = odom["topic_metadata"]["offered_qos_profiles"]
    assert (offered["reliability"], offered["durability"]) == ("best_effort", "volatile")


NUMBERED = """
- history: 2
  depth: 5
  reliability: 2
  durability: 1
  deadline: {sec: 1, nsec: 2}
  lifespan: {sec: 3, nsec: 4}
  liveliness: 3
  liveliness_lease_duration: {sec: 5, nsec: 6}
  avoid_ros_namespace_conventions: true
"""
NAMED = (
    NUMBERED.replace("history: 2", "history: KEEP_ALL")
    .replace("reliability: 2", "reliability: best_effort")
    .replace("durability: 1", "durability: transient_local")
    .replace("liveliness: 3", "liveliness: manual_by_topic")
)


@pytest.mark.parametrize("text", [NUMBERED, NAMED], ids=["numbers", "names"])
def test_a_quality_of_service_of_another_bag_is_kept_whatever_its_version(tmp_path, text):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/a", JOINT_STATE, text)
    with BagReader(tmp_path / "bag") as bag:
        (found,) = bag.topics["/a"].connections[0].ext.offered_qos_profiles
    assert (found.history.name, found.depth) == ("KEEP_ALL", 5)
    assert (found.reliability.name, found.durability.name) == ("BEST_EFFORT", "TRANSIENT_LOCAL")
    assert (found.deadline, found.lifespan) == ((1, 2), (3, 4))
    assert (found.liveliness.name, found.liveliness_lease_duration) == ("MANUAL_BY_TOPIC", (5, 6))
    assert found.avoid_ros_namespace_conventions


@pytest.mark.parametrize(
    "text",
    ["", "no list", "[1]", "{", "- {}", NUMBERED.replace("depth", "width"), "[[[[["]
    + [NUMBERED.replace("depth: 5", f"depth: {each}") for each in ("x", ".inf", "[1]", '"\\0"')],
)
def test_a_quality_of_service_that_cannot_be_read_is_that_of_a_plain_publisher(tmp_path, text):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/a", JOINT_STATE, text)
    with BagReader(tmp_path / "bag") as bag:
        (found,) = bag.topics["/a"].connections[0].ext.offered_qos_profiles
    assert (found.reliability.name, found.depth) == ("RELIABLE", 10)


def test_a_library_that_is_missing_is_named_before_anything_is_created(tmp_path, monkeypatch):
    for library in ("mcap", "rosbags"):
        with monkeypatch.context() as patched:
            for name in [each for each in sys.modules if each.partition(".")[0] == library]:
                patched.setitem(sys.modules, name, None)
            patched.delitem(sys.modules, "hpid_ros.messages.mcap_writer")
            jazzy_types.cache_clear()
            with (
                pytest.raises(LibraryError, match=f"bags.* needs {library}"),
                optional_libraries(),
            ):
                BagWriter(tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("written", "is_there"),
    [
        ([(0, b"first"), (499 * MS, b"second")], False),
        ([(0, b"first"), (499 * MS, b"second"), (500 * MS, b"third")], True),
        ([(90_000 * MS, b"first"), *((k * MS, b"after a reset") for k in range(501))], True),
        ([(k, b"first" + bytes(300_000)) for k in range(5)], True),
    ],
    ids=["soon", "half a second of log time", "a clock that went back", "a full chunk"],
)
def test_messages_reach_the_file_after_half_a_second_or_a_megabyte(tmp_path, written, is_there):
    with BagWriter(tmp_path / "bag") as bag:
        topic = add_joint_commands(bag)
        for log_time_ns, raw in written:
            bag.write(topic, log_time_ns, raw)
        raw = mcap_file(bag.path).read_bytes()
        assert (b"first" in raw) == is_there
        assert (written[-1][1] in raw) == is_there


def test_flush_hands_over_what_is_pending(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.flush()
        bag.write(add_joint_commands(bag), 0, b"pending")
        bag.flush()
        raw = mcap_file(bag.path).read_bytes()
        assert b"pending" in raw
        bag.flush()
        assert mcap_file(bag.path).read_bytes() == raw
    assert read_raw(bag.path) == [("/joint_commands", 0, b"pending")]


@pytest.mark.parametrize("error", [RuntimeError("stop"), KeyboardInterrupt()])
def test_an_exception_inside_leaves_a_readable_bag(tmp_path, error):
    def record() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            topic = add_joint_commands(bag)
            for k in range(3):
                bag.write(topic, k, COMMAND.encode(k, effort=[float(k)]))
            raise error

    with pytest.raises(type(error)):
        record()
    assert [log_time_ns for _, log_time_ns, _ in read_raw(tmp_path / "bag")] == [0, 1, 2]


def test_closing_twice_is_closing_once_and_nothing_can_be_written_after(tmp_path):
    bag = BagWriter(tmp_path / "bag")
    topic = add_joint_commands(bag)
    bag.write(topic, 1, b"x")
    bag.close()
    before = mcap_file(bag.path).read_bytes()
    bag.close()
    assert mcap_file(bag.path).read_bytes() == before
    for late in (
        lambda: bag.write(topic, 2, b"y"),
        lambda: bag.add_topic("/late", JOINT_STATE),
        bag.flush,
    ):
        with pytest.raises(BagError, match="is closed"):
            late()
    assert bag.counts == {"/joint_commands": 1}


def test_a_place_that_is_taken_or_cannot_be_written_is_refused_and_left_alone(tmp_path):
    folder, file = tmp_path / "folder", tmp_path / "file"
    folder.mkdir()
    file.write_text("precious")
    for path in (folder, file):
        with pytest.raises(ResultExistsError, match=f"{path.name} exists already") as caught:
            BagWriter(path)
        assert isinstance(caught.value, FileExistsError)
        assert "\n" not in str(caught.value)
    with pytest.raises(BagError, match=r"cannot create bag .*Not a directory"):
        BagWriter(file / "bag")
    assert list(folder.iterdir()) == []
    assert file.read_text() == "precious"


def test_wrong_use_is_refused_with_what_is_allowed(tmp_path):
    other = BagWriter(tmp_path / "other")
    with BagWriter(tmp_path / "bag") as bag:
        topic = add_joint_commands(bag)
        with pytest.raises(BagError, match="did you mean 'sensor_msgs/msg/JointState'"):
            bag.add_topic("/joint_states", "sensor_msgs/msg/JointStat")
        with pytest.raises(BagError, match="'/joint_commands' was added before"):
            add_joint_commands(bag)
        with pytest.raises(BagError, match=r"log time -1 ns of /joint_commands"):
            bag.write(topic, -1, b"x")
        with pytest.raises(BagError, match="/joint_commands is no topic of it"):
            bag.write(other.add_topic("/joint_commands", JOINT_STATE), 0, b"x")
    other.close()
    assert read_raw(bag.path) == []


FULL_DISK = """
import resource, sys
from hpid_ros.messages.writer import BagWriter
from hpid_ros.base.errors import BagError

def fill(path):
    with BagWriter(path) as bag:
        topic = bag.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        try:
            for k in range(10**6):
                bag.write(topic, k * 1_000_000, k.to_bytes(1000, "little"))
        except BagError as error:
            print(error)
        try:
            bag.write(topic, 0, b"")
        except BagError as error:
            print(error)
    return bag.counts["/joint_states"]

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
print(fill(sys.argv[1]))
"""


@pytest.fixture(scope="module")
def chunk_size(tmp_path_factory) -> int:
    """Return the size of the file that holds half a second of the messages above."""
    path = tmp_path_factory.mktemp("chunk") / "one"
    with BagWriter(path) as bag:
        topic = bag.add_topic("/joint_states", JOINT_STATE)
        for k in range(501):
            bag.write(topic, k * MS, bytes(1000))
        return mcap_file(path).stat().st_size


def fill_disk(bag: Path, limit: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", FULL_DISK, str(bag), str(limit)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("chunks", [0.99999, 2.3])
def test_a_full_disk_costs_only_the_messages_that_did_not_fit(tmp_path, chunk_size, chunks):
    path = tmp_path / "bag"
    run = fill_disk(path, int(chunks * chunk_size))
    assert run.stderr == ""
    first, second, count = run.stdout.splitlines()
    assert first == second
    assert "cannot be written: File too large" in first
    stored = [raw for _, _, raw in read_raw(path)]
    assert len(stored) == int(count) == 501 * int(chunks)
    assert stored == [k.to_bytes(1000, "little") for k in range(len(stored))]
    with BagReader(path) as bag:
        assert bag.topics["/joint_states"].msgcount == len(stored)
    with mcap_file(path).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == len(stored)
        assert sum(1 for _ in reader.iter_messages()) == len(stored)


def test_a_disk_without_room_for_the_index_is_said_when_closing(tmp_path, chunk_size):
    run = fill_disk(tmp_path / "bag", 2 * chunk_size)
    assert run.returncode == 1
    assert "BagError: cannot finish bag" in run.stderr.splitlines()[-1]
    assert not (tmp_path / "bag/metadata.yaml").exists()


@pytest.mark.parametrize(
    "meddle",
    [
        lambda bag: bag.rename(bag.with_name("elsewhere")),
        lambda bag: (bag / "bag.mcap").unlink(),
        lambda bag: (bag.rename(bag.with_name("old")), bag.mkdir(), (bag / "bag.mcap").touch()),
    ],
    ids=["folder moved", "file deleted", "replaced"],
)
def test_a_bag_that_is_gone_is_not_flushed_but_refused(tmp_path, meddle):
    writer = BagWriter(tmp_path / "bag")
    topic = add_joint_commands(writer)
    writer.write(topic, 0, b"x")
    writer.flush()
    meddle(tmp_path / "bag")
    writer.write(topic, MS, b"y")
    with pytest.raises(BagError, match="is gone: it was deleted, moved or replaced"):
        writer.flush()
    with pytest.raises(BagError, match="is gone"):
        writer.write(topic, 2 * MS, b"z")
    writer.close()
    # Whatever is there now is not this bag: nothing is written beside it.
    assert not (tmp_path / "bag" / "metadata.yaml").exists()


def bag_that_missed(path, count):
    """Write a bag of measured states whose recorder missed so many."""
    state = JointStateTemplate(["elbow"], position=True, effort=True)
    entries = missed_entries({"/joint_states": count}, 0.5 * count)
    with BagWriter(path, metadata=entries) as bag:
        topic = bag.add_topic("/joint_states", JOINT_STATE)
        for k in range(100):
            bag.write(topic, k * MS, state.encode(k * MS, position=[0.0], effort=[1.0]))
    return path


def test_what_a_recorder_missed_is_told_with_the_numbers_and_kept_by_a_repair(tmp_path, capsys):
    bag = bag_that_missed(tmp_path / "bag", 7)
    run = read_run(bag, "run")
    line = "the recorder missed 7 messages on /joint_states"
    assert run.quality.missed == {"/joint_states": 7}
    assert f"run 'run': {line}" in list(quality_lines(run))
    assert "the recorder stood still for 3.5 s" in "".join(quality_lines(run))
    assert Paragraph(line) in list(data_quality([run]))
    assert main(["metrics", str(bag)]) == 0
    assert line in capsys.readouterr().err
    repair_bag(bag, tmp_path / "repaired")
    assert read_run(tmp_path / "repaired", "run").quality.missed
    assert not read_run(bag_that_missed(tmp_path / "whole", 0), "run").quality.missing_lines


@pytest.mark.parametrize(
    "text", ["", "no json", "[1]", "nan", "-1", '{"/a": "7", "/b": -1, "/c": true}']
)
def test_an_entry_that_is_no_count_is_passed_over(text):
    assert missed_messages({MISSED_ENTRY: text}) == {}
    assert time_stood_still({STOOD_STILL_ENTRY: text}) == 0.0
