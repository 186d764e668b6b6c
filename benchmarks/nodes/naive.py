"""The closed loop as a first rclpy program would have it: correct, and nothing done for speed.

    python -m benchmarks.nodes.naive --control JOINT        # one PID
    python -m benchmarks.nodes.naive --simulate --seconds S # the simulated robot

SingleThreadedExecutor, message objects, the PID written out in the callback, a Float64 effort on
a topic for each joint. The simulated robot publishes a state, waits for all efforts, steps. It
prints one JSON line when it is done.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from benchmarks.tracking import tracking
from hpid_ros.motion import SplineReference
from hpid_ros.simulation.world import World

LABEL = "PID"

_STUCK_AFTER = 0.25  # [s]
_READINESS_PERIOD = 0.01  # [s]
_QUEUE = 10
_NANOSECONDS = 1_000_000_000


class NaivePid:
    """A PID for one joint."""

    def __init__(self, node: Node, joint: str) -> None:
        experiment = tracking()
        (settings,) = (s for s in experiment.controllers[LABEL] if s.joint == joint)
        self.node, self.joint = node, joint
        self.gains = settings.gains
        self.time_constant = settings.velocity.velocity_filter_time_constant
        self.limit = settings.effort.u_clamp_max
        self.trajectory = experiment.trajectory.column(joint)
        self.reference: SplineReference | None = None
        self.answer = Float64()
        self.integral = self.velocity = 0.0
        self.last_time = self.last_position = 0.0
        self.publisher = node.create_publisher(Float64, f"{joint}/effort", _QUEUE)
        self.readiness = node.create_timer(_READINESS_PERIOD, self.listen)

    def listen(self) -> None:
        """Subscribe to the states when somebody hears the efforts."""
        if self.publisher.get_subscription_count():
            self.readiness.cancel()
            self.node.create_subscription(JointState, "joint_states", self.on_state, _QUEUE)

    def on_state(self, message: JointState) -> None:
        """Answer a state with an effort."""
        now = Time.from_msg(message.header.stamp)
        time_s = now.nanoseconds / _NANOSECONDS
        position = message.position[message.name.index(self.joint)]
        if self.reference is None:
            self.reference = self.trajectory.start(now.nanoseconds, position, 0.0)
            dt = 0.0
        elif time_s == self.last_time:  # asked again
            self.publisher.publish(self.answer)
            return
        else:
            dt = time_s - self.last_time
            difference = (position - self.last_position) / dt
            self.velocity += (difference - self.velocity) * dt / (self.time_constant + dt)
        self.last_time, self.last_position = time_s, position
        wanted = self.reference.sample(now.nanoseconds)
        error = wanted[0] - position
        error_rate = wanted[1] - self.velocity
        effort = self.gains.p * error + self.integral + self.gains.d * error_rate
        limited = max(-self.limit, min(self.limit, effort))
        if limited == effort:
            self.integral += self.gains.i * error * dt
        self.answer = Float64()
        self.answer.data = limited
        self.publisher.publish(self.answer)


class NaiveRobot:
    """The simulated robot: publishes a state, waits for an effort of every joint, steps."""

    def __init__(self, node: Node, world: World, seconds: float) -> None:
        self.node, self.world = node, world
        self.joints = world.settings.joints
        self.end_ns = round(seconds * _NANOSECONDS)
        self.efforts: dict[str, float] = {}
        self.states = self.seen = 0
        self.begin = self.wall_time = 0.0
        self.publisher = node.create_publisher(JointState, "joint_states", _QUEUE)
        for joint in self.joints:
            callback = partial(self.on_effort, joint)
            node.create_subscription(Float64, f"{joint}/effort", callback, _QUEUE)
        self.readiness = node.create_timer(_READINESS_PERIOD, self.start)

    def start(self) -> None:
        """Publish the first state when every controller hears it."""
        if self.publisher.get_subscription_count() == len(self.joints):
            self.readiness.cancel()
            self.begin = time.perf_counter()
            self.publish_state()
            self.node.create_timer(_STUCK_AFTER, self.ask_again)

    def publish_state(self) -> None:
        """Publish where the joints are."""
        message = JointState()
        message.header.stamp = Time(nanoseconds=self.world.time_ns).to_msg()
        message.name = list(self.joints)
        message.position = list(self.world.read())
        message.effort = list(self.world.applied_efforts())
        self.states += 1
        self.message = message
        self.publisher.publish(message)

    def ask_again(self) -> None:
        """Publish the state again when nothing has moved: a first message may be lost."""
        if self.seen == self.states:
            self.publisher.publish(self.message)
        self.seen = self.states

    def on_effort(self, joint: str, message: Float64) -> None:
        """Take an effort, and go on when it was the last one missing."""
        self.efforts[joint] = message.data
        if len(self.efforts) < len(self.joints):
            return
        if self.world.time_ns >= self.end_ns:
            self.wall_time = time.perf_counter() - self.begin
            raise SystemExit
        self.world.step([self.efforts[joint] for joint in self.joints])
        self.efforts.clear()
        self.publish_state()


def main() -> int:
    """Run one node."""
    parser = argparse.ArgumentParser(description="The closed loop in plain rclpy")
    parser.add_argument("--control", metavar="JOINT")
    parser.add_argument("--simulate", action="store_true")
    parser.add_argument("--seconds", type=float, default=1.0, help="of simulated time")
    options = parser.parse_args()
    rclpy.init(args=[])
    node = rclpy.create_node(f"{options.control or 'robot'}_node")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if options.control:
            pid = NaivePid(node, options.control)
            executor.spin()
            del pid
        else:
            with World(tracking(physics_steps=1, engine="mujoco").world) as world:
                _simulate(node, executor, world, options.seconds)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


def _simulate(node: Node, executor: SingleThreadedExecutor, world: World, seconds: float) -> None:
    """Run to the end and say how it went, and how far the joints are from where they should be."""
    robot = NaiveRobot(node, world, seconds)
    try:
        executor.spin()
    except SystemExit:
        wanted = tracking().trajectory
        errors = [
            abs(wanted.column(joint).start(0, position, 0.0).sample(world.time_ns)[0] - position)
            for joint, position in zip(robot.joints, world.true_positions(), strict=True)
        ]
        rate = robot.states / robot.wall_time
        result = {"states": robot.states, "rate": rate, "largest_error": max(errors)}
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    sys.exit(main())
