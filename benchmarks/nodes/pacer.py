"""The robot's side at a fixed rate: states out, and how long until all efforts have answered.

    python -m benchmarks.nodes.pacer --joints JOINT ... --states N [--merged] [--rate 1000]

Nothing waits for the answers. With ``--merged`` they come in messages for all joints on
``joint_command``, otherwise in one for each joint on ``joint_commands``. One JSON line at the end.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import numpy as np
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from hpid_ros.messages.joint_state import NAMES_OFFSET, STAMP_OFFSET, JointStateTemplate
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.process import schedule

_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=256, reliability=ReliabilityPolicy.BEST_EFFORT
)
_WARM_UP = 500  # states that are not counted
_READINESS_PERIOD = 0.01  # [s]
_READY_WITHIN = 60.0  # [s]
_LAST_ANSWERS = 0.5  # [s] after the last state
_NOT_READY = 1  # exit code
_STAMP = slice(STAMP_OFFSET, NAMES_OFFSET)


class Pacer(executor.ClosingNode):
    """Publishes states at a rate and notes when the last answer to each has come."""

    def __init__(self, joints: list[str], states: int, rate: float, is_merged: bool) -> None:
        super().__init__("pacer")
        self._listeners, self._count = len(joints), states
        self._period = 1.0 / rate
        self._answers = 1 if is_merged else len(joints)  # to a state, at least
        self._template = JointStateTemplate(joints, position=True, velocity=True)
        self._zeros = [0.0] * len(joints)
        self._states = self.create_publisher(JointState, "joint_states", _QOS)
        self._topic = "joint_command" if is_merged else "joint_commands"
        self.create_subscription(JointState, self._topic, self._on_answer, _QOS, raw=True)
        self._stamp_ns = 1_000_000_000
        self._sent_ns: dict[bytes, int] = {}
        self._heard: dict[bytes, tuple[int, int]] = {}  # how many answers, and when the last came
        self._sent = 0
        self._deadline = time.monotonic() + _READY_WITHIN
        self._timer = steady_timer(self, _READINESS_PERIOD, self._start)
        schedule(self)

    def _start(self) -> None:
        listeners = self._states.get_subscription_count()
        if listeners == self._listeners and self.count_publishers(self._topic):
            self.destroy_timer(self._timer)
            self._timer = steady_timer(self, self._period, self._publish)
        elif time.monotonic() > self._deadline:
            print(f"{listeners} of {self._listeners} controllers listen", file=sys.stderr)
            self.request_stop(_NOT_READY)

    def _publish(self) -> None:
        self._stamp_ns += round(self._period * 1e9)
        raw = self._template.encode(self._stamp_ns, position=self._zeros, velocity=self._zeros)
        self._sent += 1
        if self._sent > _WARM_UP:
            self._sent_ns[raw[_STAMP]] = time.perf_counter_ns()
        self._states.publish(raw)
        if self._sent == _WARM_UP + self._count:
            self.destroy_timer(self._timer)
            self._timer = steady_timer(self, _LAST_ANSWERS, self._finish)

    def _on_answer(self, raw: bytes) -> None:
        now_ns = time.perf_counter_ns()
        count, _ = self._heard.get(raw[_STAMP], (0, 0))
        self._heard[raw[_STAMP]] = count + 1, now_ns

    def _finish(self) -> None:
        delays, messages = [], 0
        for stamp, sent_ns in self._sent_ns.items():
            count, last_ns = self._heard.get(stamp, (0, 0))
            messages += count
            if count >= self._answers:
                delays.append((last_ns - sent_ns) * 1e-3)  # [us]
        result = {"answered": len(delays) / self._count, "messages": messages / self._count}
        if delays:
            result["median"], result["p99"] = map(float, np.percentile(delays, [50.0, 99.0]))
        print(json.dumps(result), flush=True)
        self.request_stop()


def main() -> int:
    """Run the node."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--joints", nargs="+", required=True)
    parser.add_argument("--states", type=int, required=True)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--merged", action="store_true")
    parser.add_argument("--realtime-priority", type=int, default=0)
    options = parser.parse_args()
    return executor.run(
        lambda: [Pacer(options.joints, options.states, options.rate, options.merged)],
        args=["pacer", "--ros-args", "-p", f"realtime_priority:={options.realtime_priority}"],
    )


if __name__ == "__main__":
    sys.exit(main())
