"""Bags as people keep them: renamed, next to each other, of ROS 1, with odd names in them.

Reports: idiezd2022/MSR-P3-irene_diez and khaledelwan21/Robotic_Arm_6DOF (files renamed next to
their old metadata.yaml), priban42/ObjectTrackingDataset and utexas-bwi/segbot_arm (ROS 1).
"""

import shutil
from pathlib import Path

import mcap.writer
import numpy as np
import pytest
from harness.bags import JOINT_STATE, TYPES, S, write_bag
from rosbags.rosbag1 import Writer as RosbagWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_bench.cli.main import main
from hpid_ros.base.errors import BagError
from hpid_ros.messages.columns import CONTROLLER_STATE
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.storage import bags_in
from hpid_ros.messages.writer import repair_bag

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\n"
        + "".join(
            f"trajectory_msgs/JointTrajectoryPoint {name}\n"
            for name in ("desired", "actual", "error")
        ),
        CONTROLLER_STATE,
    )
)
COUNT = 60
COMPRESSIONS = [None, *RosbagWriter.CompressionFormat]


def stamp(k: int) -> int:
    return 1_700_000_000 * S + k * S // 50


def state(types, k, names, position, effort=()):
    """Return a JointState of either ROS."""
    header, time = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    head = [k] if types is ROS1 else []
    return types.types[JOINT_STATE](
        header(*head, time(*divmod(stamp(k), S)), "base"),
        list(names),
        np.array(position, float),
        np.zeros(0),
        np.array(effort, float),
    )


def numbers(k):
    return np.sin(k / 7) * np.array([1.0, 2.0]), np.cos(k / 7) * np.array([3.0, 4.0])


def report(k):
    """Return what a joint_trajectory_controller of ROS 1 publishes on ``~/state``."""
    types = ROS1.types
    time, duration = types["builtin_interfaces/msg/Time"], types["builtin_interfaces/msg/Duration"]
    none = np.zeros(0)
    desired, actual, error = (
        types["trajectory_msgs/msg/JointTrajectoryPoint"](each, none, none, none, duration(0, 0))
        for each in (numbers(k)[0] + 0.25, numbers(k)[0], np.full(2, 0.25))
    )
    header = types["std_msgs/msg/Header"](k, time(*divmod(stamp(k), S)), "")
    return types[CONTROLLER_STATE](header, ["j1", "j2"], desired, actual, error)


def ros2_bag(path: Path, *messages) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/joint_states", JOINT_STATE, typestore=TYPES)
        for k in range(COUNT):
            for one in messages or [lambda k: state(TYPES, k, ["j1", "j2"], *numbers(k))]:
                raw = TYPES.serialize_cdr(one(k), JOINT_STATE)
                bag.write(topic, stamp(k), raw)
    return path


def ros1_bag(path: Path, compression=None) -> Path:
    writer = RosbagWriter(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer as bag:
        states = bag.add_connection("joint_states", JOINT_STATE, typestore=ROS1)
        reports = bag.add_connection("/arm/state", CONTROLLER_STATE, typestore=ROS1)
        for k in range(COUNT):
            raw = ROS1.serialize_ros1(state(ROS1, k, ["j1", "j2"], *numbers(k)), JOINT_STATE)
            bag.write(states, stamp(k), raw)
            bag.write(reports, stamp(k), ROS1.serialize_ros1(report(k), CONTROLLER_STATE))
    return path


def renamed(bag: Path, name: str) -> Path:
    (old,) = bag.glob("*.mcap")
    return old.rename(bag / name)


def same_numbers(run, other) -> None:
    assert run.joint_names == other.joint_names
    for one, two in zip(run.joints, other.joints, strict=True):
        for field in ("state_stamps_ns", "position", "command_stamps_ns", "effort"):
            np.testing.assert_array_equal(getattr(one, field), getattr(two, field))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return ros2_bag(tmp_path_factory.mktemp("plain") / "plain")


def test_a_renamed_file_is_read_with_a_line_and_repaired(plain, tmp_path):
    bag = shutil.copytree(plain, tmp_path / "bag")
    renamed(bag, "my_topics.mcap")
    run = read_run(bag, "run")
    same_numbers(run, read_run(plain, "run"))
    (line,) = run.quality.unreadable
    assert "metadata.yaml names plain.mcap, missing here: my_topics.mcap was read" in line
    saved = repair_bag(bag, tmp_path / "saved")
    assert saved.saved == {"/joint_states": COUNT}
    whole = read_run(tmp_path / "saved", "run")
    same_numbers(whole, run)
    assert whole.quality.unreadable == ()


def test_of_several_files_that_metadata_do_not_name_none_is_guessed(plain, tmp_path):
    bag = shutil.copytree(plain, tmp_path / "bag")
    file = renamed(bag, "one.mcap")
    shutil.copy(file, bag / "two.mcap")
    with pytest.raises(BagError, match=r"names plain.mcap.*and not one.mcap, two.mcap: name the"):
        read_run(bag, "run")
    same_numbers(read_run(bag / "one.mcap", "run"), read_run(plain, "run"))


def test_a_file_that_metadata_do_not_name_is_not_read_next_to_one_that_they_name(plain, tmp_path):
    bag = shutil.copytree(plain, tmp_path / "bag")
    shutil.copy(next(bag.glob("*.mcap")), bag / "copy.mcap")
    run = read_run(bag, "run")
    same_numbers(run, read_run(plain, "run"))
    (line,) = run.quality.unreadable
    assert "metadata.yaml does not name copy.mcap, not read" in line


@pytest.mark.parametrize("name", ["recording", "recording.bak", "recording.db3", "a.bag"])
def test_a_file_is_what_it_begins_with_whatever_it_is_called(plain, tmp_path, name):
    shutil.copy(next(plain.glob("*.mcap")), tmp_path / name)
    same_numbers(read_run(tmp_path / name, "run"), read_run(plain, "run"))


def test_a_folder_of_bags_is_several_runs_and_the_parts_of_one_are_one(plain, tmp_path, capsys):
    folder = tmp_path / "folder"
    for name in ("run_10", "run_9"):
        shutil.copytree(plain, folder / name)
    (folder / "notes").mkdir()
    assert [each.name for each in bags_in(folder)] == ["run_9", "run_10"]
    assert main(["metrics", str(folder), "--reference", "hold"]) == 0
    assert "run_9 and run_10: reference" in capsys.readouterr().out
    assert main(["identify", str(folder)]) == 2
    assert f"{folder} is a folder of bags, name one: run_9, run_10" in capsys.readouterr().err
    file = next(plain.glob("*.mcap"))
    parts, apart = tmp_path / "parts", tmp_path / "apart"
    for place, names in ((parts, ("bag_0", "bag_1")), (apart, ("before", "after"))):
        place.mkdir()
        for name in names:
            shutil.copy(file, place / f"{name}.mcap")
    assert bags_in(parts) == [parts]
    assert [each.name for each in bags_in(apart)] == ["after.mcap", "before.mcap"]


@pytest.mark.parametrize("compression", COMPRESSIONS, ids=str)
def test_a_bag_of_ros_1_has_the_columns_of_the_same_messages_of_ros_2(
    plain, tmp_path, compression
):
    run = read_run(ros1_bag(tmp_path / "run.bag", compression), "run")
    same_numbers(run, read_run(plain, "run"))
    assert run.quality.unreadable == ()
    for number, series in enumerate(run.joints):
        wanted = [numbers(k)[0][number] + 0.25 for k in range(COUNT)]
        np.testing.assert_array_equal(series.reference, wanted)


def test_messages_of_ros_1_in_mcap_are_read_and_a_repair_names_what_converts_them(plain, tmp_path):
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/JointState", "ros1msg", b"string[] name")
        channel = writer.register_channel("/joint_states", "ros1", schema)
        for k in range(COUNT):
            one = state(ROS1, k, ["j1", "j2"], *numbers(k))
            raw = bytes(ROS1.serialize_ros1(one, JOINT_STATE))
            writer.add_message(channel, stamp(k), raw if k else raw[:-1], stamp(k))
        writer.finish()
    run = read_run(path, "run")
    np.testing.assert_array_equal(
        run.joints[1].position, read_run(plain, "run").joints[1].position[1:]
    )
    (line,) = run.quality.unreadable
    assert "1 messages on /joint_states are no sensor_msgs/msg/JointState of ROS 1" in line
    with pytest.raises(BagError, match=r"is of ROS 1: rosbags-convert --src ros1.mcap"):
        repair_bag(path, tmp_path / "repaired")


def test_a_damaged_bag_of_ros_1_is_one_line_or_read_to_there(tmp_path, monkeypatch):
    path = ros1_bag(tmp_path / "run.bag", RosbagWriter.CompressionFormat.BZ2)
    whole = path.read_bytes()
    index = whole.index(b"index_pos=") + len(b"index_pos=")
    for raw, reason in (
        (whole[:20], "cannot read bag"),
        (whole[: len(whole) // 2], "cannot read bag"),
        (b"#ROSBAG V1.2\n" + whole[13:], "Bag version 102 is not supported"),
        (whole[:index] + bytes(8) + whole[index + 8 :], "rosbag reindex"),
    ):
        path.write_bytes(raw)
        with pytest.raises(BagError, match=reason) as error:
            read_run(path, "run")
        assert "\n" not in str(error.value)
    path.write_bytes(whole)
    monkeypatch.setenv("HPID_UNPACK_LIMIT", "0")
    monkeypatch.setattr("hpid_ros.messages.mcap_file.RATIO", 1)
    with pytest.raises(BagError, match="would unpack to more than"):
        read_run(path, "run")


def test_names_that_are_missing_or_too_many_are_told_and_what_is_left_is_read(tmp_path):
    bag = ros2_bag(tmp_path / "none", lambda k: state(TYPES, k, [], *numbers(k)))
    with pytest.raises(
        BagError, match=r"positions of 60 messages on /joint_states .* no name for 2"
    ):
        read_run(bag, "run")
    bag = ros2_bag(
        tmp_path / "some",
        lambda k: state(TYPES, k, [] if k % 4 == 0 else ["j1", "j2"], *numbers(k)),
    )
    run = read_run(bag, "run")
    assert len(run.joints[0].position) == COUNT * 3 // 4
    assert any("positions of 15 messages" in line for line in run.quality.unreadable)
    bag = ros2_bag(
        tmp_path / "short",
        lambda k: state(TYPES, k, ["j1", "j2", "finger"], [*numbers(k)[0], 0.1], numbers(k)[1]),
    )
    run = read_run(bag, "run")
    assert run.joint_names == ("j1", "j2", "finger")
    assert not run.joints[0].has_effort
    (line,) = run.quality.unreadable
    assert "efforts of 60 messages on /joint_states" in line
    assert "3 names for 2" in line


def test_interfaces_in_place_of_joints_are_the_joints_positions_and_efforts(tmp_path):
    names = ["j1/position", "j1/velocity", "j1/effort", "arm/j2"]
    bag = ros2_bag(tmp_path / "bag", lambda k: state(TYPES, k, names, [k, 1, 2, 3], [0, 0, k, 4]))
    run = read_run(bag, "run")
    assert run.joint_names == ("j1", "arm/j2")
    np.testing.assert_array_equal(run.joints[0].position, np.arange(COUNT))
    np.testing.assert_array_equal(run.joints[0].effort, np.arange(COUNT))
    assert any("j1/velocity, j1/effort are no positions" in x for x in run.quality.unreadable)


def test_joints_are_chosen_by_patterns_and_left_out(tmp_path, capsys):
    names = ["arm_2", "arm_1", "l_finger", "r_finger", "odd[1]"]
    bag = ros2_bag(tmp_path / "bag", lambda k: state(TYPES, k, names, [k, 2, 3, 4, 5]))

    def chosen(*joints):
        return read_run(bag, "run", selection=BagSelection(joints=joints)).joint_names

    assert chosen("arm_*") == ("arm_2", "arm_1")
    assert chosen("arm_1", "arm_*") == ("arm_1", "arm_2")
    assert chosen("!*finger") == ("arm_2", "arm_1", "odd[1]")
    assert chosen("^*finger", "^odd[1]") == ("arm_2", "arm_1")
    assert chosen("*_*", "!r_*") == ("arm_2", "arm_1", "l_finger")
    assert chosen("odd[1]") == ("odd[1]",)
    for wrong in (["leg_*"], ["!leg_*"], ["arm_*", "!arm_*"]):
        with pytest.raises(BagError, match="known: "):
            chosen(*wrong)
    assert main(["metrics", str(bag), "--reference", "hold", "--csv", "--joint", "!*finger"]) == 0
    out = capsys.readouterr().out
    assert "arm_1" in out
    assert "finger" not in out


def test_our_own_bags_are_read_as_before(tmp_path):
    bag = write_bag(tmp_path / "bag", [])
    assert bags_in(bag) == [bag]
