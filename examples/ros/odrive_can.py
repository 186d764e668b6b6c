"""A driver between joint controllers and the motors of their joints: ODrives on a CAN bus.

    python examples/ros/odrive_can.py can0 shoulder=1:8 elbow=2:-10

JOINT=NODE:GEAR is a node of the bus, and how often its motor turns for one turn of the joint. It
publishes ``joint_states`` when every joint has told of itself, obeys ``joint_commands``, and gives
a joint without commands no torque. Without arguments it shows its frames. The protocol is ODrive's
"CAN Simple". Let the ODrive's own watchdog stop the motor when this process is killed.
"""

import contextlib
import math
import signal
import socket
import struct
import sys
import threading
import time

import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

FRAME = struct.Struct("=IB3x8s")  # of SocketCAN: identifier, length, data
HEARTBEAT, STATE, ESTIMATES, MODES, TORQUE = 0x01, 0x07, 0x09, 0x0B, 0x0E  # commands
IDLE, CLOSED_LOOP = 1, 8  # states of an axis
TIMEOUT = 0.1  # [s]


def frame(node, command, layout, *values):
    """Return a command to a node of the bus."""
    data = struct.pack(layout, *values)
    return FRAME.pack(node << 5 | command, len(data), data.ljust(8, b"\0"))


def drive(bus, joints):
    """Stand between a bus and the graph until the process is told to end."""
    bus.settimeout(TIMEOUT)
    node = rclpy.create_node("odrive_can")
    name_of = {number: name for name, (number, _) in joints.items()}
    commanded, states = dict.fromkeys(joints, -math.inf), {}

    def push(name, effort):
        number, gear = joints[name]
        bus.send(frame(number, TORQUE, "<f", effort / gear if math.isfinite(effort) else 0.0))

    def on_command(message):
        for name, effort in zip(message.name, message.effort, strict=True):
            if name in joints:
                commanded[name] = time.monotonic()
                push(name, effort)

    def look_for_silence():
        for name, when in commanded.items():
            if time.monotonic() - when > TIMEOUT:
                push(name, 0.0)

    def spin():
        while not ending.is_set():
            rclpy.spin_once(node, timeout_sec=TIMEOUT / 4)

    def read():
        identifier, _, data = FRAME.unpack(bus.recv(FRAME.size))
        name, command = name_of.get(identifier >> 5), identifier & 0x1F
        if name and command == HEARTBEAT and data[4] != CLOSED_LOOP:
            node.get_logger().warning(f"{name}: axis state {data[4]}", throttle_duration_sec=1.0)
        if name and command == ESTIMATES:  # turns of the motor, and turns a second
            states[name] = [math.tau * x / joints[name][1] for x in struct.unpack("<ff", data)]
        if len(states) == len(joints):
            message = JointState(name=list(states))
            message.header.stamp = node.get_clock().now().to_msg()
            message.position, message.velocity = map(list, zip(*states.values(), strict=True))
            publisher.publish(message)
            states.clear()

    publisher = node.create_publisher(JointState, "joint_states", 10)
    node.create_subscription(JointState, "joint_commands", on_command, 2 * len(joints))
    node.create_timer(TIMEOUT / 4, look_for_silence)
    for number, _ in joints.values():
        bus.send(frame(number, MODES, "<ii", 1, 1))  # torque, as it comes
        bus.send(frame(number, STATE, "<I", CLOSED_LOOP))
    ending = threading.Event()
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: ending.set())
    spinning = threading.Thread(target=spin)
    spinning.start()
    try:
        while not ending.is_set():
            with contextlib.suppress(TimeoutError):
                read()
    finally:
        ending.set()
        spinning.join()
        for number, _ in joints.values():
            bus.send(frame(number, TORQUE, "<f", 0.0))
            bus.send(frame(number, STATE, "<I", IDLE))
    node.destroy_node()


def main(interface, *wanted):
    """Drive the joints that are wanted, each as JOINT=NODE:GEAR, on an interface."""
    pairs = [(name, each.split(":")) for name, each in (text.split("=") for text in wanted)]
    bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    bus.bind((interface,))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # the motors are left first
    drive(bus, {name: (int(number), float(gear)) for name, (number, gear) in pairs})
    rclpy.shutdown()


if __name__ == "__main__" and len(sys.argv) > 2:
    main(*sys.argv[1:])
elif __name__ == "__main__":
    for what, *content in (
        ("closed loop", STATE, "<I", CLOSED_LOOP),
        ("torque 0.25 N m", TORQUE, "<f", 0.25),
    ):
        identifier, length, data = FRAME.unpack(frame(1, *content))
        print(f"node 1, {what:15}: {identifier:03X}#{data[:length].hex().upper()}")
