"""Joint controllers, the example of a driver for a CAN bus, and motors that speak its protocol."""

import math
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress

import pytest
from harness.places import ROOT
from std_msgs.msg import Float64

from hpid_ros.nodes.core.middleware import RARE

EXAMPLE = ROOT / "examples" / "ros" / "odrive_can.py"
JOINTS = {"shoulder": (1, 8.0), "elbow": (2, -10.0)}
INERTIAS = {"shoulder": 2.0, "elbow": 0.5}
TARGETS = {"shoulder": -0.2, "elbow": 0.4}
FRAME = struct.Struct("=IB3x8s")
HEARTBEAT, STATE, ESTIMATES, MODES, TORQUE = 0x01, 0x07, 0x09, 0x0B, 0x0E
CLOSED_LOOP, IDLE = 8, 1
PROGRAM = (
    "import runpy, socket, rclpy; from rclpy.signals import SignalHandlerOptions; "
    "example = runpy.run_path({example!r}); "
    "rclpy.init(signal_handler_options=SignalHandlerOptions.NO); "
    "example['drive'](socket.socket(fileno={fileno}), {joints!r}); rclpy.shutdown()"
)


class Motor:
    """An ODrive with its motor, and the joint that it turns."""

    def __init__(self, gear, inertia):
        self.gear, self.inertia = gear, inertia  # turns for one of the joint; of the joint
        self.position = self.velocity = 0.0  # of the joint
        self.torque = 0.0  # of the motor
        self.state, self.mode = IDLE, None

    def obey(self, command, data):
        if command == TORQUE:
            (self.torque,) = struct.unpack("<f", data[:4])
        elif command == STATE:
            (self.state,) = struct.unpack("<I", data[:4])
        elif command == MODES:
            self.mode = struct.unpack("<ii", data)

    def move(self, dt):
        is_driven = self.state == CLOSED_LOOP and self.mode == (1, 1)
        driven = self.torque * self.gear if is_driven else 0.0
        self.velocity += dt * (driven / self.inertia - self.velocity)
        self.position += dt * self.velocity

    def estimates(self):
        turns = self.gear / math.tau
        return struct.pack("<ff", turns * self.position, turns * self.velocity)


class Bus:
    """Motors at the other end of a bus, which they fill every two milliseconds."""

    def __init__(self):
        self.motors = {
            number: Motor(gear, INERTIAS[joint]) for joint, (number, gear) in JOINTS.items()
        }
        self.near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._far.settimeout(0.002)
        self._is_open = True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self):
        self._is_open = False
        self._thread.join()
        self._far.close()

    def of(self, joint):
        return self.motors[JOINTS[joint][0]]

    def _run(self):
        last = time.monotonic()
        while self._is_open:
            self._hear()
            now = time.monotonic()
            if now - last < 0.002:
                continue
            for number, motor in self.motors.items():
                motor.move(min(now - last, 0.02))
                self._say(number, HEARTBEAT, struct.pack("<IB3x", 0, motor.state))
                self._say(number, ESTIMATES, motor.estimates())
            last = now

    def _hear(self):
        frame = b""
        with suppress(TimeoutError, ConnectionError):  # nobody speaks
            frame = self._far.recv(FRAME.size)
        if frame:
            identifier, _, data = FRAME.unpack(frame)
            self.motors[identifier >> 5].obey(identifier & 0x1F, data)

    def _say(self, number, command, data):
        with suppress(TimeoutError, ConnectionError):  # nobody reads the bus
            self._far.send(FRAME.pack(number << 5 | command, len(data), data))


@pytest.fixture
def bus():
    bus = Bus()
    yield bus
    bus.close()


@contextmanager
def driver(bus, environment):
    """Yield the example in a process of its own."""
    fileno = bus.near.fileno()
    program = PROGRAM.format(example=str(EXAMPLE), fileno=fileno, joints=JOINTS)
    with subprocess.Popen(
        [sys.executable, "-c", program], env=environment, pass_fds=[fileno]
    ) as process:
        bus.near.close()
        try:
            yield process
        finally:
            process.kill()


def test_controllers_drive_motors_on_a_bus(harness, bus):
    """Joints come to their targets; without a controller, and at the end, they have no torque."""
    with driver(bus, harness.environment) as process:
        controllers = {joint: harness.start_damped(joint, INERTIAS[joint]) for joint in JOINTS}
        setpoints = {
            joint: harness.node.create_publisher(Float64, f"{joint}_controller/setpoint", RARE)
            for joint in JOINTS
        }
        for joint, publisher in setpoints.items():
            harness.wait(publisher.get_subscription_count, what=f"{joint} to listen")
            publisher.publish(Float64(data=TARGETS[joint]))
        harness.wait(
            lambda: all(abs(bus.of(j).position - TARGETS[j]) < 0.01 for j in JOINTS),
            what="the joints where they are wanted",
        )
        bus.of("elbow").position += 0.2  # somebody pushes it: its controller works
        harness.wait(lambda: abs(bus.of("elbow").torque) > 0.01, what="a torque")
        controllers["elbow"].process.kill()
        harness.wait(lambda: bus.of("elbow").torque == 0.0, what="no torque")
        process.terminate()
        assert process.wait() == 0
        harness.wait(
            lambda: all(m.state == IDLE and m.torque == 0.0 for m in bus.motors.values()),
            what="motors that are left idle",
        )
