"""A parent that does not read its node's events: the node goes on, and tells them in the end."""

import fcntl
import struct
import time
from termios import FIONREAD

from harness.graph import ros_arguments
from rcl_interfaces.srv import ListParameters

from hpid_ros.messages.joint_state import JointStateTemplate

F_SETPIPE_SZ = 1031
SMALLEST = 4096  # [byte], of a pipe
MS = 1_000_000
STATE = JointStateTemplate(["elbow"], position=True)


def test_a_node_does_not_wait_for_a_parent_that_does_not_read(harness, tmp_path, faults):
    recorder = harness.processes.start(
        "recorder",
        "bag_recorder",
        ros_arguments(bag=tmp_path / "bag", topics="[joint_states]"),
    )
    assert fcntl.fcntl(recorder.events, F_SETPIPE_SZ, SMALLEST) == SMALLEST
    harness.wait(harness.states.get_subscription_count, what="the recorder")
    told, held, since = 0, 0, time.monotonic()

    def is_full():
        """Publish a state, and tell whether events have stopped coming for as long as twenty."""
        nonlocal told, held, since
        harness.states.publish(STATE.encode(told * MS, position=[0.0]))
        told += 1
        before, held = (
            held,
            struct.unpack("i", fcntl.ioctl(recorder.events, FIONREAD, bytes(4)))[0],
        )
        if held != before:
            since = time.monotonic()
        return held and time.monotonic() > since + 1.0

    harness.wait(is_full, what="the pipe to be full")
    names = harness.call(ListParameters, "/recorder/list_parameters", ListParameters.Request())
    assert "bag" in names.result.names

    events = recorder.read_events()  # at its end it waits half a second for who reads
    recorder.process.terminate()

    def is_closed():
        events.extend(recorder.read_events())
        return recorder.process.poll() is not None

    harness.wait(is_closed, what="the end")
    assert recorder.process.returncode == 0
    events.extend(recorder.read_events())
    counts = [each["counts"]["/joint_states"] for each in events if each["event"] == "recorded"]
    assert events[0]["event"] == "recording"
    assert events[-1]["event"] == "closed"
    assert counts == sorted(counts)
    assert 20 < counts[-1] <= events[-1]["counts"]["/joint_states"] <= told
    faults.count("parents that do not read: nodes that went on")
