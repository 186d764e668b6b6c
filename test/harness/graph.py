"""A node inside the test that talks to real nodes in real processes."""

import math
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from hpid_bench.experiment.processes import NodeGroup
from hpid_ros.base.errors import MessageError
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import OFFERED, destroy_when_quiet

NAME = "elbow_controller"
TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "shutdown": Transition.TRANSITION_ACTIVE_SHUTDOWN,
}
_ANSWERED_WITHIN = _LOST_WITHIN = 5.0  # [s]


class Harness:
    """The robot's side of the graph, played by the test."""

    def __init__(self, domain, environment, folder):
        self.environment = environment
        self.context = rclpy.Context()
        rclpy.init(
            args=[],
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        # Whoever asks it for its parameters while the test does something else would wait in vain.
        self.node = rclpy.create_node(
            "robot", context=self.context, start_parameter_services=False
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.processes = NodeGroup(environment, folder)
        self.commands = []
        self.on_command = self.commands.append
        self.states = self.node.create_publisher(JointState, "joint_states", OFFERED)
        self.node.create_subscription(
            JointState, "joint_commands", self._on_command, OFFERED, raw=True
        )

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.processes.__exit__(*error)
        self.executor.shutdown()
        destroy_when_quiet(self.node)
        rclpy.shutdown(context=self.context)

    def _on_command(self, raw):
        with suppress(MessageError):  # some tests send what is none
            self.on_command(decode_joint_state(raw))

    def heard_from_now(self, duration, topic="joint_commands", least=0):
        """Return the commands of a while from now on, without what waits for a test that slept."""
        heard = []
        fresh = self.node.create_subscription(JointState, topic, heard.append, OFFERED)
        self.wait(fresh.get_publisher_count, what=f"a publisher of {topic}")
        end = time.monotonic() + duration
        self.wait(lambda: time.monotonic() > end and len(heard) >= least, what="the while to pass")
        self.node.destroy_subscription(fresh)
        return heard

    def wait(self, condition, within=60.0, what="the condition", found=lambda: ""):
        """Spin until a condition holds; what was found in its place is told where it does not."""
        deadline = time.monotonic() + within
        while not condition():
            self.executor.spin_once(timeout_sec=0.02)
            if time.monotonic() >= deadline:
                raise AssertionError(f"waited {within} s in vain for {what} {found()}".rstrip())

    def is_there(self, name, namespace="/"):
        """Tell whether a node publishes: its name alone may stay listed when it has gone."""
        endpoints = self.node.get_publishers_info_by_topic("/parameter_events")
        return _has(endpoints, name, namespace)

    def subscribes(self, name, topic, namespace="/"):
        """Tell whether a node subscribes to a topic."""
        return _has(self.node.get_subscriptions_info_by_topic(topic), name, namespace)

    def start_controller(self, name=NAME, joint="elbow", **parameters):
        """Start a controller and wait until it listens to the states.

        Its clock is that of the test, which stands still while the test does something else. Only
        with a timeout of its own does the controller look for how long, by the time of the wall.
        """
        parameters.setdefault("state_clock", "simulated")
        parameters.setdefault("state_watchdog", "state_timeout" in parameters)
        process = self.processes.start(
            name, "joint_controller", ros_arguments(joint=joint, **parameters)
        )
        self.wait(lambda: self.states.get_subscription_count() > 0, what=f"{name} to listen")
        return process

    def start_damped(self, joint, inertia):
        """Start a controller of a joint of an inertia; the poles of all are the same."""
        gains = {"law": "pid", "gains__p": 25.0 * inertia, "gains__d": 9.0 * inertia}
        arguments = ros_arguments(joint=joint, state_timeout=1.0, certify=False, **gains)
        return self.processes.start(f"{joint}_controller", "joint_controller", arguments)

    def ask(self, stamp_ns, position, velocity=0.0, joint="elbow"):
        """Publish one state, again where it was lost, and return the effort that answers it."""
        return self.answer(stamp_ns, lambda: self.publish(stamp_ns, position, velocity, joint))

    def ask_newcomer(self, stamp_ns, position, velocity=0.0, joint="elbow"):
        """Publish one state until it is answered: a subscription may not be matched yet."""
        told = partial(self.publish, stamp_ns, position, velocity, joint)
        return self.answer(stamp_ns, told, again_after=0.0)

    def publish(self, stamp_ns, position, velocity=0.0, joint="elbow"):
        """Publish one state."""
        template = JointStateTemplate([joint], position=True, velocity=True)
        self.states.publish(template.encode(stamp_ns, position=[position], velocity=[velocity]))

    def answer(self, stamp_ns, publish, again_after=_LOST_WITHIN):
        """Publish a state, again where it was lost, and return the effort that answers it."""
        published_at = -math.inf

        def is_answered():
            nonlocal published_at
            if time.monotonic() > published_at + again_after:
                published_at = time.monotonic()
                publish()
            return any(each.stamp_ns == stamp_ns for each in self.commands)

        self.wait(is_answered, what=f"the answer to {stamp_ns}")
        return next(each.effort[0] for each in self.commands if each.stamp_ns == stamp_ns)

    def call(self, kind, name, request, again=True):
        """Call a service and return its answer.

        On a busy machine a server may not have found the client yet when it answers, and then
        nobody gets the answer: what does no harm twice is asked again.
        """
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, what=f"the service {name}")
        futures = []

        def is_answered():
            if not futures or (again and time.monotonic() > is_answered.until):
                futures.append(client.call_async(request))
                is_answered.until = time.monotonic() + _ANSWERED_WITHIN
            return any(future.done() for future in futures)

        self.wait(is_answered, what=f"the answer of {name}")
        self.node.destroy_client(client)
        return next(future.result() for future in futures if future.done())

    def set_parameters(self, node, atomically=True, **values):
        """Set parameters of a node as a whole and return (successful, reason)."""
        service = SetParametersAtomically if atomically else SetParameters
        name = "set_parameters_atomically" if atomically else "set_parameters"
        request = service.Request(
            parameters=[
                Parameter(key.replace("__", "."), value=value).to_parameter_msg()
                for key, value in values.items()
            ]
        )
        answer = self.call(service, f"{node}/{name}", request)
        result = answer.result if atomically else answer.results[0]
        return result.successful, result.reason


def _has(endpoints, name, namespace):
    return (name, namespace) in {(each.node_name, each.node_namespace) for each in endpoints}


def ros_arguments(**parameters):
    """Return ``-p name:=value`` for each parameter; ``__`` stands for a dot."""
    arguments = []
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name.replace('__', '.')}:={text}"]
    return arguments


class Told:
    """What a node, a controller if none is named, has told of its health."""

    def __init__(self, harness, name=NAME):
        self._name, self._statuses = name, []
        harness.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def _take(self, message):
        self._statuses += [status for status in message.status if self._name in status.name]

    def newest(self):
        """Return the newest figures by name; empty before the first."""
        if not self._statuses:
            return {}
        newest = self._statuses[-1]
        figures = {pair.key: pair.value for pair in newest.values}
        return {"message": newest.message, "level": newest.level, **figures}

    def count(self, key):
        """Return one of the newest figures as a number; 0 before the first."""
        return int(self.newest().get(key, 0))

    def says(self, **figures):
        """Tell whether the newest figures are these; ``_`` stands for a blank."""
        newest = self.newest()
        return all(newest.get(key.replace("_", " ")) == value for key, value in figures.items())


def change(harness, label, node=NAME):
    """Ask for a transition as ``ros2 lifecycle set`` does: by its number."""
    request = ChangeState.Request(transition=Transition(id=TRANSITIONS.get(label, 99)))
    answer = harness.call(ChangeState, f"{node}/change_state", request, again=False)
    return answer.success


def state(harness, node=NAME):
    """Return the name of the lifecycle's state."""
    answer = harness.call(GetState, f"{node}/get_state", GetState.Request())
    return answer.current_state.label


def is_stopped(process):
    status = Path(f"/proc/{process.pid}/stat").read_text()
    return status.rpartition(")")[2].split()[0] == "T"
