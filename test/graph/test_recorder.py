"""The recorder: it says what it missed and that it failed, and acknowledges nothing else."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import yaml
from harness.bags import BagReader
from harness.fork_server import run_node
from harness.graph import ros_arguments
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.metadata import (
    MISSED_ENTRY,
    STOOD_STILL_ENTRY,
    custom_data,
    recorded_slides,
)
from hpid_ros.messages.writer import repair_bag
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED

MS = 1_000_000
JOINT_STATE = "sensor_msgs/msg/JointState"
STATE = JointStateTemplate(["elbow"], position=True, effort=True)


def state(k):
    return STATE.encode(k * MS, position=[0.0], effort=[0.0])


def record(harness, bag, **parameters):
    """Start a recorder, by default of the states, and wait until it listens to them."""
    arguments = ros_arguments(bag=bag, **{"topics": "[joint_states]", **parameters})
    recorder = harness.processes.start("recorder", "bag_recorder", arguments)
    harness.wait(lambda: harness.states.get_subscription_count() == 1, what="the recorder")
    return recorder


def test_states_are_asked_for_when_the_latched_reference_is_in_the_bag(harness, tmp_path):
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    topics = "[joint_trajectory, joint_states]"
    arguments = ros_arguments(bag=tmp_path / "bag", topics=topics, slides="[lift]")
    recorder = harness.processes.start("recorder", "bag_recorder", arguments)
    harness.wait(lambda: publisher.get_subscription_count() == 1, what="the recorder")
    begin = time.monotonic()
    harness.wait(lambda: time.monotonic() > begin + 0.5, what="a moment")
    count, now = harness.states.get_subscription_count(), time.time()
    (since,) = re.findall(r"\[(\d+\.\d+)\].*recording /joint_trajectory", recorder.log.read_text())
    assert count == 0 or now > float(since) + 2.0  # for so long it waits for a latched reference
    publisher.publish(JointTrajectory(joint_names=["elbow"]))
    harness.wait(lambda: harness.states.get_subscription_count() == 1, what="the states")
    harness.states.publish(state(0))
    events = Events(recorder)
    harness.wait(lambda: events.recorded() == 1, what="the state")
    recorder.process.terminate()
    assert recorder.process.wait(timeout=60) == 0
    with BagReader(tmp_path / "bag") as bag:
        topics = [message.topic for message in bag.messages()]
    assert topics == ["/joint_trajectory", "/joint_states"]
    assert recorded_slides(custom_data(tmp_path / "bag")) == {"lift"}


def test_a_latched_topic_without_a_message_is_not_waited_for_long(harness, tmp_path):
    harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    record(harness, tmp_path / "bag", topics="[joint_trajectory, joint_states]")


def test_a_recorder_that_is_refused_leaves_no_folder_and_removes_none(harness, tmp_path):
    for bag in (tmp_path / "bag", tmp_path):
        refused = run_node("bag_recorder", ros_arguments(bag=bag, topic="[joint_states]"))
        assert refused.returncode == 2
    assert list(tmp_path.iterdir()) == []


class Events:
    """The events of a recorder so far."""

    def __init__(self, recorder):
        self._recorder, self.all = recorder, []

    def last(self, name):
        self.all += self._recorder.read_events()
        return next((e for e in reversed(self.all) if e["event"] == name), {})

    def recorded(self):
        return self.last("recorded").get("counts", {}).get("/joint_states", 0)


FLOOD = """
import sys, rclpy
from sensor_msgs.msg import JointState
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.nodes.core.middleware import OFFERED
rclpy.init()
publisher = rclpy.create_node("flood").create_publisher(JointState, "joint_states", OFFERED)
state = JointStateTemplate(["elbow"], position=True, effort=True)
raw = state.encode(1, position=[0.0], effort=[0.0])
for line in sys.stdin:
    for _ in range(int(line)):
        publisher.publish(raw)
    print("published", flush=True)
"""


@pytest.fixture
def flood(harness):
    """Return a function that publishes so many states, from a process with DDS's own lease."""
    environment = {k: v for k, v in harness.environment.items() if k not in PROFILE_FILES}
    process = subprocess.Popen(
        [sys.executable, "-c", FLOOD],
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )

    def publish(count):
        process.stdin.write(f"{count}\n")
        process.stdin.flush()
        assert process.stdout.readline() == "published\n"

    try:
        yield publish
    finally:
        process.kill()
        process.communicate()


@pytest.mark.alone  # a freeze that lasts longer than DDS's lease is another story
def test_a_recorder_that_was_frozen_tells_what_it_missed(harness, tmp_path, faults, flood):
    """Everything that was sent is recorded or told, to the message, wherever one looks."""
    recorder = record(harness, tmp_path / "bag")
    events = Events(recorder)
    publishers = harness.node.get_publishers_info_by_topic
    harness.wait(lambda: len(publishers("/joint_states")) == 2, what="the flood")
    sent = 0
    while not events.recorded():  # it may not have found the flood yet
        flood(1)
        sent += 1
        harness.executor.spin_once(timeout_sec=0.05)
    first = sent - events.recorded()  # sent before the two had found each other
    frozen_at = time.monotonic()
    recorder.process.send_signal(signal.SIGSTOP)
    flood(30_000)
    harness.wait(lambda: time.monotonic() > frozen_at + 2.2, what="the end of the freeze")
    recorder.process.send_signal(signal.SIGCONT)

    def missed():
        return events.last("recorded").get("missed", {}).get("/joint_states", 0)

    def accounted_for():
        return events.recorded() + missed() >= sent - first + 30_000

    harness.wait(accounted_for, 60.0, "all to be accounted for")
    assert missed() > 10_000
    recorder.process.terminate()
    assert recorder.process.wait(timeout=60) == 0
    closed = events.last("closed")
    assert closed["counts"] == {"/joint_states": events.recorded()}
    assert closed["missed"] == {"/joint_states": missed()}
    assert sent - first <= events.recorded() + missed() - 30_000 <= sent
    assert events.last("stood_still")["duration"] > 2.0
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert json.loads(custom[MISSED_ENTRY]) == {"/joint_states": missed()}
    assert float(custom[STOOD_STILL_ENTRY]) > 2.0
    with BagReader(tmp_path / "bag") as bag:
        assert len(list(bag.messages())) == events.recorded()
    assert recorder.last_words().endswith(f"missed {missed()} on /joint_states")
    faults.count("recorder frozen: messages that it missed and told", missed())
    faults.count("recorder frozen: messages neither recorded nor told", 0)


@pytest.mark.parametrize("is_asked_to_end", [False, True])
def test_a_recorder_whose_folder_is_gone_stops_acknowledging_and_fails(
    harness, tmp_path, faults, is_asked_to_end
):
    recorder = record(harness, tmp_path / "bag")
    events = Events(recorder)
    harness.states.publish(state(0))
    harness.wait(lambda: events.recorded() == 1, what="the first message")
    shutil.rmtree(tmp_path / "bag")
    if is_asked_to_end:
        recorder.process.terminate()
    else:
        harness.states.publish(state(1))
    harness.wait(lambda: recorder.process.poll() is not None, what="the recorder to end")
    assert recorder.process.returncode == 1
    failed = events.last("failed")
    assert "is gone: it was deleted, moved or replaced" in failed["reason"]
    assert events.all[-1] == failed
    assert events.recorded() == 1
    assert "is gone" in recorder.last_words()
    faults.count("recorder's folder deleted: told, and ended with 1")


def test_a_bridge_that_records_has_every_state_and_ends_when_its_bag_is_gone(harness, tmp_path):
    """Its recorder subscribes to neither states nor commands."""
    arguments = ros_arguments(
        bag=tmp_path / "bag",
        record=True,
        topics="[joint_commands, joint_states]",
        robot_description="urdf/mobile_manipulator.urdf",
        mode="realtime",
        wait_for_publishers=0,
    )
    start = harness.processes.start
    bridge = start("bridge", "mujoco_bridge", arguments, is_renamed=False)
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    events = Events(bridge)
    harness.wait(lambda: events.recorded() > 10, what="recorded states")
    assert not harness.subscribes("bag_recorder", "/joint_states")

    def is_recorded():
        commands.publish(state(0))
        return events.last("recorded")["counts"]["/joint_commands"]

    harness.wait(is_recorded, what="a command")
    acknowledged = events.recorded()
    (tmp_path / "bag").rename(tmp_path / "kept")
    harness.wait(lambda: bridge.process.poll() is not None, what="the bridge to end")
    assert bridge.process.returncode == 1
    saved = repair_bag(tmp_path / "kept", tmp_path / "repaired").saved
    assert saved["/joint_commands"] >= 1
    assert saved["/joint_states"] >= acknowledged
