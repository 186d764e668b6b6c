"""Streams of trajectories to real controllers, in real time, and what these report."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_bench.experiment.processes import NodeGroup, closed_environment, own_domain
from hpid_ros.base.errors import RunError
from hpid_ros.base.names import controller_name
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_trajectory
from hpid_ros.motion.joint_trajectory import Column

_PERIOD = 0.005  # [s] between two states
_WITHIN = 60.0  # [s] for the controllers to be up
_QOS = QoSProfile(depth=1000)
_LOOP = {
    "law": "pid",
    "gains.p": "10.0",
    "gains.d": "3.0",
    "introspection_rate": "-1.0",
    "state_timeout": "1.0",
    "certify": "false",
    "wait_for_command_subscribers": "0",
}


Messages = Iterator[tuple[float, Column, float]]
"""When messages come, what they are and until when they cover the motion; times in [s]."""


class Taking(Protocol):
    """Takes a reference at a time, of what covers the motion until some time."""

    def take(self, time: float, position: float, velocity: float, covered: float) -> None: ...


def on_nodes(
    streams: Sequence[Messages],
    motion: Callable[..., float],
    founds: Sequence[Taking],
    seconds: float,
    origin: float,
) -> None:
    """Send streams to a controller each, all at once, and give what each reports.

    Args:
        streams: What is sent.
        motion: Position [rad] and, with 1 as second argument, velocity [rad/s] at a time in [s].
        founds: What takes the references, one for each stream.
        seconds: How long.
        origin: The states' clock at the beginning in [s].

    Raises:
        RunError: If the controllers do not come up.
    """
    joints = [f"joint{number}" for number in range(len(streams))]
    with (
        tempfile.TemporaryDirectory(prefix="hpid_bench_") as folder,
        own_domain() as domain,
        NodeGroup(closed_environment(domain), Path(folder)) as nodes,
    ):
        os.environ.update(closed_environment(domain))  # before the middleware is loaded
        given = [word for name, value in _LOOP.items() for word in ("-p", f"{name}:={value}")]
        controllers = nodes.start(
            "joint_controllers",
            "joint_controllers",
            [*given, "-p", f"joints:=[{', '.join(joints)}]"],
            is_renamed=False,
        )
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        robot = _Robot(joints, motion, founds, origin)
        try:
            robot.wait(lambda: controllers.process.poll() is not None, controllers.last_words)
            robot.run(streams, seconds)
        finally:
            robot.close()
            rclpy.shutdown()


class _Robot:
    """Publishes states of joints that are where their motions are, and trajectories."""

    def __init__(
        self,
        joints: Sequence[str],
        motion: Callable[..., float],
        founds: Sequence[Taking],
        origin: float,
    ) -> None:
        self._joints, self._motion, self._origin = joints, motion, origin
        self._covered = [0.0] * len(joints)
        self._node = rclpy.create_node("robot", start_parameter_services=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._states = self._node.create_publisher(JointState, "joint_states", _QOS)
        self._trajectories = self._node.create_publisher(JointTrajectory, "joint_trajectory", _QOS)
        self._template = JointStateTemplate(joints, position=True, velocity=True)
        self._heard = set[int]()
        self._subscriptions = [
            self._node.create_subscription(
                JointState,
                f"{controller_name(joint)}/reference",
                self._listener(number, founds[number]),
                _QOS,
            )
            for number, joint in enumerate(joints)
        ]

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()

    def _listener(self, number: int, found: Taking) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            self._heard.add(number)
            stamp = message.header.stamp
            at = stamp.sec - self._origin + stamp.nanosec / NANOSECONDS
            if at >= 0.0:
                found.take(at, message.position[0], message.velocity[0], self._covered[number])

        return take

    def wait(self, has_ended: Callable[[], bool], last_words: Callable[[], str]) -> None:
        """Publish states from before the beginning until every controller reports."""
        deadline, at = time.monotonic() + _WITHIN, 1.0 - self._origin
        while len(self._heard) < len(self._joints):
            if has_ended() or time.monotonic() > deadline:
                raise RunError(f"the controllers do not come up: {last_words()}")
            at += 1e-4
            self._publish(at, self._motion(0.0), 0.0)
            self._spin(time.monotonic() + _PERIOD)

    def run(self, streams: Sequence[Messages], seconds: float) -> None:
        """Send all that is due at each state."""
        coming = [next(stream, None) for stream in streams]
        begun = time.monotonic()
        for k in range(int(seconds / _PERIOD)):
            self._spin(begun + k * _PERIOD)
            at = time.monotonic() - begun
            for number, stream in enumerate(streams):
                newest = coming[number]
                while newest is not None and newest[0] <= at:
                    self._send(number, newest[1])
                    self._covered[number], newest = newest[2], next(stream, None)
                coming[number] = newest
            self._publish(at, self._motion(at), self._motion(at, 1))
        self._spin(time.monotonic() + 1.0)

    def _publish(self, at: float, position: float, velocity: float) -> None:
        count = len(self._joints)
        stamp_ns = round((self._origin + at) * NANOSECONDS)
        raw = self._template.encode(
            stamp_ns, position=[position] * count, velocity=[velocity] * count
        )
        self._states.publish(raw)

    def _send(self, number: int, column: Column) -> None:
        rows = [[each.position, each.velocity, None, None] for each in column.knots]
        arrays = np.array(rows, dtype=float).T[:, :, None]
        times_ns = np.array([each.time_ns for each in column.knots])
        names = [self._joints[number]]
        raw = encode_trajectory(column.stamp_ns, names, times_ns, list(arrays))
        self._trajectories.publish(raw)

    def _spin(self, until: float) -> None:
        while (left := until - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
