"""Sets random parameters on running controllers, valid and invalid, and counts the answers.

Arguments: sets in a second, seed, joints. Ends with SIGTERM and then prints one JSON line.
"""

from __future__ import annotations

import json
import random
import signal
import sys
from types import FrameType
from typing import Any

import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from hpid_ros.base.names import controller_name

_GENTLE = (-0.12, -0.08)  # degrees about that of the run
_TOO_LARGE = 0.7


class Retuner(Node):  # type: ignore[misc]  # rclpy has no types
    """Sets a degree now and then, every fourth time one that must be refused."""

    def __init__(self, rate: float, seed: int, joints: list[str]) -> None:
        super().__init__("retuner")
        self._chance = random.Random(seed)
        self._clients = [
            self.create_client(
                SetParametersAtomically, f"/{controller_name(joint)}/set_parameters_atomically"
            )
            for joint in joints
        ]
        self.counts = {"accepted": 0, "refused": 0, "wrong": 0, "unanswered": 0}
        self._pending: list[tuple[Any, bool]] = []
        self.create_timer(1.0 / rate, self._set_one)

    def _set_one(self) -> None:
        self._take_answers()
        client = self._chance.choice(self._clients)
        if not client.service_is_ready():
            return
        is_valid = self._chance.random() < 0.75
        mu = self._chance.uniform(*_GENTLE) if is_valid else _TOO_LARGE
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=mu)
        request = SetParametersAtomically.Request(parameters=[Parameter(name="mu", value=value)])
        self._pending.append((client.call_async(request), is_valid))

    def _take_answers(self) -> None:
        waiting = []
        for future, is_valid in self._pending:
            if not future.done():
                waiting.append((future, is_valid))
                continue
            successful = future.result().result.successful
            self.counts["accepted" if successful else "refused"] += 1
            self.counts["wrong"] += successful != is_valid
        # A controller that was killed never answers.
        surplus = max(len(waiting) - 1000, 0)
        self.counts["unanswered"] += surplus
        self._pending = waiting[surplus:]


def main() -> None:
    """Set parameters until SIGTERM."""
    rate, seed, joints = float(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Retuner(rate, seed, joints)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        print(json.dumps(node.counts), flush=True)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
