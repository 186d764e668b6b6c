"""How long two nodes of this machine take to find each other, with the settings of the user."""

from __future__ import annotations

import math
import os
import tempfile
import time
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from hpid_bench.experiment.processes import NodeGroup, NodeProcess
from hpid_ros.base.errors import RunError
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import OFFERED, destroy_when_quiet, load_profile

_STARTS_WITHIN, _GIVEN_UP_AFTER = 60.0, 5.0  # [s]
_ASK_PERIOD = 0.02  # [s]


def time_to_answer() -> float:
    """Return how long after its start a node is answered by a controller that runs, in [s]."""
    load_profile()
    place = f"/hpid_doctor_{os.getpid()}"
    states = JointStateTemplate(["doctor"], position=True, velocity=True)
    answers: list[bytes] = []
    with tempfile.TemporaryDirectory() as folder, NodeGroup(os.environ, Path(folder)) as group:
        arguments = ["-r", f"__ns:={place}", "-p", "joint:=doctor"]
        arguments += ["-p", "wait_for_command_subscribers:=0"]
        controller = group.start("controller", "joint_controller", arguments)
        _wait_until_listening(controller)
        begun = time.monotonic()
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("doctor", namespace=place, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        publisher = node.create_publisher(JointState, "joint_states", OFFERED)
        node.create_subscription(JointState, "joint_commands", answers.append, OFFERED, raw=True)
        while not answers and time.monotonic() < begun + _GIVEN_UP_AFTER:
            raise_if_interrupted()
            publisher.publish(states.encode(time.time_ns(), position=[0.0], velocity=[0.0]))
            executor.spin_once(timeout_sec=_ASK_PERIOD)
        took = time.monotonic() - begun
        executor.shutdown()
        destroy_when_quiet(node)
        rclpy.shutdown(context=context)
        return took if answers else math.inf


def _wait_until_listening(controller: NodeProcess) -> None:
    deadline = time.monotonic() + _STARTS_WITHIN
    while not any(each["event"] == "listening" for each in controller.read_events()):
        raise_if_interrupted()
        if controller.process.poll() is not None or time.monotonic() > deadline:
            raise RunError(f"a controller does not start: {controller.last_words()}")
        time.sleep(_ASK_PERIOD)
