"""A driver for hardware with a Python library: states out, efforts in, zero when nobody answers.

    python examples/ros/driver_adapter.py

``Hardware`` is all that is to be replaced: read, write, close. Here it is a computed motor. The
driver runs at its own pace, takes the newest effort of each joint, and gives a joint that was
not commanded for TIMEOUT no effort. Here it starts a controller of its one joint, too, and gives
it a setpoint.
"""

import subprocess
import sys
import time

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

RATE, TIMEOUT, DURATION = 200.0, 0.1, 1.0  # [Hz], [s], [s]
TARGET = 0.3  # [rad]


class Hardware:
    """One motor with 0.05 kg m^2 and some friction. Replace it by your library."""

    joints = ("elbow",)

    def __init__(self):
        self._position = self._velocity = self._effort = 0.0

    def read(self):
        """Return positions [rad] and velocities [rad/s], along ``joints``."""
        self._velocity += (self._effort - 0.1 * self._velocity) / 0.05 / RATE
        self._position += self._velocity / RATE
        return [self._position], [self._velocity]

    def write(self, efforts):
        """Give each joint an effort [N m], along ``joints``."""
        (self._effort,) = efforts

    def close(self):
        """Leave the motors without effort."""
        self._effort = 0.0


class Driver(Node):
    """Stands between the hardware and the topics."""

    def __init__(self, hardware):
        super().__init__("driver")
        self._hardware = hardware
        self._efforts = dict.fromkeys(hardware.joints, 0.0)
        self._commanded = dict.fromkeys(hardware.joints, float("-inf"))
        self.answered = 0
        self.positions = []
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(JointState, "joint_commands", self._on_command, 10)
        self.create_timer(1.0 / RATE, self._cycle)

    def _on_command(self, command):
        for joint, effort in zip(command.name, command.effort, strict=True):
            if joint in self._efforts:
                self._efforts[joint], self._commanded[joint] = effort, time.monotonic()
                self.answered += 1

    def _cycle(self):
        now = time.monotonic()
        self._hardware.write(
            [
                effort if now - self._commanded[joint] < TIMEOUT else 0.0
                for joint, effort in self._efforts.items()
            ]
        )
        self.positions, velocities = self._hardware.read()
        state = JointState(name=list(self._efforts), position=self.positions, velocity=velocities)
        state.header.stamp = self.get_clock().now().to_msg()
        self._states.publish(state)


def controller(joint):
    """Return a controller of a joint, a process of its own."""
    values = {"joint": joint, "gains.p": 15.0, "gains.i": 50.0, "gains.d": 1.5}
    options = [text for name, value in values.items() for text in ("-p", f"{name}:={value}")]
    module = "hpid_ros.nodes.joint_controller"
    return subprocess.Popen([sys.executable, "-m", module, "--ros-args", *options])


if __name__ == "__main__":
    rclpy.init()
    hardware = Hardware()
    driver = Driver(hardware)
    process = controller(hardware.joints[0])
    try:
        while not driver.answered and process.poll() is None:
            rclpy.spin_once(driver, timeout_sec=0.1)
        setpoints = driver.create_publisher(Float64, "joint_controller/setpoint", 1)
        while not setpoints.get_subscription_count():
            if process.poll() is not None:
                sys.exit("the controller has ended; its last line says why")
            rclpy.spin_once(driver, timeout_sec=0.1)
        setpoints.publish(Float64(data=TARGET))
        until = time.monotonic() + DURATION
        while time.monotonic() < until:
            rclpy.spin_once(driver, timeout_sec=0.1)
    finally:
        hardware.close()
        process.terminate()
        process.wait()
    print(f"{driver.answered} commands, at {driver.positions[0]:+.4f} rad, wanted {TARGET:+g} rad")
    rclpy.shutdown()
