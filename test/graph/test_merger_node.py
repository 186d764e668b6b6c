"""The merger on a graph: controllers before it, ros2_control as it was seen to be behind it."""

import math
import signal
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness.goals import needs_control_msgs
from harness.graph import Told, change, is_stopped, ros_arguments, state
from harness.ros2_control import NAME, Ros2Control
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import NEWEST_COMMAND, OFFERED, RARE

MS = 1_000_000
MERGER = "joint_command_merger"
INERTIAS = {"elbow": 0.5, "shoulder": 2.0, "wrist": 0.1}
ORDER = ["wrist", "shoulder", "elbow"]  # neither of the alphabet nor of the states
TARGETS = {"wrist": 0.3, "shoulder": -0.2, "elbow": 0.5}
WITHIN = 60.0  # [s], on a busy machine


@pytest.fixture
def control(harness):
    with Ros2Control(harness.context, INERTIAS) as control:
        yield control


@pytest.fixture
def told(harness):
    return Told(harness, MERGER)


@pytest.fixture(scope="module")
def bench(module_harness):
    """Return a merger that no test ends, with the stand-in's controller behind it."""
    with Ros2Control(module_harness.context, INERTIAS) as control:
        merger = start_merger(module_harness)
        yield SimpleNamespace(
            harness=module_harness,
            process=merger.process,
            control=control,
            told=Told(module_harness, MERGER),
            command=Commander(module_harness),
        )


@pytest.fixture
def merging(bench):
    """Yield the bench with a controller that has just been loaded, and merged for."""
    bench.control.load(ORDER)
    controller = bench.control.controller
    bench.command.until(EFFORTS, lambda: len(controller.received) > 1, "commands")
    yield bench
    print(bench.told.newest())  # shown where a test fails


def start_merger(harness, **parameters):
    """Start a merger, by default for the stand-in's controller."""
    parameters = {"controller": NAME, "command_timeout": 0.5} | parameters
    arguments = ros_arguments(**{k: v for k, v in parameters.items() if v is not None})
    return harness.processes.start(MERGER, MERGER, arguments)


def says(told, text):
    """Tell whether the newest health has these words."""
    return text in told.newest().get("message", "")


class Commander:
    """Commands of joints as controllers send them, all of them from the test."""

    def __init__(self, harness, joints=ORDER, sender="/{}_controller"):
        self.harness, self.stamp = harness, 0
        self._publishers = {
            joint: harness.node.create_publisher(JointState, "joint_commands", OFFERED)
            for joint in joints
        }
        self._templates = {
            joint: JointStateTemplate([joint], sender.format(joint), effort=True)
            for joint in joints
        }

    def __call__(self, efforts):
        """Answer one more state."""
        self.stamp += 10 * MS
        for joint, effort in efforts.items():
            raw = self._templates[joint].encode(self.stamp, effort=[effort])
            self._publishers[joint].publish(raw)

    def until(self, efforts, condition, what):
        """Answer states until a condition holds."""

        def holds():
            self(efforts)
            return condition()

        self.harness.wait(holds, WITHIN, what)


EFFORTS = {"wrist": 1.0, "shoulder": 2.0, "elbow": 3.0}


@contextmanager
def listening(harness, kind, topic):
    """Yield what is heard on a topic of merged commands."""
    heard = []
    subscription = harness.node.create_subscription(kind, topic, heard.append, 100)
    yield heard
    harness.node.destroy_subscription(subscription)


# --- with controllers and a robot ---------------------------------------------------------


def drive(harness, control, joints, setpoints):
    """Send joints to where they are wanted, until all are there.

    For a while a process that was killed counts as one that listens: so it is said again.
    """
    for joint in set(joints) - setpoints.keys():
        setpoints[joint] = harness.node.create_publisher(
            Float64, f"{joint}_controller/setpoint", RARE
        )
    said_at = -math.inf

    def are_driven():
        nonlocal said_at
        if time.monotonic() > said_at + 1.0:
            said_at = time.monotonic()
            for joint in joints:
                setpoints[joint].publish(Float64(data=TARGETS[joint]))
        return are_there(control)

    harness.wait(are_driven, WITHIN, "the joints where they are wanted")


def are_there(control, joints=ORDER):
    return all(abs(control.hardware[j].position - TARGETS[j]) < 0.01 for j in joints)


@pytest.mark.faults
def test_controllers_drive_a_group_and_one_of_them_is_killed_or_stopped_and_comes_back(
    harness, control, told
):
    """No message is refused, the others go on, and the silent joint gets its fallback."""
    control.load(ORDER)
    fallback = {"fallback_efforts.elbow": 0.25, "command_timeouts.elbow": 0.3}
    start_merger(harness, **fallback)
    processes = {joint: harness.start_damped(joint, INERTIAS[joint]) for joint in ORDER}
    setpoints = {}
    harness.wait(lambda: control.controller.received, WITHIN, "the first command")
    drive(harness, control, ORDER, setpoints)
    processes["elbow"].process.kill()
    harness.wait(lambda: control.efforts()["elbow"] == 0.25, WITHIN, "the fallback")
    harness.wait(lambda: says(told, "silent: elbow (sent 0.25)"), WITHIN, "its name")
    assert told.newest()["level"] == DiagnosticStatus.ERROR
    count = len(control.controller.received)
    harness.wait(
        lambda: (
            len(control.controller.received) > count + 100
            and are_there(control, ["wrist", "shoulder"])
        ),
        WITHIN,
        "the others",
    )
    processes["elbow"].process.wait()
    del harness.processes.nodes["elbow_controller"]
    processes["elbow"] = harness.start_damped("elbow", INERTIAS["elbow"])
    harness.wait(lambda: not says(told, "silent"), WITHIN, "it to come back")
    drive(harness, control, ["elbow"], setpoints)
    processes["elbow"].process.send_signal(signal.SIGSTOP)
    harness.wait(lambda: control.efforts()["elbow"] == 0.25, WITHIN, "the fallback")
    processes["elbow"].process.send_signal(signal.SIGCONT)
    harness.wait(lambda: not says(told, "silent") and are_there(control), WITHIN, "it to go on")
    assert {len(numbers) for _, numbers in control.controller.received} == {3}
    assert (control.refused, control.controller.is_active) == ([], True)


def test_controllers_of_one_process_are_merged_without_a_topic_between(harness, control, told):
    control.load(ORDER)
    arguments = ros_arguments(
        joints="[elbow, shoulder, wrist]",
        merge=True,
        controller=NAME,
        command_timeout=0.5,
        law="pid",
        gains__p=10.0,
        gains__d=3.0,
        state_timeout=1.0,
        certify=False,
    )
    process = harness.processes.start(
        "joint_controllers", "joint_controllers", arguments, is_renamed=False
    )
    setpoints = {}
    harness.wait(lambda: control.controller.received, WITHIN, "the first command")
    assert harness.node.count_publishers("joint_commands") == 0
    drive(harness, control, ORDER, setpoints)
    assert change(harness, "deactivate", "elbow_controller")
    harness.wait(lambda: says(told, "silent: elbow"), WITHIN, "the joint that was left")
    process.process.send_signal(signal.SIGINT)
    harness.wait(lambda: process.process.poll() is not None, WITHIN, "the end")
    assert process.process.returncode == 0
    received, zeros = control.controller.received, (0.0, 0.0, 0.0)
    harness.wait(lambda: received[-1][1] == zeros, WITHIN, "zeros")
    assert (control.refused, control.controller.is_active) == ([], True)


# --- what is sent, and when ---------------------------------------------------------------


def test_nothing_is_sent_before_every_joint_has_commanded_and_then_all_in_order(bench):
    bench.control.load(ORDER)
    control, two = bench.control.controller, {"wrist": 1.0, "shoulder": 2.0}
    assert change(bench.harness, "deactivate", MERGER)
    assert change(bench.harness, "activate", MERGER)
    line = "waiting for commands of elbow"
    bench.command.until(two, lambda: says(bench.told, line), "the missing joint")
    control.received.clear()
    whole = np.array([1.0, 2.0, 3.0])
    bench.command.until(
        EFFORTS, lambda: control.received and control.received[-1][1] == tuple(whole), "it"
    )
    for _, numbers in control.received:  # faded in
        assert numbers == pytest.approx(numbers[0] * whole)
    assert not bench.control.refused


def test_numbers_that_are_not_finite_are_a_timeout_and_named(merging):
    broken = {**EFFORTS, "elbow": math.nan}
    line = "elbow commands what is not finite"
    merging.command.until(broken, lambda: says(merging.told, line), "its name")
    merging.command.until(broken, lambda: merging.control.efforts()["elbow"] == 0.0, "fallback")
    assert merging.control.controller.dropped == 0
    assert not merging.control.refused


# --- the receiver -------------------------------------------------------------------------


@pytest.mark.parametrize("is_other", [False, True])
def test_a_controller_that_takes_nothing_is_named_and_served_when_it_does(merging, is_other):
    control, command = merging.control, merging.command
    if is_other:
        control.load(ORDER, interface="position")
        line = "commands the position of its joints, not their effort"
    else:
        control.load(ORDER, kind="group")
        control.switch(False)
        line = f"/{NAME} is inactive, and discards what it is sent"
    command.until(EFFORTS, lambda: says(merging.told, line), "the reason")
    assert merging.told.newest()["level"] == DiagnosticStatus.ERROR
    if is_other:
        assert not control.controller.received
        control.load(ORDER)
    else:
        control.switch(True)
    command.until(EFFORTS, lambda: control.efforts() == EFFORTS, "the efforts")


def test_another_controller_of_the_same_name_is_asked_for_its_joints(merging):
    control = merging.control
    for joints in 2 * (["elbow", "wrist"], ["shoulder"], ["elbow", "shoulder", "wrist"]):
        control.load(joints)  # at once: the merger may not have seen that the other one went
        received, expected = control.controller.received, tuple(EFFORTS[each] for each in joints)
        merging.command.until(
            EFFORTS,
            lambda r=received, e=expected: any(numbers == e for _, numbers in list(r)),
            "its command",
        )
        assert {len(numbers) for _, numbers in received} == {len(joints)}
    assert not control.refused


def test_other_senders_of_its_commands_and_refused_requests_are_reported(merging):
    harness, command, told = merging.harness, merging.command, merging.told
    second = harness.processes.start("second", MERGER, ros_arguments(controller=NAME))
    harness.wait(lambda: second.process.poll() is not None, WITHIN, "the refusal")
    assert second.process.returncode == 1
    line = f"all that is sent on /{NAME}/commands is commanded by /{MERGER}"
    assert line in second.log.read_text()
    intruder = harness.node.create_publisher(Float64MultiArray, f"{NAME}/commands", NEWEST_COMMAND)
    line = f"/robot also publishes on /{NAME}/commands"
    command.until(EFFORTS, lambda: says(told, line), "the intruder")
    harness.node.destroy_publisher(intruder)
    for values in ({"command_timeout": 0.2}, {"comand_timeout": 0.2}):
        is_set, reason = harness.set_parameters(MERGER, **values)
        assert (is_set, "command_timeout" in reason) == (False, True)
    assert harness.set_parameters(MERGER, command_timeout=0.5)[0]  # as it is
    assert not change(harness, "configure", MERGER)
    harness.wait(lambda: told.count("refused requests") >= 3, WITHIN, "the count")


def test_a_second_source_of_a_joint_is_not_obeyed_and_both_are_named(merging):
    received = merging.control.controller.received
    rival = Commander(merging.harness, ["elbow"], "/rival")

    def is_named():
        rival({"elbow": 99.0})
        return says(merging.told, "commanded twice: elbow by /elbow_controller and /rival")

    merging.command.until(EFFORTS, is_named, "both of them")
    received.clear()  # what is heard from here on was merged with both of them there
    merging.command.until(EFFORTS, lambda: rival({"elbow": 99.0}) or len(received) > 5, "more")
    # A merger that has stood still takes what waits for it; the rival's command may be the first.
    # Its joints were silent for it meanwhile, and come back from zero.
    merging.process.send_signal(signal.SIGSTOP)
    awake = time.monotonic() + 1.0
    merging.harness.wait(
        lambda: rival({"elbow": 99.0}) or time.monotonic() > awake, what="it to stand still"
    )
    merging.process.send_signal(signal.SIGCONT)
    heard = len(received)
    merging.command.until(
        EFFORTS,
        lambda: (
            rival({"elbow": 99.0}) or (len(received) > heard + 5 and received[-1][1][2] == 3.0)
        ),
        "the same again",
    )
    assert all(0.0 <= numbers[2] <= 3.0 for _, numbers in received)
    # Merging that begins anew, as with another receiver, has not forgotten whom it followed.
    merging.control.load(ORDER)
    received = merging.control.controller.received
    crowd = [{"elbow": 99.0}] * 5
    merging.command.until(
        EFFORTS, lambda: [rival(each) for each in crowd] and len(received) > 5, "the next receiver"
    )
    assert all(0.0 <= numbers[2] <= 3.0 for _, numbers in received)


def dynamic(message):
    """Return names and efforts of a message with interfaces, all of which must be efforts."""
    assert all(list(each.interface_names) == ["effort"] for each in message.interface_values)
    return list(message.joint_names), [each.values[0] for each in message.interface_values]


@pytest.mark.parametrize(
    ("interface", "topic", "read"),
    [
        ("joint_state", "joint_command", lambda each: (list(each.name), list(each.effort))),
        pytest.param(
            "dynamic_joint_state", "dynamic_joint_commands", dynamic, marks=needs_control_msgs
        ),
    ],
)
def test_whoever_subscribes_gets_the_order_that_was_given(harness, told, interface, topic, read):
    start_merger(harness, controller=None, joints=str(ORDER), command_interface=interface)
    waits = f"waiting for somebody to subscribe to /{topic}"
    harness.wait(lambda: says(told, waits), WITHIN, "what it waits for")
    kind = JointState
    if interface == "dynamic_joint_state":
        from control_msgs.msg import DynamicJointState as kind
    command = Commander(harness)
    with listening(harness, kind, topic) as heard:
        whole = ORDER, [1.0, 2.0, 3.0]
        command.until(EFFORTS, lambda: heard and read(heard[-1]) == whole, "its command")
    header = heard[0].header
    assert 0 < header.stamp.sec * 10**9 + header.stamp.nanosec <= command.stamp
    assert interface != "joint_state" or header.frame_id == f"/{MERGER}"
    command.until(EFFORTS, lambda: says(told, waits), "nobody to be missed")


# --- the end ------------------------------------------------------------------------------


class Leaving:
    """What a receiver is sent until its joints are left, with one that keeps the last effort."""

    def __init__(self, control, command, heard):
        self._control, self._command, self._heard = control, command, heard

    def drive(self):
        """Answer states until all have their efforts, also in what is heard."""
        self._command.until(
            EFFORTS,
            lambda: (
                self._control.efforts() == EFFORTS
                and self._heard
                and tuple(self._heard[-1].data) == tuple(EFFORTS.values())
            ),
            "the efforts",
        )

    def end(self):
        """Wait for zeros again and again: nobody acknowledges them."""

        def zeros():
            last = [any(message.data) for message in self._heard[::-1]]
            return last.index(True)  # at the end, in a row

        self._command.until(EFFORTS, lambda: zeros() >= 5, "zeros")
        self.has_effect()

    def has_effect(self):
        self._command.until(
            EFFORTS, lambda: set(self._control.efforts().values()) == {0.0}, "zero efforts"
        )


@pytest.fixture
def leaving(harness, control):
    control.load(ORDER)
    with listening(harness, Float64MultiArray, f"{NAME}/commands") as heard:
        yield Leaving(control, Commander(harness), heard)


@pytest.mark.faults
def test_a_process_that_is_stopped_or_ends_leaves_with_zeros_again_and_again(harness, leaving):
    process = start_merger(harness, fade_in_time=0.0).process
    leaving.drive()
    process.send_signal(signal.SIGTSTP)
    leaving.has_effect()
    harness.wait(lambda: is_stopped(process), WITHIN, "it to stop")  # or SIGCONT is lost
    process.send_signal(signal.SIGCONT)
    leaving.drive()
    process.send_signal(signal.SIGTERM)
    harness.wait(lambda: process.poll() is not None, WITHIN, "the end")
    assert process.returncode == 0
    leaving.end()


def test_a_merger_that_is_deactivated_or_shut_down_leaves_with_zeros(harness, leaving):
    start_merger(harness, autostart=False)
    harness.wait(lambda: harness.is_there(MERGER), WITHIN, "the node")
    assert state(harness, MERGER) == "unconfigured"
    assert change(harness, "configure", MERGER)
    for label, becomes in (("deactivate", "inactive"), ("shutdown", "finalized")):
        assert change(harness, "activate", MERGER)
        leaving.drive()
        assert change(harness, label, MERGER)
        assert state(harness, MERGER) == becomes
        leaving.end()
