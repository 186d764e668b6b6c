"""A stand-in for ros2_control: a manager, its group controller of efforts, and joints behind them.

It does what one was seen to do (ros2_control 4.46, ros2_controllers 4.42, Jazzy):

- A message of another size makes the controller's update fail, and the manager deactivates it for
  good. An empty one is ignored, one that is not finite is dropped, ``layout`` is not looked at.
- ``forward`` keeps its last efforts when it is deactivated, ``group`` writes zeros; neither has a
  timeout. Commands to one that is not active are discarded, while its subscription stays.
- Commands are heard best effort and volatile, one deep.
- ``/joint_states`` is reliable and latched, in the order of the alphabet, with NaN where a joint
  has no state interface of effort.
- The manager tells who is active on ``~/activity``, where that message is installed, and in its
  diagnostics.
"""

import contextlib
import math
import threading
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

try:
    from controller_manager_msgs.msg import ControllerManagerActivity, NamedLifecycleState
except ImportError:
    ControllerManagerActivity = None

COMMANDS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
PERIOD = 0.005  # [s]
NAME = "forward_effort_controller"
LABELS = {True: "active", False: "inactive"}


class Joint:
    """An inertia with friction."""

    def __init__(self, inertia):
        self.inertia = inertia
        self.position = self.velocity = self.effort = 0.0

    def move(self, dt):
        self.velocity += dt * (self.effort - self.inertia * self.velocity) / self.inertia
        self.position += dt * self.velocity


class GroupController:
    """A forward_command_controller, or a JointGroupEffortController, of efforts.

    Its node has a thread of its own: one that is destroyed in the midst of another thread's work
    goes later, and takes the name of the next one with it.
    """

    def __init__(self, context, joints, interface, kind, name):
        self.joints, self.kind = tuple(joints), kind
        self.is_active = False
        self.received = []  # (time, numbers), of all that came while it was active
        self.dropped = 0
        self._command = None
        self.node = rclpy.create_node(name, context=context)
        fixed = ParameterDescriptor(read_only=True)
        self.node.declare_parameter("joints", list(joints), fixed)
        self.node.declare_parameter("interface_name", interface, fixed)
        self.node.create_subscription(Float64MultiArray, "~/commands", self._on_command, COMMANDS)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._ended = threading.Event()
        arguments = (self._executor, self._ended)
        self._thread = threading.Thread(target=spin, args=arguments, daemon=True)
        self._thread.start()

    def close(self):
        self._ended.set()
        self._thread.join()
        self._executor.shutdown()  # no earlier: rclpy takes from spin() what it spins with
        self.node.destroy_node()

    def _on_command(self, message):
        numbers = tuple(message.data)
        if not all(map(math.isfinite, numbers)):
            self.dropped += 1
            return
        if self.is_active:
            self.received.append((time.monotonic(), numbers))
        self._command = numbers

    def switch(self, is_active, hardware):
        self._command = None  # what came while it was not active
        if self.is_active and not is_active and self.kind == "group":
            for joint in self.joints:
                hardware[joint].effort = 0.0
        self.is_active = is_active

    def update(self, hardware):
        """Return whether the manager leaves it active."""
        if not self._command:  # none yet, or an empty one
            return True
        if len(self._command) != len(self.joints):
            return False
        for joint, effort in zip(self.joints, self._command, strict=True):
            hardware[joint].effort = effort
        return True


def spin(executor, ended):
    with contextlib.suppress(ExternalShutdownException):
        while not ended.is_set():
            executor.spin_once(timeout_sec=0.1)


class Ros2Control:
    """A manager in a thread of its own, and joints by name."""

    def __init__(self, context, inertias):
        self.hardware = {name: Joint(inertia) for name, inertia in inertias.items()}
        self.controller = None  # while none is loaded
        self.refused = []  # sizes of the messages for which the manager has deactivated it
        self._lock = threading.RLock()
        self._context = context
        self._manager = rclpy.create_node("controller_manager", context=self._context)
        self._broadcaster = rclpy.create_node("joint_state_broadcaster", context=self._context)
        self._states = self._broadcaster.create_publisher(JointState, "joint_states", LATCHED)
        self._diagnostics = self._manager.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._activity = ControllerManagerActivity and self._manager.create_publisher(
            ControllerManagerActivity, "~/activity", LATCHED
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        for node in (self._manager, self._broadcaster):
            self._executor.add_node(node)
        self._manager.create_timer(PERIOD, self._cycle)
        self._manager.create_timer(0.1, self._tell)
        self._ended = threading.Event()
        arguments = (self._executor, self._ended)
        self._thread = threading.Thread(target=spin, args=arguments, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.unload()
        self._ended.set()
        self._thread.join()
        self._executor.shutdown()  # no earlier: rclpy takes from spin() what it spins with
        for node in (self._manager, self._broadcaster):
            node.destroy_node()

    def load(self, joints, *, interface="effort", kind="forward", name=NAME):
        """Load, configure and activate a group controller in place of the last one."""
        self.unload()
        controller = GroupController(self._context, joints, interface, kind, name)
        with self._lock:
            self.controller = controller
        self.switch(True)

    def unload(self):
        """Deactivate the controller and remove its node, if there is one."""
        with self._lock:
            controller, self.controller = self.controller, None
            if controller is not None:
                controller.switch(False, self.hardware)
        if controller is not None:
            controller.close()
        self._tell()

    def switch(self, is_active):
        """Activate or deactivate the controller, as ``ros2 control switch_controllers`` does."""
        with self._lock:
            self.controller.switch(is_active, self.hardware)
        self._tell()

    def efforts(self):
        """Return the efforts in force by joint."""
        return {name: joint.effort for name, joint in self.hardware.items()}

    def _cycle(self):
        with self._lock:
            controller = self.controller
            is_active = controller is not None and controller.is_active
            if is_active and not controller.update(self.hardware):
                self.refused.append(len(controller.received[-1][1]))
                self.switch(False)
            for joint in self.hardware.values():
                joint.move(PERIOD)
            self._publish_states()

    def _publish_states(self):
        names = sorted(self.hardware)
        joints = [self.hardware[name] for name in names]
        state = JointState(
            name=names,
            position=[joint.position for joint in joints],
            velocity=[joint.velocity for joint in joints],
            effort=[math.nan] * len(joints),
        )
        state.header.frame_id = "base_link"
        state.header.stamp = self._manager.get_clock().now().to_msg()
        self._states.publish(state)

    def _tell(self):
        with self._lock:
            controller = self.controller
            states = {} if controller is None else {
                controller.node.get_name(): LABELS[controller.is_active]
            }  # fmt: skip
            status = DiagnosticStatus(
                name="controller_manager: Controllers Activity",
                hardware_id="ros2_control",
                values=[KeyValue(key=f"{name}.state", value=s) for name, s in states.items()],
            )
            self._diagnostics.publish(DiagnosticArray(status=[status]))
            if self._activity is not None:
                activity = ControllerManagerActivity()
                for name, label in states.items():
                    named = NamedLifecycleState(name=name)
                    named.state.label = label
                    activity.controllers.append(named)
                self._activity.publish(activity)
