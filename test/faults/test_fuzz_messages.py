"""Fuzzed messages and goals at each node: it lives, its memory stays, and it does what it did.

``HPID_FUZZ_MESSAGES=100000`` sends as many at each; the figures stand at the end of the session.
"""

import os
from contextlib import suppress

import numpy as np
import pytest
from harness.fuzzing import GoalFuzzer, StateFuzzer, TrajectoryFuzzer
from harness.goals import SUCCEEDED, Client, Joints, goal_of, needs_control_msgs
from harness.graph import Told, ros_arguments
from harness.poison import memory_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import OFFERED, RARE

MS = 1_000_000
MESSAGES = int(os.environ.get("HPID_FUZZ_MESSAGES", "1500"))
WARMED = MESSAGES // 5  # after so many a process has what it needs
BURST = 50
GOALS_AT_ONCE = 8  # of the ten that a service keeps
GROWS = 40.0  # [MiB] that the rest may add: a large message, and what allocators keep of it
WITHIN = 120.0 + MESSAGES / 20  # [s]
pytestmark = pytest.mark.timeout(2 * WITHIN)


class Watched:
    """The memory of a process while it is fuzzed."""

    def __init__(self, process, name, faults):
        self._process, self._name, self._faults = process, name, faults
        self.before = 0.0
        self._sent = 0

    def sent(self, count):
        """Note that so many more messages have been sent, and that the process lives."""
        assert self._process.poll() is None
        self._sent += count
        if not self.before and self._sent >= WARMED:
            self.before = memory_of(self._process.pid, "VmRSS")

    def end(self):
        """Require that the memory has stayed, and count what was sent."""
        assert self._process.poll() is None
        after = memory_of(self._process.pid, "VmRSS")
        count = self._faults.count
        count(f"messages fuzzed: {self._name}", self._sent)
        count(f"memory [MiB]: {self._name}, after a fifth", self.before)
        count(f"memory [MiB]: {self._name}, at the end", after)
        assert after < self.before + GROWS


def bursts(messages, count=BURST):
    """Yield messages in lists of so many."""
    burst = []
    for each in messages:
        burst.append(each)
        if len(burst) == count:
            yield burst
            burst = []
    if burst:
        yield burst


def test_a_controller_under_fuzzed_references(harness, faults):
    """At rest all that moves its effort are the references, by no more than its rate allows."""
    limits = {"u_clamp_max": 20.0, "u_clamp_min": -20.0, "position_max": 2.0, "position_min": -2.0}
    started = harness.start_controller(
        law="pid", gains__p=10.0, gains__i=0.0, gains__d=1.0, effort_rate_max=1000.0, **limits
    )
    watched = Watched(started.process, "controller", faults)
    references = TrajectoryFuzzer(["elbow"], seed=4)
    topic = harness.node.create_publisher(JointTrajectory, "joint_trajectory", RARE)
    harness.wait(topic.get_subscription_count, what="the controller")
    harness.ask(0, 0.0)
    stamp_ns, efforts = 0, [0.0]
    for burst in bursts(references.messages(MESSAGES)):
        for raw in burst:
            topic.publish(raw)
        harness.commands.clear()
        for _ in range(5):
            stamp_ns += MS
            efforts.append(harness.ask(stamp_ns, 0.0))
        references.now_ns = stamp_ns
        watched.sent(len(burst))
    found = np.array(efforts)
    assert np.all(np.abs(found) <= 20.0)
    steps = np.abs(np.diff(found))
    assert steps.max() <= 1.0 + 1e-9  # 1000 N m/s in a millisecond
    faults.count("largest step of effort [mN m]: controller", 1e3 * steps.max())
    watched.end()


@needs_control_msgs
def test_an_action_server_under_fuzzed_goals(harness, faults):
    joints = Joints(harness)
    started = joints.start()
    watched = Watched(started.action.process, "action server", faults)
    client = Client(joints)
    answered = 0
    for burst in bursts(GoalFuzzer(joints.joints, seed=6).goals(MESSAGES), GOALS_AT_ONCE):
        answers = [client.ask(goal) for goal in burst]
        # On a busy machine the middleware may lose one.
        with suppress(AssertionError):
            joints.run(lambda: all(each.done() for each in answers), within=2.0)  # noqa: B023
        answered += sum(each.done() for each in answers)
        watched.sent(len(burst))
    assert answered > 0.95 * MESSAGES
    good = goal_of({"shoulder": [0.05], "elbow": [-0.05]}, [0.5])
    ended = (None,)

    def is_followed():
        nonlocal ended
        ended = client.follow(good) if ended[0] != SUCCEEDED else ended
        return ended[0] == SUCCEEDED

    while not is_followed():  # those that are kept make room after ten seconds
        joints.run_for(0.5)
    watched.end()


def test_a_merger_under_fuzzed_commands(harness, faults):
    arguments = ros_arguments(joints="[elbow]")
    started = harness.processes.start("merger", "joint_command_merger", arguments)
    watched, merged = Watched(started.process, "merger", faults), []
    harness.node.create_subscription(Float64MultiArray, "merger/commands", merged.append, OFFERED)
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    told, stamp_ns = Told(harness, "merger"), 0
    template = JointStateTemplate(["elbow"], "/elbow_controller", effort=True)

    def is_merged():
        nonlocal stamp_ns
        stamp_ns += MS
        commands.publish(template.encode(stamp_ns, effort=[1.0]))
        return bool(merged) and list(merged[-1].data) == [1.0]

    harness.wait(is_merged, what="merged commands")
    for burst in bursts(raw or b"\0" for raw in StateFuzzer("elbow", seed=7).messages(MESSAGES)):
        for raw in burst:
            commands.publish(raw)
        merged.clear()
        harness.wait(is_merged, within=WITHIN, what="merged commands")
        watched.sent(len(burst))
    harness.wait(lambda: told.count("misread commands") > 0, what="refused commands")
    assert all(np.isfinite(message.data).all() for message in merged)
    watched.end()


def test_a_bridge_under_fuzzed_commands(harness, experiment_file, faults):
    world = experiment_file(duration=60.0)
    arguments = ros_arguments(world_file=world, mode="realtime", wait_for_publishers=0)
    started = harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    watched, told = Watched(started.process, "bridge", faults), Told(harness, "mujoco_bridge")
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    harness.wait(lambda: commands.get_subscription_count() and told.newest(), what="the bridge")
    time_key = "simulated time [s]"
    for burst in bursts(raw or b"\0" for raw in StateFuzzer("j1", seed=8).messages(MESSAGES)):
        for raw in burst:
            commands.publish(raw)
        harness.executor.spin_once(timeout_sec=0.01)
        watched.sent(len(burst))
    before = float(told.newest()[time_key])
    harness.wait(lambda: float(told.newest()[time_key]) > before, what="the simulation to go on")
    assert told.count("misread commands") > 0
    watched.end()
