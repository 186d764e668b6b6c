"""The echo graph: the same messages as the closed loop, and nothing but their transport.

    python -m benchmarks.nodes.floor --echo JOINT ...           # only echo nodes
    python -m benchmarks.nodes.floor --ask JOINT ... --cycles N # only the publisher
    python -m benchmarks.nodes.floor --ask JOINT ... --echo JOINT ... --cycles N
    python -m benchmarks.nodes.floor --idle NAME                # a node that does nothing

Everything is raw: states are published and answered from prepared bytes in which only the stamp
changes, best effort both ways. The publisher prints one JSON line when it is done. With
``--physics`` it also steps the simulated robot once a cycle, under efforts recorded before.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from hpid_ros.messages.joint_state import NAMES_OFFSET, STAMP_OFFSET, JointStateTemplate
from hpid_ros.nodes.core import executor

WARM_UP = 100  # cycles that are not counted: every layer has been used, every page touched

_FASTEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=64, reliability=ReliabilityPolicy.BEST_EFFORT
)
_READINESS_PERIOD = 0.01  # [s]
_READY_WITHIN = 30.0  # [s] for the nodes to find each other
_NOT_READY = 1  # exit code
_STUCK_AFTER = 0.25  # [s]; best effort may lose a message while endpoints still find each other
_STAMP = slice(STAMP_OFFSET, NAMES_OFFSET)


class Echo(executor.ClosingNode):
    """Answers every state with one effort.

    It listens when its answers have somebody to hear them.
    """

    def __init__(self, joint: str) -> None:
        super().__init__(f"{joint}_echo")
        self._answer = bytearray(JointStateTemplate([joint], effort=True).encode(0, effort=[0.0]))
        self._answers = self.create_publisher(JointState, "joint_commands", _FASTEST)
        self._readiness = self.create_timer(_READINESS_PERIOD, self._listen)

    def _listen(self) -> None:
        if self._answers.get_subscription_count():
            self._readiness.cancel()
            self.create_subscription(
                JointState, "joint_states", self._on_state, _FASTEST, raw=True
            )

    def _on_state(self, raw: bytes) -> None:
        self._answer[_STAMP] = raw[_STAMP]
        self._answers.publish(bytes(self._answer))


class Asker(executor.ClosingNode):
    """Publishes a state, waits for all answers, publishes the next."""

    def __init__(
        self, joints: Sequence[str], cycles: int, is_timing: bool, work: Callable[[], None] | None
    ) -> None:
        super().__init__("asker")
        self._joints, self._cycles, self._is_timing = joints, cycles, is_timing
        self._work = work
        template = JointStateTemplate(joints, position=True, effort=True)
        zeros = [0.0] * len(joints)
        self._state = bytearray(template.encode(0, position=zeros, effort=zeros))
        self._states = self.create_publisher(JointState, "joint_states", _FASTEST)
        self.create_subscription(JointState, "joint_commands", self._on_answer, _FASTEST, raw=True)
        self._cycle = 0  # of all, the repeated ones included; it is the stamp
        self._counted = -WARM_UP
        self._missing = len(joints)
        self._stamp = b""
        self._repeats = 0
        self._begin_ns = self._asked_ns = 0
        self._latencies_ns: list[int] = []
        self._seen = 0
        self._deadline = time.monotonic() + _READY_WITHIN
        self._readiness = self.create_timer(_READINESS_PERIOD, self._start)

    def _start(self) -> None:
        listeners = self._states.get_subscription_count()
        if listeners == len(self._joints):
            self._readiness.cancel()
            self._ask()
            self._seen = self._cycle
            self.create_timer(_STUCK_AFTER, self._unstick)
        elif time.monotonic() > self._deadline:
            print(f"{listeners} of {len(self._joints)} echo nodes are there", file=sys.stderr)
            self.request_stop(_NOT_READY)

    def _ask(self) -> None:
        self._cycle += 1
        self._missing = len(self._joints)
        self._stamp = self._cycle.to_bytes(NAMES_OFFSET - STAMP_OFFSET, "little")
        self._state[_STAMP] = self._stamp
        self._asked_ns = time.perf_counter_ns()
        self._states.publish(bytes(self._state))

    def _on_answer(self, raw: bytes) -> None:
        if raw[_STAMP] != self._stamp:
            return
        if self._is_timing and self._counted >= 0:
            self._latencies_ns.append(time.perf_counter_ns() - self._asked_ns)
        self._missing -= 1
        if self._missing:
            return
        self._counted += 1
        if self._counted == 0:
            self._begin_ns = time.perf_counter_ns()
        elif self._counted == self._cycles:
            self._finish()
            return
        if self._work is not None:
            self._work()
        self._ask()

    def _unstick(self) -> None:
        """Ask anew, with a stamp of its own, and count from the start, when nothing has moved."""
        if self._seen == self._cycle and self._counted < self._cycles:
            self._repeats += 1
            self._counted = -WARM_UP
            self._latencies_ns.clear()
            self._ask()
        self._seen = self._cycle

    def _finish(self) -> None:
        seconds = (time.perf_counter_ns() - self._begin_ns) * 1e-9
        result = {"cycles": self._cycles, "rate": self._cycles / seconds, "repeats": self._repeats}
        if self._is_timing:
            result["latency"] = statistics.median(self._latencies_ns) * 1e-3  # [us]
        print(json.dumps(result), flush=True)
        self.request_stop()


def physics() -> Callable[[], None]:
    """Return one period of tracking.yaml after the other: step the robot and read it."""
    from benchmarks.engine import recorded_efforts
    from benchmarks.tracking import tracking
    from hpid_ros.simulation.world import World

    experiment = tracking(physics_steps=1, engine="mujoco")
    efforts = recorded_efforts(experiment, experiment.periods)
    world, recorded = World(experiment.world), iter(efforts)

    def advance() -> None:
        nonlocal recorded
        present = next(recorded, None)
        if present is None:  # the motion is over: from the start again
            world.reset()
            recorded = iter(efforts)
            present = next(recorded)
        world.step(present)
        world.read()

    return advance


def main() -> int:
    """Run the nodes that the arguments name, in one process."""
    parser = argparse.ArgumentParser(description="The echo graph")
    parser.add_argument("--ask", nargs="+", default=[], metavar="JOINT")
    parser.add_argument("--echo", nargs="+", default=[], metavar="JOINT")
    parser.add_argument("--idle", metavar="NAME")
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--physics", action="store_true", help="step the robot in each cycle")
    parser.add_argument("--latency", action="store_true", help="note when each answer came")
    options = parser.parse_args()

    def make_nodes() -> list[executor.ClosingNode]:
        nodes: list[executor.ClosingNode] = [Echo(joint) for joint in options.echo]
        if options.idle:
            nodes.append(executor.ClosingNode(options.idle))
            print(json.dumps({"idle": options.idle}), flush=True)
        if options.ask:
            work = physics() if options.physics else None
            nodes.append(Asker(options.ask, options.cycles, options.latency, work))
        return nodes

    return executor.run(make_nodes, args=["floor"])


if __name__ == "__main__":
    sys.exit(main())
