"""What a node logs of what has gone wrong."""

from types import SimpleNamespace

import pytest

from hpid_ros.nodes.core.status import Diagnostics


class Node:
    """A node with a log that leaves out what rclpy's throttle does: all within its duration."""

    def __init__(self):
        self.written = []
        self._is_throttled = False

    def create_publisher(self, *_):
        return SimpleNamespace()

    def get_logger(self):
        return SimpleNamespace(warning=self._write, error=self._write)

    def _write(self, line, throttle_duration_sec=0.0):
        if throttle_duration_sec and self._is_throttled:
            return
        self._is_throttled = self._is_throttled or bool(throttle_duration_sec)
        self.written.append(line)


@pytest.mark.parametrize("severity", ["warn", "error"])
def test_a_change_for_the_worse_is_logged_whatever_was_logged_just_before(severity):
    node = Node()
    diagnostics = Diagnostics(node, "elbow")
    for number in range(1000):
        diagnostics.fault(f"state {number} refused")
    getattr(diagnostics, severity)("no new state for 0.1 s: the effort is 0 N m")
    assert node.written == ["state 0 refused", "no new state for 0.1 s: the effort is 0 N m"]
    assert diagnostics.last_fault == node.written[-1]
