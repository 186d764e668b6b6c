"""What was acknowledged is in the bag, whatever ended the recorder; and a repair finds it."""

import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from harness.bags import BagReader, convert
from harness.graph import ros_arguments
from harness.studies import wait_until
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from hpid_bench.cli.main import main
from hpid_ros.base.errors import BagError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.storage import Storage
from hpid_ros.messages.writer import BagWriter, TopicQos, repair_bag

JOINT_STATE = "sensor_msgs/msg/JointState"
MS = 1_000_000
STATE = JointStateTemplate(["elbow"], position=True)
COMMAND = JointStateTemplate(["elbow"], effort=True)


def write_bag(path):
    """Write states at 100 Hz and the commands that answer them, and return the messages."""
    messages = []
    with BagWriter(path) as bag:
        topics = {
            name: bag.add_topic(name, JOINT_STATE) for name in ("/joint_states", "/joint_commands")
        }
        for stamp_ns in range(0, 4000 * MS, 10 * MS):
            for name, raw in (
                ("/joint_states", STATE.encode(stamp_ns, position=[1e-9 * stamp_ns])),
                ("/joint_commands", COMMAND.encode(stamp_ns, effort=[1.0])),
            ):
                bag.write(topics[name], stamp_ns, raw)
                messages.append((name, stamp_ns, raw))
    return messages


def read_raw(path):
    with BagReader(path) as bag:
        return [tuple(message) for message in bag.messages()]


def mcap_of(bag):
    (file,) = bag.glob("*.mcap")
    return file


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a whole bag and its messages."""
    path = tmp_path_factory.mktemp("whole") / "bag"
    return path, write_bag(path)


def test_a_whole_bag_is_repaired_to_the_same_messages(whole, tmp_path):
    path, messages = whole
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    repair = repair_bag(path, tmp_path / "repaired")
    assert (repair.unreadable, sum(repair.saved.values())) == ((), len(messages))
    assert read_raw(repair.target) == messages
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before
    with mcap_of(repair.target).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == len(messages)


def damaged(raw, chance):
    """Return a bag's bytes cut somewhere, or with some bits flipped."""
    raw = bytearray(raw)
    if chance.random() < 0.5:
        del raw[chance.randrange(len(raw)) :]
    else:
        for _ in range(chance.randint(1, 5)):
            raw[chance.randrange(len(raw))] ^= 1 << chance.randrange(8)
    return bytes(raw)


@pytest.mark.parametrize("seed", range(60))
def test_a_cut_or_bit_flipped_bag_loses_the_damaged_part_and_invents_nothing(
    whole, tmp_path, faults, seed
):
    path, messages = whole
    bag = tmp_path / "bag.mcap"
    bag.write_bytes(damaged(mcap_of(path).read_bytes(), random.Random(seed)))
    faults.count("bags cut or bit-flipped")
    line = ""
    try:
        repair = repair_bag(bag, tmp_path / "repaired")
    except BagError as error:
        line = str(error)
    else:
        # Names of topics are not protected by a checksum, numbers are.
        saved = [message[1:] for message in read_raw(repair.target)]
        assert set(saved) <= {message[1:] for message in messages}
        assert len(saved) == len(set(saved))
        assert len(saved) == len(messages) or repair.unreadable
    assert "\n" not in line
    assert bool(line) != (tmp_path / "repaired").exists()


def test_the_command_says_what_was_saved_and_lost_and_keeps_the_old_bag(
    whole, tmp_path, hpid, refused
):
    path, messages = whole
    bag = tmp_path / "bag"
    shutil.copytree(path, bag)
    mcap_of(bag).write_bytes(mcap_of(bag).read_bytes()[: mcap_of(bag).stat().st_size * 3 // 5])
    (bag / "metadata.yaml").unlink()
    before = mcap_of(bag).read_bytes()
    code, told, _ = hpid("repair", bag)
    assert code == 0
    assert "saved: " in told
    assert "lost: metadata.yaml is missing" in told
    assert f"written: {tmp_path / 'bag_repaired'}" in told
    assert mcap_of(bag).read_bytes() == before
    saved = read_raw(tmp_path / "bag_repaired")
    assert saved == messages[: len(saved)]
    assert len(saved) > 0.5 * len(messages)
    assert "exists already, nothing is overwritten" in refused("repair", bag)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"no bag at all" * 100])
def test_a_bag_of_which_nothing_can_be_read_is_one_line(tmp_path, refused, content):
    (tmp_path / "empty.mcap").write_bytes(content)
    refused("repair", tmp_path / "empty.mcap")
    assert not (tmp_path / "empty_repaired").exists()


@pytest.mark.parametrize("definition", ["float64 value", ""])
def test_a_type_that_jazzy_lacks_keeps_its_definition_or_has_none(tmp_path, definition):
    """None as of /tf in a bag of Foxy, whose files have no definitions."""
    with BagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("/own", "my_msgs/msg/Own", definition=definition)
        bag.write(topic, 5, b"\x00\x01\x00\x00" + bytes(8))
        bag.write(bag.add_topic("/joint_states", JOINT_STATE), 6, STATE.encode(6, position=[0.0]))
    repair = repair_bag(tmp_path / "bag", tmp_path / "repaired")
    assert repair.saved == {"/own": 1, "/joint_states": 1}
    with Storage(tmp_path / "repaired") as bag:
        info = bag.topics()["/own"]
    assert (info.type, info.definition) == ("my_msgs/msg/Own", definition)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_offered_qualities_of_service_are_kept(tmp_path, storage):
    """Else RViz finds neither transforms nor model in a repaired bag that is played."""
    offered = TopicQos(reliable=False, transient_local=True, depth=3)
    with BagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("/joint_states", JOINT_STATE, offered)
        bag.write(topic, 6, STATE.encode(6, position=[0.0]))
    convert(tmp_path / "bag", tmp_path / "other", storage, CompressionMode.NONE)
    (tmp_path / "other" / "metadata.yaml").unlink()
    repair_bag(tmp_path / "other", tmp_path / "repaired")
    with Reader(tmp_path / "bag") as before, Reader(tmp_path / "repaired") as after:
        assert after.connections[0].ext == before.connections[0].ext


def test_kill_minus_nine_costs_nothing_that_was_acknowledged(harness, tmp_path, faults):
    """The recorder's parent hears a count only when the file holds as many."""
    publish = harness.states
    recorder = harness.processes.start(
        "recorder", "bag_recorder", ros_arguments(bag=tmp_path / "bag", topics="[joint_states]")
    )
    harness.wait(lambda: publish.get_subscription_count() == 1, what="the recorder")

    def recorded():
        counts = [e["counts"] for e in recorder.read_events() if e["event"] == "recorded"]
        return counts[-1]["/joint_states"] if counts else acknowledged

    acknowledged = sent = 0
    while acknowledged < 300:
        if sent < acknowledged + 3000:  # of the 4000 that it may fall behind
            publish.publish(STATE.encode(sent * MS, position=[0.0]))
            sent += 1
        harness.executor.spin_once(timeout_sec=0.001)
        acknowledged = recorded()
    recorder.process.kill()
    recorder.process.wait()
    acknowledged = recorded()
    repair = repair_bag(tmp_path / "bag", tmp_path / "repaired")
    saved = read_raw(tmp_path / "repaired")
    assert len(saved) >= acknowledged
    assert [raw for _, _, raw in saved] == [
        STATE.encode(k * MS, position=[0.0]) for k in range(len(saved))
    ]
    assert any("stopped by force" in line for line in repair.unreadable)
    faults.count("recorder killed: messages acknowledged", acknowledged)
    faults.count("recorder killed: acknowledged messages lost", 0)


HPID = (sys.executable, "-m", "hpid_bench.cli.main")
MOUNTS = ("unshare", "--mount", "--")


def mounts_are_permitted():
    command = [*MOUNTS, "mount", "-t", "tmpfs", "none", "/mnt"]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


needs_mounts = pytest.mark.skipif(
    not mounts_are_permitted(), reason="this system permits no mount namespace"
)


def run_on_mount(folder, options, experiment):
    """Run an experiment whose result is on a file system with these options."""
    code = f'mount -t tmpfs -o {options} none {folder} && exec "$@"'
    command = [*MOUNTS, "sh", "-c", code, "sh", *HPID, "run", experiment, "--composed"]
    command += ["--output", folder / "result"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@needs_mounts
@pytest.mark.parametrize(
    ("options", "reason"),
    [("size=1500k", "No space left on device"), ("ro", "Read-only file system")],
)
def test_a_full_disk_or_a_read_only_folder_ends_a_run_in_one_line(
    experiment_file, tmp_path, faults, options, reason
):
    folder = tmp_path / "mount"
    folder.mkdir()
    run = run_on_mount(folder, options, experiment_file(duration=60.0))
    assert run.returncode in (1, 2)
    lines = [line for line in run.stderr.splitlines() if line.startswith("hpid: ")]
    assert len(lines) == 1
    assert reason.lower() in lines[0].lower()
    assert "Traceback" not in run.stderr
    faults.count("runs on a full or read-only disk, ended in one line")


def test_a_run_whose_bridge_is_killed_with_its_recorder_leaves_a_bag_that_can_be_measured(
    experiment_file, tmp_path
):
    folder = tmp_path / "result"
    command = [*HPID, "run", str(experiment_file(duration=100.0)), "--composed"]
    run = subprocess.Popen(
        [*command, "--output", str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )

    def size():
        return sum(file.stat().st_size for file in folder.glob("bags/*/*.mcap"))

    try:
        wait_until(lambda: size() > 300_000)
        os.kill(bridge_below(run.pid), signal.SIGKILL)
        assert run.wait(timeout=30) == 1
    finally:
        run.kill()
        run.wait()
    (bag,) = (folder / "bags").iterdir()
    assert main(["repair", str(bag)]) == 0
    assert main(["metrics", str(bag.with_name(f"{bag.name}_repaired"))]) == 0


def bridge_below(parent):
    for path in Path("/proc").glob("[0-9]*"):
        try:
            is_child = int((path / "stat").read_text().rpartition(")")[2].split()[1]) == parent
            if is_child and (path / "comm").read_text().endswith("_bridge\n"):
                return int(path.name)
        except (FileNotFoundError, ProcessLookupError):
            continue
    raise AssertionError("no bridge")
