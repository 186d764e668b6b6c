"""Every signal that can be caught: zero effort first, and then what the signal asks for."""

import resource
import signal
import time

import pytest
from harness.graph import is_stopped, ros_arguments

from hpid_ros.messages.joint_state import JointStateTemplate

MS = 1_000_000
GAINS = {"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
GAINS["state_watchdog"] = False  # the test is slow at times

ENDS = {
    signal.SIGINT: 0,
    signal.SIGTERM: 0,
    signal.SIGHUP: 0,
    signal.SIGQUIT: -signal.SIGQUIT,
    signal.SIGUSR1: -signal.SIGUSR1,
    signal.SIGALRM: -signal.SIGALRM,
    signal.SIGXCPU: -signal.SIGXCPU,
    signal.SIGRTMIN: -signal.SIGRTMIN,
}
STOPS = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
STAYS = (signal.SIGPIPE, signal.SIGXFSZ, signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH)


@pytest.fixture
def as_from_a_terminal():
    """Let children heed SIGHUP and SIGQUIT though this process may not, and leave no core file."""
    before = {n: signal.signal(n, signal.SIG_DFL) for n in (signal.SIGHUP, signal.SIGQUIT)}
    limits = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_CORE, limits)
    for number, handler in before.items():
        signal.signal(number, handler)


class Arm:
    """Joints that are away from where they are held, so that each gets an effort."""

    def __init__(self, harness, joints):
        self._harness, self._joints = harness, joints
        self._template = JointStateTemplate(joints, position=True, velocity=True)
        self._stamp_ns = 0
        self._heard = -1
        self._position = -0.5
        self._tell(0.0)

        def answered():
            self._go_on()
            return all(self.efforts(joint) for joint in joints)

        harness.wait(answered, what="the first answers")

    def _go_on(self):
        """Tell the next state when nobody answers the last one any more."""
        heard, self._heard = self._heard, len(self._harness.commands)
        if heard == self._heard:
            self._stamp_ns += MS
            self._position -= 0.01  # wherever a joint is held, it is soon away from there
            self._tell(self._position)

    def _tell(self, position):
        n = len(self._joints)
        raw = self._template.encode(self._stamp_ns, position=[position] * n, velocity=[0.0] * n)
        self._harness.states.publish(raw)

    def efforts(self, joint):
        """Return all efforts that a joint has got."""
        return [each.effort[0] for each in self._harness.commands if each.names == (joint,)]

    def move(self, joints):
        """Tell states until these joints have an effort that holds them."""

        def driven():
            self._go_on()
            return all(self.efforts(joint)[-1] > 1.0 for joint in joints)

        self._harness.wait(driven, what=f"efforts of {', '.join(joints)}")

    def are_left(self, joints):
        """Go on telling states, and tell whether the last commands of joints are zero."""
        self._go_on()
        return all(self.efforts(joint)[-1] == 0.0 for joint in joints)


@pytest.mark.usefixtures("as_from_a_terminal")
def test_each_signal_that_can_be_caught_gives_zero_first(harness, faults):
    """Those that stop a process are sent to one of two joints: both are left."""
    joints = {f"joint_{number:d}": number for number in ENDS}
    nodes = {joint: harness.start_controller(joint, joint, **GAINS) for joint in joints}
    nodes["undisturbed"] = harness.start_controller("undisturbed", "undisturbed", **GAINS)
    pair = ["elbow", "wrist"]
    both = harness.processes.start(
        "pair",
        "joint_controllers",
        ros_arguments(joints="[elbow, wrist]", **GAINS),
        is_renamed=False,
    ).process
    ending, all_joints = list(joints), [*nodes, *pair]
    count = harness.states.get_subscription_count
    harness.wait(lambda: count() == len(all_joints), within=60.0, what="all to listen")
    arm = Arm(harness, all_joints)

    arm.move(all_joints)
    for number in STAYS:
        nodes["undisturbed"].process.send_signal(number)
    for number in STOPS:
        arm.move(pair)
        both.send_signal(number)
        harness.wait(lambda: is_stopped(both), what=f"{number!r} to stop it")
        harness.wait(lambda: arm.are_left(pair), what=f"zeros at {number!r}")
        stood = [len(arm.efforts(joint)) for joint in pair]
        arm.move(["undisturbed"])  # states go on
        assert [len(arm.efforts(joint)) for joint in pair] == stood
        both.send_signal(signal.SIGCONT)
    arm.move(all_joints)

    for joint in ending:
        nodes[joint].process.send_signal(joints[joint])
    for joint in ending:
        process = nodes[joint].process
        harness.wait(
            lambda: arm.are_left([joint]) and process.poll() is not None,  # noqa: B023
            what=f"the end of {joint}",
        )
        assert process.returncode == ENDS[joints[joint]], joint
    answered = {joint: len(arm.efforts(joint)) for joint in ending}
    arm.move(["undisturbed", *pair])
    assert {joint: len(arm.efforts(joint)) for joint in ending} == answered
    both.send_signal(signal.SIGQUIT)
    harness.wait(lambda: both.poll() is not None, what="the end of both")
    harness.wait(lambda: arm.are_left(pair), what="two zeros")
    assert both.returncode == -signal.SIGQUIT
    assert nodes["undisturbed"].process.poll() is None
    assert 0.0 not in arm.efforts("undisturbed")[2:]
    faults.count("signals: zero first", len(ENDS) + len(STOPS))


@pytest.mark.usefixtures("as_from_a_terminal")
def test_a_joint_whose_states_stood_still_with_it_gets_no_fallback_when_it_goes_on(harness):
    """As where a shell stops the robot's simulation and its controllers together."""
    parameters = {**GAINS, "state_watchdog": True, "state_timeout": 1.0, "fallback_effort": 3.0}
    node = harness.start_controller("elbow", "elbow", **parameters)
    harness.wait(lambda: harness.states.get_subscription_count() == 1, what="it to listen")
    arm = Arm(harness, ["elbow"])
    arm.move(["elbow"])
    node.process.send_signal(signal.SIGTSTP)
    harness.wait(lambda: is_stopped(node.process), what="it to stop")
    harness.wait(lambda: arm.are_left(["elbow"]), what="a zero")
    goes_on_at = time.monotonic() + 1.2
    harness.wait(lambda: time.monotonic() > goes_on_at, what="a silence that is a timeout")
    stood = len(arm.efforts("elbow"))
    arm.are_left(["elbow"])  # a state
    node.process.send_signal(signal.SIGCONT)
    arm.move(["elbow"])
    assert 3.0 not in arm.efforts("elbow")[stood:]
