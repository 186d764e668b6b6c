"""The bag_metrics node: numbers on a latched topic, and bags that are finished while it runs."""

import shutil

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness.graph import ros_arguments

from hpid_ros.base.errors import SettingError
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.writer import BagWriter
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.nodes.bag_metrics import FinishedBags
from hpid_ros.nodes.core.middleware import LATCHED

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINTS = ["elbow", "lift"]


def record(path, gain=1.0):
    """Write a bag of two joints that swing about their start."""
    state = JointStateTemplate(JOINTS, position=True)
    command = JointStateTemplate(JOINTS, effort=True)
    with BagWriter(path) as bag:
        states = bag.add_topic("/joint_states", JOINT_STATE)
        commands = bag.add_topic("/joint_commands", JOINT_STATE)
        for k, position in enumerate(np.sin(np.arange(500) / 50.0)):
            stamp_ns = 1_000_000 * k
            bag.write(states, 1 + stamp_ns, state.encode(stamp_ns, position=[position] * 2))
            effort = [-gain * position] * 2
            bag.write(commands, 2 + stamp_ns, command.encode(stamp_ns, effort=effort))
    return path


@pytest.fixture
def heard(harness):
    """Return the messages of ~/indices as they come."""
    messages = []
    harness.node.create_subscription(
        DiagnosticArray, "/bag_metrics/indices", messages.append, LATCHED
    )
    return messages


def start(harness, **parameters):
    harness.processes.start("bag_metrics", "bag_metrics", ros_arguments(**parameters))


def values(message):
    return {status.name: {v.key: v.value for v in status.values} for status in message.status}


ROBOT = """<robot name="slide"><link name="a"/><link name="b"/><link name="c"/>
<joint name="elbow" type="continuous"><parent link="a"/><child link="b"/></joint>
<joint name="lift" type="prismatic"><parent link="b"/><child link="c"/></joint></robot>"""


def test_the_numbers_of_its_bags_are_latched_with_their_units(harness, heard, tmp_path):
    bag, urdf = record(tmp_path / "first"), tmp_path / "robot.urdf"
    urdf.write_text(ROBOT)
    options = {"indices": "ivc,rmse", "units": "deg", "reference": "hold"}
    start(harness, bags=f"[{bag}]", keep_running=True, robot_description=urdf, **options)
    harness.wait(lambda: heard, what="the indices")
    run = run_indices(read_run(bag, "first", selection=BagSelection(reference="hold")))
    for joint, force, length, turn in (
        ("elbow", "N m", "deg", np.degrees(1.0)),
        ("lift", "N", "m", 1.0),
    ):
        known = run.joints[joint]
        rmse = turn * known["rmse"]
        told = values(heard[0])[f"first: {joint}"]
        found = {key: float(value) for key, value in told.items()}
        expected = {f"IVC [{force}]": known["ivc"], f"RMSE [{length}]": rmse}
        assert found == pytest.approx(expected)
    assert set(values(heard[0])["first: all joints"]) == {"IVC [N m, N]", "RMSE [deg, m]"}


def test_parts_of_its_bags_are_compared(harness, heard, tmp_path):
    bags = [record(tmp_path / "first"), record(tmp_path / "second", gain=2.0)]
    listed = f"[{bags[0]}, {bags[1]}]"
    start(harness, bags=listed, keep_running=True, windows="['second=0.1:0.3']", clock="receive")
    harness.wait(lambda: heard, what="the indices")
    part = BagSelection(start=0.1, end=0.3, clock="receive")
    ivc = run_indices(read_run(bags[1], "second", selection=part)).joints["elbow"]["ivc"]
    found = float(values(heard[0])["second: elbow"]["IVC [N m]"])
    assert found == pytest.approx(ivc, rel=0.02)


def test_each_bag_that_is_finished_in_a_watched_folder_is_reported(harness, heard, tmp_path):
    baseline = record(tmp_path / "baseline")
    folder = tmp_path / "recordings"
    record(folder / "old")
    start(harness, bags=f"[{baseline}]", watch=folder)
    harness.wait(lambda: heard, what="the baseline")
    cut_off = record(tmp_path / "cut_off")
    (cut_off / "metadata.yaml").unlink()
    cut_off.rename(folder / "cut_off")
    shutil.copytree(record(tmp_path / "elsewhere", gain=2.0), folder / "deep" / "new")
    harness.wait(lambda: len(heard) > 1, what="the new bag")
    found = values(heard[1])
    assert {name.split(":")[0] for name in found} == {"baseline", "new"}
    assert found["new: elbow"]["ITAE [rad s^2]"] == "undefined: no reference was recorded"
    ivc = [float(found[f"{run}: elbow"]["IVC [N m]"]) for run in ("baseline", "new")]
    assert ivc[1] == pytest.approx(2.0 * ivc[0])
    (folder / "broken").mkdir()
    (folder / "broken" / "metadata.yaml").write_text("no bag")
    record(folder / "last", gain=3.0)
    harness.wait(lambda: len(heard) > 2, what="the bag after a broken one")
    assert any(name.startswith("last:") for name in values(heard[2]))


def test_a_bag_is_told_once_when_its_metadata_no_longer_grows(tmp_path):
    bags = FinishedBags(tmp_path)
    metadata = tmp_path / "run" / "metadata.yaml"
    metadata.parent.mkdir()
    metadata.write_text("")
    assert [bags.new(), bags.new()] == [[], []]
    metadata.write_text("half")
    assert bags.new() == []
    metadata.write_text("all of it")
    assert bags.new() == []
    assert bags.new() == [metadata.parent]
    assert bags.new() == []
    assert FinishedBags(tmp_path).new() == []


def test_a_watched_folder_must_be_there(tmp_path):
    with pytest.raises(SettingError, match="watch must name a folder"):
        FinishedBags(tmp_path / "none")
