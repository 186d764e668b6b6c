"""What is promised while the executor's thread is busy or stuck: fallback, zero, the end."""

import signal
import subprocess
import sys
import time

import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticStatus
from harness.graph import is_stopped, ros_arguments
from rclpy.serialization import serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.base.names import claim_topic
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED
from hpid_ros.nodes.parts.claims import LEASE

pytestmark = pytest.mark.alone

MS = 1_000_000
TIMEOUT = 0.1  # [s], the state_timeout here
SLACK = 1.5  # [s] for a machine that has other work, too
PARAMETERS = {
    **{"law": "pid", "gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0},
    **{"joint": "elbow", "state_timeout": TIMEOUT, "fallback_effort": 1.5},
}
ARM = ("elbow", "b", "c", "d", "e", "f")


def trajectory(position, joints=("elbow",), points=1):
    """Return the bytes of a trajectory whose points differ in their arrays, if there are more."""
    message = JointTrajectory(joint_names=list(joints))
    row, rest = [position] * len(joints), [0.0] * len(joints)
    message.points = [
        JointTrajectoryPoint(positions=row, velocities=rest, time_from_start=Duration(sec=k + 1))
        for k in range(points)
    ]
    for point in message.points[1::2]:
        point.velocities = []
    return bytes(serialize_message(message))


class Robot:
    """States of a joint that is not where it is held, and when which effort came."""

    def __init__(self, harness):
        self._harness = harness
        self._stamp_ns = MS
        self._seen = 0
        self.answered_at = self.fell_back_at = self.left_at = 0.0
        harness.wait(lambda: harness.states.get_subscription_count() > 0, what="it to listen")
        harness.ask(0, 0.0)

    def tell(self):
        """Tell one state."""
        self._stamp_ns += MS
        self._harness.publish(self._stamp_ns, -0.5)

    def hear(self):
        """Note when the last commands came: answers, fallbacks and zeros."""
        now = time.monotonic()
        for each in self._harness.commands[self._seen :]:
            if each.effort == (0.0,):
                self.left_at = now
            elif each.stamp_ns % MS:
                self.fell_back_at = now
            else:
                self.answered_at = now
        self._seen = len(self._harness.commands)

    def wait(self, condition, what, *, tells=True):
        """Go on telling states, or not, until a condition holds."""

        def holds():
            if tells:
                self.tell()
            self.hear()
            return condition()

        self._harness.wait(holds, what=what)


STUCK = """
import sys, time
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.joint_controller import JointController

class Stuck(JointController):
    def _follow(self, motion, is_latched):
        end = time.monotonic() + motion.knots[0].position
        while time.monotonic() < end:
            {waits}
        self._commands.send(self._loop.state.stamp_ns, 33.0, self._commands.cuts)

sys.exit(executor.run(lambda: [Stuck()]))
"""


@pytest.mark.parametrize(
    ("waits", "seconds", "code"), [("time.sleep(60.0)", 60.0, 1), ("pass", 3.0, 0)]
)
def test_no_callback_delays_fallback_zero_and_end(harness, faults, waits, seconds, code):
    """One blocks in the system and never returns, one computes in Python and then commands.

    Whoever gives efforts meanwhile holds its joint: for another host its claim does not end.
    """
    claims = []
    harness.node.create_subscription(
        DiagnosticStatus,
        claim_topic("/joint_commands", "elbow"),
        lambda message: claims.append((time.monotonic(), message.message)),
        LATCHED,
    )
    command = [sys.executable, "-c", STUCK.format(waits=waits), "--ros-args"]
    command += ros_arguments(**PARAMETERS)
    reference = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            robot = Robot(harness)
            robot.wait(lambda: robot.answered_at > 0.0, "an answer")
            reference.publish(trajectory(seconds))
            robot.wait(lambda: robot.fell_back_at > robot.answered_at, "the fallback effort")
            assert robot.fell_back_at - robot.answered_at < 1.25 * TIMEOUT + SLACK
            if code:
                stuck_at = time.monotonic()
                # A claim that is silent for a lease is told no more.
                robot.wait(
                    lambda: any(at > stuck_at + 2.0 * LEASE and s == "held" for at, s in claims),
                    "its claim after two leases",
                )
                process.send_signal(signal.SIGTSTP)
                robot.wait(lambda: is_stopped(process), "it to be stopped")
                robot.wait(lambda: robot.left_at > robot.fell_back_at, "a zero")
                process.send_signal(signal.SIGCONT)
                robot.wait(lambda: robot.fell_back_at > robot.left_at, "the fallback effort")
            asked_at = time.monotonic()
            process.send_signal(signal.SIGTERM)
            robot.wait(lambda: robot.left_at > asked_at, "a zero")
            assert robot.left_at - asked_at < 0.25 + SLACK
            robot.wait(lambda: process.poll() is not None, "the end")
            assert time.monotonic() - asked_at < 4.75 + 2.0 * SLACK
            robot.hear()
            assert harness.commands[-1].effort == (0.0,)
            assert (33.0,) not in [each.effort for each in harness.commands]
            assert process.returncode == code
            said = process.stderr.read()
            assert ("a callback has not returned" in said) == bool(code)
        finally:
            process.kill()
    faults.count("callbacks that do not return")


def test_a_flood_of_trajectories_delays_neither_fallback_nor_zero(harness, faults):
    process = harness.start_controller(**PARAMETERS).process
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", OFFERED)
    harness.wait(lambda: publisher.get_subscription_count() > 0, what="the match")
    robot = Robot(harness)
    flood = [trajectory(position, ARM, points=4999) for position in (0.1, 0.2)]

    def pour():
        robot.wait(lambda: robot.answered_at > robot.fell_back_at, "answers")
        for k in range(40):
            publisher.publish(flood[k % 2])
            robot.tell()
        return time.monotonic()

    silent_at = pour()
    robot.wait(lambda: robot.fell_back_at > silent_at, "the fallback effort", tells=False)
    assert robot.fell_back_at - max(robot.answered_at, silent_at) < 1.25 * TIMEOUT + SLACK
    asked_at = pour()
    process.send_signal(signal.SIGTERM)
    robot.wait(lambda: robot.left_at > asked_at, "a zero")
    assert robot.left_at - asked_at < 0.25 + SLACK
    robot.wait(lambda: process.poll() is not None, "the end")
    assert time.monotonic() - asked_at < 2.0
    assert process.returncode == 0
    robot.hear()
    assert harness.commands[-1].effort == (0.0,)
    faults.count("trajectories of 4999 points in a flood", 80)
