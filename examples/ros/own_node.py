"""A ROS node of one's own around the joint loop, and a joint for it to drive.

The package's ``joint_controller`` is such a node with lifecycle, watchdog and parameters. This is
the least that closes a loop: the states' stamps are the clock, and every state is answered. Both
nodes are in this process, so that the file runs alone.
"""

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

from hpid_ros.control import Gains, JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import NormSettings

JOINT, TARGET = "elbow", 0.5  # [rad]
INERTIA, PERIOD, SAMPLES = 0.05, 0.004, 300  # [kg m^2], [s]


class Controller(Node):
    """Answers every state of its joint with an effort."""

    def __init__(self):
        super().__init__("elbow_controller")
        self._loop = JointLoop(
            LoopSettings(
                joint=JOINT,
                gains=Gains(p=15.0, i=50.0, d=1.5),
                mu=-0.1,
                norm=NormSettings(error_scale=0.3),
                inertia=INERTIA,
            )
        )
        self._loop.follow(Setpoint(TARGET))
        self._commands = self.create_publisher(JointState, "joint_commands", 10)
        self.create_subscription(JointState, "joint_states", self._on_state, 10)

    def _on_state(self, state):
        place = state.name.index(JOINT)
        stamp_ns = Time.from_msg(state.header.stamp).nanoseconds
        velocity = state.velocity[place] if state.velocity else None
        effort = self._loop.step(stamp_ns, state.position[place], velocity)
        command = JointState(name=[JOINT], effort=[effort])
        command.header.stamp = state.header.stamp
        self._commands.publish(command)


class Joint(Node):
    """Plays the robot: an inertia that moves one period with every command."""

    def __init__(self):
        super().__init__("robot")
        self.position = self._velocity = 0.0
        self.samples = 0
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(JointState, "joint_commands", self._on_command, 10)

    def is_heard(self):
        """Tell whether somebody listens to the states."""
        return self._states.get_subscription_count() > 0

    def tell(self):
        """Publish the present state."""
        state = JointState(name=[JOINT], position=[self.position], velocity=[self._velocity])
        state.header.stamp = Time(nanoseconds=round(self.samples * PERIOD * 1e9)).to_msg()
        self._states.publish(state)

    def _on_command(self, command):
        self._velocity += PERIOD * command.effort[0] / INERTIA
        self.position += PERIOD * self._velocity
        self.samples += 1
        self.tell()


if __name__ == "__main__":
    rclpy.init()
    controller, joint = Controller(), Joint()
    executor = SingleThreadedExecutor()
    executor.add_node(controller)
    executor.add_node(joint)
    while not (joint.is_heard() and joint.count_subscribers("joint_commands")):
        executor.spin_once(timeout_sec=0.1)
    joint.tell()
    while joint.samples < SAMPLES:
        executor.spin_once(timeout_sec=1.0)
    print(f"{JOINT}: {joint.position:.4f} rad after {joint.samples * PERIOD:g} s, wanted {TARGET}")
    rclpy.shutdown()
