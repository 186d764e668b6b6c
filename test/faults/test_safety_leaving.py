"""How a controller leaves its joint, whatever happens meanwhile: the last command is zero."""

import itertools
import signal
import subprocess
import sys

import pytest
from harness.graph import NAME, TRANSITIONS, change
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

pytestmark = pytest.mark.alone

MS = 1_000_000
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
DAMPING = {"stop": "damping", "stop_duration": 4.0, "state_watchdog": False}


def streaming(harness):
    """Return what tells one more state of a joint that moves away from where it is wanted."""
    stamps = itertools.count(20 * MS, 10 * MS)
    return lambda: harness.publish(next(stamps), -0.5, 1.0)


def in_motion(harness, **options):
    process = harness.start_controller(**options, **GAINS).process
    harness.ask(0, 0.0)
    assert harness.ask(MS, -0.5) > 0.0
    return process, streaming(harness)


def efforts_since(harness, count):
    return [each.effort[0] for each in harness.commands[count:]]


def is_left(harness):
    return harness.commands[-1].effort == (0.0,)


def streamed(harness, stream, condition, what):
    """Go on telling states until a condition holds."""

    def told():
        stream()
        return condition()

    harness.wait(told, what=what)


@pytest.mark.parametrize("labels", [["shutdown"], ["deactivate", "cleanup"], ["SIGTERM"]])
def test_a_damping_stop_ends_with_zero_whatever_asked_for_it(harness, labels):
    process, stream = in_motion(harness, **DAMPING)
    before = len(harness.commands)
    if labels == ["SIGTERM"]:
        process.send_signal(signal.SIGTERM)
    else:
        assert all(change(harness, label) for label in labels)
    streamed(harness, stream, lambda: is_left(harness), "a last command of zero")
    *damping, _ = efforts_since(harness, before)
    if labels == ["SIGTERM"]:  # nobody answers it: the law answers states until it is heeded
        damping = list(itertools.dropwhile(lambda effort: effort > 0.0, damping))
    assert len(damping) >= 5
    assert all(-2.0 <= effort < 0.0 for effort in damping)
    assert damping == sorted(damping)  # it fades
    if labels == ["SIGTERM"]:
        harness.wait(lambda: process.poll() is not None, what="the end")
    assert process.poll() == (0 if labels == ["SIGTERM"] else None)


def test_a_ramp_that_is_cut_short_ends_with_zero(harness):
    in_motion(harness, **DAMPING)
    for labels in (["deactivate", "activate"], ["deactivate", "cleanup", "configure"]):
        harness.ask_newcomer(2 * MS, 0.0)
        assert harness.ask(3 * MS, -0.5) > 0.0
        for label in labels:
            assert change(harness, label)
        harness.wait(lambda: is_left(harness), within=2.0, what="a command of zero")
        harness.commands.clear()


def test_a_damping_stop_without_states_does_not_go_on_with_the_last_effort(harness):
    process, stream = in_motion(harness, **{**DAMPING, "state_watchdog": True}, state_timeout=1.0)
    process.send_signal(signal.SIGTERM)
    streamed(harness, stream, lambda: harness.commands[-1].effort[0] < 0.0, "the damping")
    harness.wait(lambda: is_left(harness), what="a command of zero")
    harness.wait(lambda: process.poll() is not None, what="the end")
    assert process.returncode == 0


def test_no_command_follows_the_last_zero_though_states_go_on(harness):
    _, stream = in_motion(harness, stop="zero")
    client = harness.node.create_client(ChangeState, f"{NAME}/change_state")
    harness.wait(client.service_is_ready, what="the service")
    for _ in range(5):
        before = len(harness.commands)
        streamed(harness, stream, lambda n=before: len(harness.commands) > n + 20, "commands")
        for label in ("deactivate", "activate"):
            number = TRANSITIONS[label]
            request = ChangeState.Request(transition=Transition(id=number))
            begun = len(harness.commands)
            future = client.call_async(request)
            for _ in range(10):
                stream()  # a burst: some are on their way when the joint is left
            streamed(harness, stream, future.done, label)
            assert future.result().success
            if label == "deactivate":
                harness.wait(lambda: is_left(harness), what="a command of zero")
                efforts = efforts_since(harness, begun)
                assert efforts.index(0.0) == len(efforts) - 1


def run(program):
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


TWO_NODES = """
import sys
from hpid_ros.nodes.core import executor

class Told(executor.ClosingNode):
    def __init__(self, name):
        super().__init__(name)
        self.create_timer(0.01, self.request_stop)

    def stop_now(self):
        print("left", self.get_name(), flush=True)
        if self.get_name() == "first":
            raise RuntimeError("the others leave their joints all the same")

    def close(self):
        print("closed", self.get_name(), flush=True)

sys.exit(executor.run(lambda: [Told("first"), Told("second")]))
"""


@pytest.mark.usefixtures("harness")  # for its domain
def test_all_joints_of_a_process_are_left_before_any_node_waits():
    """A subscriber that acknowledges nothing to one of them must not delay the others."""
    ended = run(TWO_NODES)
    assert ended.stdout.split("\n")[:4] == [
        "left first",
        "left second",
        "closed first",
        "closed second",
    ]
    assert ended.returncode == 1


@pytest.mark.usefixtures("harness")  # for its domain
@pytest.mark.parametrize("place", ["executor._make_executor", "executor.rclpy.try_shutdown"])
def test_what_fails_around_the_nodes_is_one_line_and_exit_code_one(place):
    program = (
        "import sys\nfrom hpid_ros.nodes.core import executor\n"
        f"def fail(*_): raise RuntimeError('out of order')\n{place} = fail\n"
        "class Brief(executor.ClosingNode):\n    pass\n"
        "def make():\n    node = Brief('brief')\n"
        "    node.create_timer(0.0, node.request_stop)\n    return [node]\n"
        "sys.exit(executor.run(make))\n"
    )
    ended = run(program)
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert line.startswith("RuntimeError: out of order (")


STANDS_STILL = """
import atexit, ctypes, sys, threading
from hpid_ros.nodes.core import executor, process

class Brief(executor.ClosingNode):
    def close(self):
        print("closed")

    def destroy_node(self):
        {destroying}

def make():
    node = Brief("brief")
    node.create_timer(0.0, lambda: node.request_stop({code}))
    return [node]

process._TORN_DOWN_WITHIN = {within}
libc = ctypes.CDLL(None)
libc.on_exit(libc.pause, None)
atexit.register(threading.Event().wait)
sys.exit(executor.run(make))
"""


@pytest.mark.parametrize(
    ("destroying", "within", "code", "said"),
    [
        ("super().destroy_node()", 60.0, 0, ""),
        ("ctypes.PyDLL(None).pause()", 0.2, 0, "Timeout ("),  # with Python's lock
        ("ctypes.PyDLL(None).pause()", 0.2, 3, "Timeout ("),
    ],
)
@pytest.mark.usefixtures("harness")  # for its domain
def test_a_closed_process_ends_whatever_would_stand_still(destroying, within, code, said):
    """What Python and a library do at their ends does not count; the middleware has some time."""
    ended = run(STANDS_STILL.format(destroying=destroying, within=within, code=code))
    assert ended.returncode == code
    assert said in ended.stderr
    assert ended.stdout == "closed\n"


NEVER_ENDS = """
import os, signal, sys, threading
from hpid_ros.nodes.core import executor

class Stuck(executor.ClosingNode):
    def __init__(self):
        super().__init__("stuck")
        self.create_timer(0.0, self.work)

    def work(self):
        os.kill(os.getpid(), signal.SIGTERM)
        {working}

    def close(self):
        {closing}

executor._LEFT_WITHIN, executor._CLOSED_WITHIN = 0.3, 0.6
sys.exit(executor.run(lambda: [Stuck()]))
"""


@pytest.mark.usefixtures("harness")  # for its domain
@pytest.mark.parametrize("place", ["working", "closing"])
def test_a_node_without_efforts_ends_as_well_where_it_does_not_return(place):
    places = {"working": "pass", "closing": "pass", place: "threading.Event().wait()"}
    ended = run(NEVER_ENDS.format(**places))
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert line.startswith("a callback has not returned for 0.6 s at ")
    assert line.endswith(": the process ends without it")


@pytest.mark.usefixtures("harness")  # for its domain
def test_a_node_whose_errors_nobody_reads_ends_as_well_where_it_does_not_return():
    full = "sys.stderr.write(100_000 * 'x')"  # more than a pipe holds
    program = NEVER_ENDS.format(working=full, closing="pass")
    with subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.PIPE) as process:
        try:
            assert process.wait(60) == 1
        finally:
            process.kill()
