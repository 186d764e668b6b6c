"""A controller in a process of its own: how it begins, is left without states, and ends."""

import fcntl
import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
from contextlib import contextmanager
from termios import FIONREAD

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from harness.graph import NAME, Told, change, is_stopped, ros_arguments, state
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.nodes.core.middleware import RARE

MS = 1_000_000
GAINS = {"gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
CLOCK = {"state_clock": "simulated", "state_watchdog": False}


def listens(harness):
    return harness.states.get_subscription_count() > 0


def test_activation_holds_the_joint_where_it_is_whatever_was_before(harness):
    harness.start_controller(law="pid", **GAINS)
    assert state(harness) == "active"
    harness.ask(0, 0.0)
    for k in range(1, 30):
        effort = harness.ask(k * MS, -1.0)
    assert effort > 10.0  # the integral is in it
    assert change(harness, "deactivate")
    harness.wait(lambda: harness.commands[-1].effort == (0.0,), what="a last command of zero")
    assert state(harness) == "inactive"
    answered = len(harness.commands)
    setpoint = harness.node.create_publisher(Float64, f"{NAME}/setpoint", RARE)
    told = Told(harness)

    def refuses():  # again and again: what is sent before both ends are matched is lost
        setpoint.publish(Float64(data=3.0))
        return told.count("refused references") > 0

    harness.wait(refuses, what="the refusal to be told")  # nor will it move the joint later
    assert told.says(lifecycle="inactive")
    harness.publish(40 * MS, -1.0)
    assert change(harness, "activate")
    harness.wait(lambda: listens(harness), what="it to listen again")
    assert len(harness.commands) == answered  # it was silent
    assert harness.ask(50 * MS, -0.7) == 0.0
    assert harness.ask(51 * MS, -0.6) == pytest.approx(10.0 * -0.1)


def test_every_transition_can_be_asked_for_and_a_wrong_one_is_refused(harness, faults):
    arguments = ros_arguments(joint="elbow", law="pid", autostart=False, **CLOCK, **GAINS)
    process = harness.processes.start(NAME, "joint_controller", arguments).process
    told = Told(harness)
    assert state(harness) == "unconfigured"
    assert change(harness, "configure")
    assert not listens(harness)
    assert change(harness, "activate")
    for label in ("activate", "configure", "cleanup", "nonsense"):
        assert not change(harness, label)
    assert state(harness) == "active"
    harness.wait(lambda: listens(harness), what="it to listen")
    assert harness.ask_newcomer(0, 0.5) == 0.0
    for label, becomes in (
        ("deactivate", "inactive"),
        ("cleanup", "unconfigured"),
        ("configure", "inactive"),
        ("activate", "active"),
    ):
        assert change(harness, label)
        assert state(harness) == becomes
    harness.wait(lambda: listens(harness), what="it to listen again")
    harness.ask(10 * MS, 0.3)
    assert harness.ask(11 * MS, 0.2) > 0.0
    assert change(harness, "shutdown")
    harness.wait(lambda: harness.commands[-1].effort == (0.0,), what="a last command of zero")
    assert state(harness) == "finalized"
    assert not harness.set_parameters(NAME, mu=0.7)[0]
    harness.wait(lambda: told.count("refused requests") >= 5, what="the refusals to be told")
    assert process.poll() is None
    faults.count("lifecycle transitions refused", 4)


SETPOINT = Float64(data=1.0)
TRAJECTORY = JointTrajectory(joint_names=["elbow"], points=[JointTrajectoryPoint(positions=[1.0])])
BROKEN = """
import sys; from hpid_ros.base import errors
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.joint_controller import JointController

class Broken(JointController):
    asked = 0

    def {method}(self, *arguments):
        self.asked += 1
        if self.asked {when}:
            raise {error}
        return super().{method}(*arguments)

sys.exit(executor.run(lambda: [Broken()]))
"""


@contextmanager
def broken(harness, method, error, when="> 0"):
    """Start a controller one method of which raises."""
    program = BROKEN.format(method=method, error=error, when=when)
    command = [sys.executable, "-c", program, "--ros-args"]
    arguments = ros_arguments(joint="elbow", law="pid", state_clock="simulated", **GAINS)
    with subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True) as process:
        try:
            harness.wait(lambda: listens(harness), what="the node")
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("reference", "error", "line"),
    [
        (TRAJECTORY, "ZeroDivisionError('by nothing')", "ZeroDivisionError: by nothing"),
        (TRAJECTORY, "MemoryError()", "MemoryError"),
        (SETPOINT, "errors.SettingError('no good')", "no good"),
        (SETPOINT, "RecursionError('deep')", "RecursionError: deep"),
    ],
)
def test_a_message_that_meets_an_error_is_refused_and_the_joint_goes_on(
    harness, faults, reference, error, line
):
    with broken(harness, "_follow", error) as process:
        told = Told(harness, "joint_controller")
        assert harness.ask(0, 0.0) == 0.0
        effort = harness.ask(MS, -0.5)
        is_setpoint = isinstance(reference, Float64)
        topic = "joint_controller/setpoint" if is_setpoint else "joint_trajectory"
        publisher = harness.node.create_publisher(type(reference), topic, RARE)

        def is_refused():
            publisher.publish(reference)
            return told.newest().get("last fault", "").endswith(f"refused: {line}")

        harness.wait(is_refused, what="the refusal")
        assert told.count("failed messages") > 0
        assert harness.ask(2 * MS, -0.5) == pytest.approx(effort, rel=0.5) != 0.0
        assert process.poll() is None
    faults.count("exceptions in callbacks")


def test_a_state_that_meets_an_error_is_answered_with_the_fallback(harness, faults):
    with broken(harness, "_is_left", "ZeroDivisionError()", "== 5") as process:
        harness.ask(0, 0.0)
        assert harness.ask(MS, -0.5) != 0.0  # two calls each
        harness.publish(2 * MS, -0.5)
        harness.wait(lambda: harness.commands[-1].stamp_ns == MS + 1, what="the fallback")
        assert harness.commands[-1].effort == (0.0,)
        assert harness.ask(3 * MS, -0.5) != 0.0
        assert process.poll() is None
    faults.count("exceptions in callbacks")


def test_an_exception_of_a_timer_leaves_the_joint_without_effort(harness, faults):
    with broken(harness, "_report", "ZeroDivisionError('by nothing')", "> 1") as process:
        harness.ask(0, 0.0)
        assert harness.ask(MS, -0.5) != 0.0
        harness.wait(lambda: process.poll() is not None, what="it to end")
        harness.wait(lambda: harness.commands[-1].effort == (0.0,), what="a zero effort")
        assert process.returncode == 1
        assert "by nothing (<string>:" in process.stderr.read()
    faults.count("exceptions in callbacks")


def test_silence_gets_the_fallback_effort_is_told_and_ends_in_a_takeover(harness, faults):
    """Also where ROS time stands still, simulated or as a system clock that was set back."""
    options = {"state_timeout": 0.2, "fallback_effort": 1.5, "use_sim_time": True}
    harness.start_controller(law="pid", **options, **GAINS)
    told = Told(harness)
    harness.wait(told.newest, what="a first report")
    harness.ask(0, 0.0)
    assert harness.ask(MS, -0.5) > 3.0
    harness.wait(
        lambda: harness.commands[-1].stamp_ns == MS + 1, within=5.0, what="the fallback effort"
    )
    assert harness.commands[-1].effort == (1.5,)
    harness.wait(lambda: told.count("silences") > 0, what="the silence to be told")
    assert told.newest()["level"] == DiagnosticStatus.ERROR
    assert re.fullmatch(
        r"no new state for [0-9.]+ s: the effort is 1.5 N m", told.newest()["last fault"]
    )
    assert told.newest()["message"] == "no new state within state_timeout"
    assert harness.ask(900 * MS, -0.9) == 1.5  # from where it is, with what is in force
    assert harness.ask(901 * MS, -0.9) == pytest.approx(1.5)
    harness.wait(lambda: told.count("takeovers") > 0, what="the takeover to be told")
    faults.count("silences of the states")


def test_a_driver_that_repeats_its_last_state_is_silent(harness, faults):
    options = {"state_timeout": 0.2, "fallback_effort": 1.5, "state_clock": "wall"}
    harness.start_controller(law="pid", **options, **GAINS)
    told = Told(harness)
    harness.ask(0, 0.0)
    effort = harness.ask(MS, -0.5)
    assert effort > 3.0 or effort in (1.5, 0.0)  # where the machine stood still for the timeout

    def silent():
        harness.publish(MS, -0.5)
        return told.says(
            message="no new state within state_timeout; "
            "the stamps of joint_states stand still at 0.001 s"
        )

    harness.wait(silent, within=5.0, what="the silence to be told")
    assert told.newest()["level"] == DiagnosticStatus.ERROR

    def is_fallback_alone():
        harness.publish(MS, -0.5)
        return {each.effort[0] for each in harness.commands[-20:]} == {1.5}

    harness.wait(is_fallback_alone, what="the fallback effort and no other")
    faults.count("silences of the states")


@pytest.mark.parametrize("stop", [signal.SIGSTOP, signal.SIGTSTP])
def test_states_that_waited_while_it_was_stopped_do_not_move_the_effort(harness, faults, stop):
    """They say where the joint was, and all come at once: it falls, and is taken over there.

    Nor is the time in which nobody could read them a timeout, whichever thread is first.
    """
    options = {"state_clock": "wall", "state_timeout": 0.5, "fallback_effort": 5.0}
    process = harness.start_controller(law="pid", **options, **GAINS).process
    position = 0.0

    def publish_for(seconds, speed):
        nonlocal position
        due = time.monotonic()
        for _ in range(round(seconds * 1000)):
            due += 1e-3
            position += 1e-3 * speed
            harness.publish(time.monotonic_ns(), position)
            while time.monotonic() < due:
                harness.executor.spin_once(timeout_sec=max(due - time.monotonic(), 0.0))

    publish_for(0.2, 0.5)
    rested_ns = time.monotonic_ns()

    def is_at_rest():
        publish_for(0.05, 0.0)
        return harness.commands[-1].stamp_ns > rested_ns + 100 * MS

    harness.wait(is_at_rest, what="answers at rest")
    process.send_signal(stop)

    def has_stopped():  # its other threads go on until one takes the signal
        publish_for(0.05, 0.0)
        return is_stopped(process)

    try:
        harness.wait(has_stopped, what="it to stop")
        publish_for(2.0, 4.0)
        publish_for(0.3, 0.0)  # a state that is as new as usual is true: none of them moves
    finally:
        process.send_signal(signal.SIGCONT)
    answered, thawed_ns = len(harness.commands), time.monotonic_ns()
    before = harness.commands[-1].effort[0]  # by now all of them are here

    def is_answered():
        publish_for(0.05, 0.0)
        return sum(each.stamp_ns > thawed_ns for each in harness.commands[answered:]) > 20

    harness.wait(is_answered, what="answers to states from after the freeze")
    efforts = [each.effort[0] for each in harness.commands[answered:]]
    assert min(efforts) > before - 0.5  # what the integral adds within a second at rest
    assert max(efforts) < before + 0.5
    faults.count("controllers frozen")


def test_nothing_impossible_that_comes_ends_the_node(harness, faults):
    """Times of a clock, requests, and bytes that are no reference, which are counted."""
    process = harness.start_controller(law="pid", use_sim_time=True, **GAINS).process
    told = Told(harness)
    clock = harness.node.create_publisher(Clock, "/clock", RARE)
    harness.wait(clock.get_subscription_count, what="its subscription of the clock")
    harness.ask(0, 0.0)
    for k in range(1, 20):
        clock.publish(Clock(clock=Time(sec=-k)))
        assert harness.ask(k * MS, -0.5) > 3.0
    faults.count("impossible times of a clock", 19)

    odd = [Parameter(name="gains.p", value=ParameterValue(type=kind)) for kind in (99, 0, 6, 1)]
    odd += [
        Parameter(name=name, value=ParameterValue(type=3, double_value=1.0))
        for name in ("", "no.such")
    ]
    for each in odd:
        request = SetParameters.Request(parameters=[each])
        (found,) = harness.call(SetParameters, f"{NAME}/set_parameters", request).results
        request = SetParametersAtomically.Request(parameters=[each])
        name = f"{NAME}/set_parameters_atomically"
        whole = harness.call(SetParametersAtomically, name, request).result
        for result in (found, whole):
            assert (result.successful, bool(result.reason)) == (False, True)
    faults.count("impossible parameter requests", 2 * len(odd))

    head = b"\x00\x01\x00\x00"
    garbage = [b"", b"\x00", b"\xff" * 12, head, head + b"\xee" * 5, head + b"\xff" * 8]
    refused = 0
    for topic, kind in ((f"{NAME}/setpoint", Float64), ("joint_trajectory", JointTrajectory)):
        publisher, before = harness.node.create_publisher(kind, topic, RARE), refused

        def refuses(publisher=publisher, before=before):
            nonlocal refused
            for raw in garbage:
                publisher.publish(raw)
            refused = told.count("refused references")
            return refused >= before + len(garbage)

        harness.wait(refuses, what="refusals")
        harness.node.destroy_publisher(publisher)
    faults.count("references of random bytes", refused)
    harness.commands.clear()
    harness.ask(0, 0.0)  # a clock that goes back starts the loop again
    assert harness.ask(MS, -0.5) == pytest.approx(5.0)
    assert process.poll() is None


F_SETPIPE_SZ = 1031
SMALLEST = 4096  # [byte], of a pipe


def test_a_node_does_not_wait_for_a_parent_that_does_not_read(harness, tmp_path, faults):
    """It goes on, and tells its events in the end."""
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
        harness.publish(told * MS, 0.0)
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

    os.set_blocking(recorder.events, True)
    told_in_the_end = tmp_path / "events"  # read by another process: at its end it waits .5 s
    with told_in_the_end.open("wb") as file:
        reader = subprocess.Popen(["cat"], stdin=recorder.events, stdout=file)
    try:
        harness.wait(lambda: told_in_the_end.stat().st_size, what="the reader")
        recorder.process.terminate()
        assert recorder.process.wait(timeout=30.0) == 0
        assert reader.wait(timeout=30.0) == 0
    finally:
        reader.kill()
        reader.wait()
    events = [json.loads(line) for line in told_in_the_end.read_text().splitlines()]
    counts = [each["counts"]["/joint_states"] for each in events if each["event"] == "recorded"]
    assert events[0]["event"] == "recording"
    assert events[-1]["event"] == "closed"
    assert counts == sorted(counts)
    assert 20 < counts[-1] <= events[-1]["counts"]["/joint_states"] <= told
    faults.count("parents that do not read: nodes that went on")
