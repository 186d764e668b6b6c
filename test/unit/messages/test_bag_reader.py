"""A run comes out of a bag as it went in, and a bag that is none is one clear line."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness.bags import (
    JOINT_STATE,
    TYPES,
    S,
    bits,
    command,
    convert,
    ramp,
    read_one,
    small_log,
    state,
    trajectory,
    write_bag,
)
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from hpid_ros.base.errors import BagError
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import Losses

finite = st.floats(-9e49, 9e49)  # beyond 1e50 no joint is
stamps = st.lists(st.integers(-(2**31) * S, 2**31 * S - 1), min_size=1, max_size=12, unique=True)


@given(stamps.flatmap(lambda t: st.tuples(*[st.tuples(st.just(s), finite, finite) for s in t])))
def test_values_come_back_to_the_bit_ordered_by_stamp(samples):
    with tempfile.TemporaryDirectory() as folder:
        log = []
        for k, (stamp_ns, position, effort) in enumerate(samples):
            for topic, _, raw in (
                state(stamp_ns, b=0.0, a=position),
                command(stamp_ns, a=effort),
                command(stamp_ns, b=1.0),
            ):
                log.append((topic, k, raw))
        series, losses = read_one(Path(folder) / "bag", log)
    in_order = sorted(samples)
    assert series.state_stamps_ns.tolist() == [stamp_ns for stamp_ns, _, _ in in_order]
    assert series.command_stamps_ns.tolist() == [stamp_ns for stamp_ns, _, _ in in_order]
    assert bits(series.position) == bits([position for _, position, _ in in_order])
    assert bits(series.effort) == bits([effort for _, _, effort in in_order])
    assert losses == Losses(0, 0)


def test_losses_are_counted_and_of_a_repeated_stamp_the_last_stands(tmp_path):
    log = [
        state(1, a=1.0, b=0.0),
        command(1, a=-1.0),
        state(2, a=9.0, b=0.0),
        state(2, a=2.0, b=0.0),
        command(2, b=0.5),
        state(4, a=4.0, b=0.0),
        ("joint_commands", 5, command(4, a=-4.0)[2]),
        ("joint_commands", 6, command(1, a=-1.5)[2]),
        ("joint_commands", 7, command(1, a=-1.25)[2]),
        ("joint_states", 8, state(3, a=3.0, b=0.0)[2]),
    ]
    run = read_run(write_bag(tmp_path / "bag", log), "run")
    a, b = run.joints
    assert (run.label, a.joint, b.joint) == ("run", "a", "b")
    assert a.state_stamps_ns.tolist() == [1, 2, 3, 4]
    assert a.position.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert a.command_stamps_ns.tolist() == [1, 4]
    assert a.effort.tolist() == [-1.25, -4.0]
    assert run.losses == {"a": Losses(2, 2), "b": Losses(3, 0)}


def test_a_joint_that_never_answered_is_read_with_all_its_states_lost(tmp_path):
    log = [state(1, a=1.0, b=2.0), command(1, a=0.0), state(2, a=1.0, b=2.0)]
    run = read_run(write_bag(tmp_path / "bag", log), "run", joints=["b", "a"])
    assert run.joint_names == ("b", "a")
    assert run.joints[0].effort.size == 0
    assert run.losses["b"] == Losses(2, 0)


def test_joints_that_nobody_controls_are_left_out_unless_asked_for(tmp_path):
    reference = trajectory(0, ramp("c", t0=1.0))
    log = [reference, state(1, a=1.0, caster=0.0, b=2.0, c=3.0), command(1, a=0.0, b=0.0, zz=1.0)]
    path = write_bag(tmp_path / "bag", log)
    assert read_run(path, "run").joint_names == ("a", "b", "c")
    assert read_run(path, "run", joints=["caster"]).joint_names == ("caster",)


def test_layouts_may_change_and_mix(tmp_path):
    big_endian = TYPES.serialize_cdr(
        TYPES.deserialize_cdr(state(3, a=3.0, b=-3.0)[2], JOINT_STATE),
        JOINT_STATE,
        little_endian=False,
    )
    odd_padding = bytearray(state(4, a=4.0, b=-4.0)[2])
    end_of_frame_id = 4 + 8 + 4 + 1
    odd_padding[end_of_frame_id : end_of_frame_id + 3] = b"\x07\x07\x07"
    framed = JointStateTemplate(["a"], "base", position=True, velocity=True, effort=True)
    no_position = JointStateTemplate(["a"], velocity=True)
    log = [
        state(1, a=1.0),
        ("joint_states", 2, framed.encode(2, position=[2.0], velocity=[0.0], effort=[0.0])),
        ("joint_states", 3, bytes(big_endian)),
        ("joint_states", 4, bytes(odd_padding)),
        state(5, b=-5.0, a=5.0),
        ("joint_states", 6, no_position.encode(6, velocity=[1.0])),
        state(7, other=1.0),
        state(8, a=8.0),
        ("joint_commands", 9, framed.encode(8, position=[0.0], velocity=[0.0], effort=[0.5])),
        command(9, b=0.1, a=0.9),
        ("joint_commands", 10, no_position.encode(10, velocity=[1.0])),
    ]
    series, losses = read_one(tmp_path / "bag", log)
    assert series.state_stamps_ns.tolist() == [1, 2, 3, 4, 5, 8]
    assert series.position.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 8.0]
    assert series.command_stamps_ns.tolist() == [8, 9]
    assert series.effort.tolist() == [0.5, 0.9]
    assert losses == Losses(5, 0)


def test_of_a_stamp_repeated_in_another_layout_the_last_stands_too(tmp_path):
    log = [state(1, a=1.0), state(1, a=2.0, b=0.0), state(1, a=3.0), command(1, a=0.0)]
    series, _ = read_one(tmp_path / "bag", log)
    assert series.position.tolist() == [3.0]


def test_more_layouts_than_are_worth_a_pass_are_all_read(tmp_path):
    log = []
    for k in range(150):
        template = JointStateTemplate(["a"], f"frame_{k:03}", position=True)
        log.append(("joint_states", k, template.encode(k, position=[float(k)])))
    series, _ = read_one(tmp_path / "bag", [*log, command(0, a=0.0)])
    assert series.position.tolist() == [float(k) for k in range(150)]


@pytest.mark.parametrize("name", ["joint_states", "/arm/joint_states", "arm/joint_states"])
def test_a_topic_is_found_with_or_without_its_namespace(tmp_path, name):
    log = [state(1, a=1.0), command(1, a=0.0)]
    path = write_bag(tmp_path / "bag", log, namespace="/arm/")
    run = read_run(path, "run", selection=BagSelection(states=name))
    assert run.joints[0].position.tolist() == [1.0]


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_other_storages_and_compressions_give_the_same_run(tmp_path, storage, mode):
    ours = write_bag(tmp_path / "ours", small_log())
    convert(ours, tmp_path / "theirs", storage, mode)
    assert_same_run(ours, tmp_path / "theirs")


def test_a_single_file_is_a_bag(tmp_path):
    ours = write_bag(tmp_path / "ours", small_log())
    convert(ours, tmp_path / "theirs", StoragePlugin.SQLITE3, CompressionMode.NONE)
    assert_same_run(ours, ours / "ours.mcap")
    assert_same_run(ours, tmp_path / "theirs" / "theirs.db3")


def assert_same_run(path: Path, other: Path) -> None:
    (expected,), (series,) = read_run(path, "run").joints, read_run(other, "run").joints
    for field in ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort"):
        np.testing.assert_array_equal(getattr(series, field), getattr(expected, field))
    assert len(series.position) == 59


def refused(path: Path, **options: object) -> str:
    with pytest.raises(BagError) as caught:
        read_run(path, "run", selection=BagSelection(**options))  # type: ignore[arg-type]
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    return line


def error_line(path: Path) -> str:
    try:
        read_run(path, "run")
    except BagError as error:
        return str(error)
    return ""


def test_what_is_no_bag_is_one_line(tmp_path):
    assert "no such file or folder" in refused(tmp_path / "missing")
    assert "the folder has no .mcap and no .db3 file" in refused(tmp_path)
    for name, content in (
        ("bag.txt", "x"),
        ("bag.mcap", ""),
        ("bag.db3", ""),
        ("b.mcap", "x" * 99),
    ):
        (tmp_path / name).write_text(content)
        assert "cannot read bag" in refused(tmp_path / name)
    for number, text in enumerate(("", "a: [", "[]", "rosbag2_bagfile_information: {version: 9}")):
        folder = tmp_path / f"folder{number}"
        folder.mkdir()
        (folder / "metadata.yaml").write_text(text)
        assert "no .mcap and no .db3 file" in refused(folder)
    named = {"rosbag2_bagfile_information": {"relative_file_paths": ["gone.mcap"]}}
    (tmp_path / "folder0" / "metadata.yaml").write_text(yaml.safe_dump(named))
    assert "gone.mcap: the file is missing" in refused(tmp_path / "folder0")


def test_a_missing_topic_joint_or_message_is_named_with_what_there_is(tmp_path):
    path = write_bag(tmp_path / "bag", small_log())
    line = refused(path, states="joint_state")
    assert "did you mean '/joint_states'" in line
    assert "known: /joint_commands, /joint_states, /joint_trajectory" in line
    assert "known: a, b" in refused(path, joints=["a", "elbow"])
    assert "is trajectory_msgs/msg/JointTrajectory, but must be" in refused(
        path, states="joint_trajectory"
    )
    assert "is trajectory_msgs/msg/JointTrajectory, but must be" in refused(
        path, commands="joint_trajectory"
    )
    assert "unknown topic 'nowhere'" in refused(path, reference="nowhere")
    empty = write_bag(tmp_path / "empty", [])
    assert "no message on /joint_states" in refused(empty)
    silent = write_bag(tmp_path / "silent", [state(1, a=1.0)])
    assert (
        "no message on /joint_commands; messages: /joint_commands 0, /joint_states 1"
        in refused(silent, commands="joint_commands")
    )
    (series,) = read_run(silent, "run").joints
    assert not series.has_effort
    assert not series.has_reference
    foreign = write_bag(tmp_path / "foreign", [state(1, a=1.0), command(1, b=1.0)])
    assert "no joint of /joint_states is commanded" in refused(foreign)


def test_values_that_no_analysis_can_use_are_named(tmp_path):
    nan = write_bag(tmp_path / "nan", [state(1, a=1.0), command(1, a=float("nan"))])
    assert "joint 'a': effort must be finite" in refused(nan)
    bad = write_bag(
        tmp_path / "bad", [("joint_states", 1, b"\x00\x01\x00\x00"), command(1, a=0.0)]
    )
    assert "a JointState of 4 bytes ends" in refused(bad)
    bad = write_bag(tmp_path / "worse", [*small_log(), ("joint_trajectory", 5, b"\x00\x01")])
    assert "/joint_trajectory at 5 ns: a JointTrajectory must start with" in refused(bad)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("kept", [0.0, 0.001, 0.3, 0.7, 0.95])
def test_a_truncated_file_gives_what_is_left_or_one_line(tmp_path, storage, kept):
    path = write_bag(tmp_path / "ours", small_log())
    convert(path, tmp_path / "bag", storage, CompressionMode.NONE)
    (file,) = (tmp_path / "bag").glob("bag.*")
    raw = file.read_bytes()
    file.write_bytes(raw[: int(len(raw) * kept)])
    (whole,) = read_run(path, "run").joints
    if line := error_line(tmp_path / "bag"):
        assert "\n" not in line
        assert str(tmp_path / "bag") in line
        return
    run = read_run(tmp_path / "bag", "run")
    (part,) = run.joints
    assert set(part.state_stamps_ns) <= set(whole.state_stamps_ns)
    assert set(part.position) <= set(whole.position)
    assert set(part.effort) <= set(whole.effort)
    assert run.quality.unreadable
    assert not run.quality.is_complete


def test_counts_that_differ_from_the_metadata_are_reported(tmp_path):
    path = write_bag(tmp_path / "bag", small_log())
    index = path / "metadata.yaml"
    index.write_text(index.read_text().replace("message_count: 59", "message_count: 60"))
    run = read_run(path, "run")
    assert run.quality.unreadable == (
        "metadata.yaml counts 60 messages on /joint_commands, not 59; 60 messages on "
        "/joint_states, not 59",
    )


@pytest.fixture(scope="module", params=["mcap", "db3", "metadata.yaml"])
def whole_bag(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    path = write_bag(folder / "ours", small_log())
    storage = StoragePlugin.SQLITE3 if request.param == "db3" else StoragePlugin.MCAP
    convert(path, folder / "bag", storage, CompressionMode.NONE)
    (file,) = (folder / "bag").glob(f"*{request.param}")
    return folder / "bag", file.name


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1))
def test_damaged_bytes_give_a_run_or_one_line(whole_bag, damage):
    whole, name = whole_bag
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        shutil.copytree(whole, path)
        raw = bytearray((path / name).read_bytes())
        for where, value in damage:
            raw[int(where * len(raw))] = value
        (path / name).write_bytes(raw)
        assert "\n" not in error_line(path)


def test_the_decoder_of_the_package_agrees_with_the_reader(tmp_path):
    raw = state(5, a=1.5)[2]
    series, _ = read_one(tmp_path / "bag", [("joint_states", 0, raw), command(5, a=0.0)])
    assert decode_joint_state(raw).position == tuple(series.position)
