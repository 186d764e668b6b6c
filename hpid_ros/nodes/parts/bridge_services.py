"""The bridge's services, and its reports: clock, base, end effector, task, its own time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, Vector3Stamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hpid_ros.base.durations import Durations
from hpid_ros.base.errors import HpidError
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages import reports as wire
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED, RARE
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import log_change
from hpid_ros.simulation.gripper import GRASPED, LOST, MISSED, GripEvent
from hpid_ros.simulation.reports import CLOCK_TOPIC, REPORT_KINDS, REPORT_RATE, Reports, grip_words
from hpid_ros.simulation.world import World


@dataclass(frozen=True)
class WrenchParameters(Record):
    """How a person pushes."""

    wrench_duration: float = quantity(
        "How long one message on ~/wrench pushes", "s", default=0.1, least=1e-6, most=3600.0
    )


class BridgeServices:
    """``~/pause``, ``~/step``, ``~/reset`` and the topic ``~/wrench``."""

    def __init__(
        self,
        node: Node,
        world: World,
        prefix: str,
        reset: Callable[[], None],
        resume: Callable[[], None],
    ) -> None:
        self._node = node
        self._world = world
        self._prefix = prefix
        self.reset = reset
        self._resume = resume
        self.is_paused = False  # time stands still but for single steps
        self._steps = 0
        duration = read(node, WrenchParameters).wrench_duration
        self._wrench_ns = round(duration * NANOSECONDS)
        node.create_service(SetBool, "~/pause", self._on_pause)
        node.create_service(Trigger, "~/step", self._on_step)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_subscription(WrenchStamped, "~/wrench", self._on_wrench, RARE)

    def pause(self, is_paused: bool) -> None:
        """Let time stand still from now on, or go on."""
        self.is_paused, self._steps = is_paused, 0
        if not is_paused:
            self._resume()

    def step(self) -> bool:
        """Let a paused simulation go on by one control period, and return whether it is paused."""
        if self.is_paused:
            self._steps += 1
            self._resume()
        return self.is_paused

    def may_advance(self) -> bool:
        """Return whether one more control period may be simulated, and use up a single step."""
        if not self.is_paused:
            return True
        if self._steps == 0:
            return False
        self._steps -= 1
        return True

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = True
        response.message = self._at_now("paused" if request.data else "running")
        self.pause(request.data)
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.step()
        response.message = (
            self._at_now("one control period")
            if response.success
            else "not paused: call ~/pause with data: true first"
        )
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success, response.message = True, self._at_now("reset")
        return response

    def _on_wrench(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force, message.wrench.torque
        try:
            self._world.apply_wrench(
                message.header.frame_id.removeprefix(self._prefix),
                (force.x, force.y, force.z),
                (torque.x, torque.y, torque.z),
                self._wrench_ns,
            )
        except HpidError as error:
            log_change(self._node, f"wrench refused: {error}", is_warning=True)

    def _at_now(self, what: str) -> str:
        return f"{what} at {self._world.time_ns / NANOSECONDS:.3f} s"


def offer_standard_services(node: ClosingNode, simulation: BridgeServices, world: World) -> None:
    """Offer the services of ``simulation_interfaces`` where their package is installed.

    Source: the definitions of ``simulation_interfaces``, 2.1.0; run with 1.5.1, Jazzy's, too.
    """
    try:
        from simulation_interfaces import msg, srv
    except ImportError:
        return
    offered = StandardServices(node, simulation, world, msg, srv)
    node.create_service(srv.GetSimulatorFeatures, "~/get_simulator_features", offered.features)
    node.create_service(srv.GetSimulationState, "~/get_simulation_state", offered.state)
    node.create_service(srv.SetSimulationState, "~/set_simulation_state", offered.set_state)
    node.create_service(srv.ResetSimulation, "~/reset_simulation", offered.reset)
    node.create_service(srv.StepSimulation, "~/step_simulation", offered.step)


class StandardServices:
    """Answers the requests of ``simulation_interfaces``, whose messages are given."""

    def __init__(
        self, node: ClosingNode, simulation: BridgeServices, world: World, msg: Any, srv: Any
    ) -> None:
        self._node, self._simulation, self._world = node, simulation, world
        self._states, self._results = msg.SimulationState, msg.Result
        self._features = msg.SimulatorFeatures
        self._scopes = srv.ResetSimulation.Request
        self._already = srv.SetSimulationState.Response.ALREADY_IN_TARGET_STATE

    def features(self, request: Any, response: Any) -> Any:
        features = self._features
        response.features.features = [
            features.SIMULATION_RESET,
            features.SIMULATION_RESET_TIME,
            features.SIMULATION_RESET_STATE,
            features.SIMULATION_STATE_GETTING,
            features.SIMULATION_STATE_SETTING,
            features.SIMULATION_STATE_PAUSE,
            features.STEP_SIMULATION_SINGLE,
        ]
        response.features.custom_info = (
            "one step is one control period; a reset is of time and state"
        )
        return response

    def state(self, request: Any, response: Any) -> Any:
        response.state.state = self._present()
        return self._answered(response)

    def set_state(self, request: Any, response: Any) -> Any:
        """Play, pause, stop or quit; stopped is paused at time zero."""
        states, wanted = self._states, request.state.state
        if wanted == self._present():
            return self._answered(response, self._already)
        if wanted == states.STATE_PLAYING:
            self._simulation.pause(False)
        elif wanted in (states.STATE_PAUSED, states.STATE_STOPPED):
            self._simulation.pause(True)
            if wanted == states.STATE_STOPPED:
                self._simulation.reset()
        elif wanted == states.STATE_QUITTING:
            self._node.request_stop()
        else:
            return self._unsupported(
                response,
                f"the state may be stopped (0), playing (1), paused (2) or quitting (3), "
                f"not {wanted}",
            )
        return self._answered(response)

    def reset(self, request: Any, response: Any) -> Any:
        scopes = self._scopes
        both = scopes.SCOPE_TIME | scopes.SCOPE_STATE
        if request.scope != scopes.SCOPE_DEFAULT and request.scope & both != both:
            return self._unsupported(
                response,
                f"time and state are reset together, by scope 0, {both} or 255, "
                f"not {request.scope}",
            )
        self._simulation.reset()
        return self._answered(response)

    def step(self, request: Any, response: Any) -> Any:
        """Let one control period pass; in lock-step it waits for the answers."""
        if request.steps != 1:
            return self._unsupported(response, f"one step at a time, not {request.steps}")
        if not self._simulation.step():
            return self._answered(
                response, self._results.RESULT_OPERATION_FAILED, "the simulation is not paused"
            )
        return self._answered(response)

    def _present(self) -> int:
        """Return the state that the simulation is in."""
        if not self._simulation.is_paused:
            return int(self._states.STATE_PLAYING)
        is_stopped = self._world.time_ns == 0
        return int(self._states.STATE_STOPPED if is_stopped else self._states.STATE_PAUSED)

    def _answered(self, response: Any, result: int | None = None, line: str = "") -> Any:
        """Return a response with its result, which is well if none is given."""
        found = self._results.RESULT_OK if result is None else result
        response.result.result, response.result.error_message = int(found), line
        return response

    def _unsupported(self, response: Any, line: str) -> Any:
        return self._answered(response, self._results.RESULT_FEATURE_UNSUPPORTED, line)


_MESSAGES: dict[str, Any] = {
    wire.CLOCK: Clock,
    wire.ODOMETRY: Odometry,
    wire.VECTOR: Vector3Stamped,
    wire.POSE: PoseStamped,
    wire.POSES: PoseArray,
    wire.STATUSES: DiagnosticArray,
}


@dataclass(frozen=True)
class ReportParameters(Record):
    """What is published of base and task."""

    report_rate: float = quantity(
        "Rate of clock, odom, base_pose_ground_truth, wheel_slip and ee_pose [Hz]; 0 is off",
        default=REPORT_RATE,
        least=0.0,
        most=1e6,
    )
    ee_link: str = quantity("Link whose pose is ee_pose; the last one if empty", default="")


class BridgeReports:
    """Publishes reports of base and task, at a rate of simulated time.

    The URDF is latched on ``robot_description``, where RViz and Foxglove look for it.
    Among bricks the service ``~/grip`` closes or opens the gripper.
    """

    def __init__(self, node: Node, world: World, prefix: str, end_ns: int | None = None) -> None:
        self._node, self._world = node, world
        asked = read(node, ReportParameters)
        link = world.description.link(asked.ee_link or world.description.last_link)
        self._reports = Reports(
            world, link, asked.report_rate, end_ns, prefix=prefix, notice=self._on_grip_event
        )
        self._publishers = {
            topic: node.create_publisher(
                _MESSAGES[REPORT_KINDS[topic]], topic, RARE if topic == CLOCK_TOPIC else OFFERED
            )
            for topic in self._reports.topics
        }
        node.create_publisher(String, "robot_description", LATCHED).publish(
            String(data=world.description.xml)
        )
        self.figures = self._reports.figures
        if world.gripper is not None:
            node.create_service(SetBool, "~/grip", self._on_grip)

    @property
    def counts(self) -> dict[str, int]:
        """Messages that a recorder must have got so far, by full name of their topic."""
        return {
            self._publishers[topic].topic_name: count
            for topic, count in self._reports.counts.items()
            if topic != CLOCK_TOPIC
        }

    def sample(self, stamp_ns: int, positions: Sequence[float]) -> None:
        """Publish what is due; once for each state."""
        for topic, raw in self._reports.sample(stamp_ns, positions):
            self._publishers[topic].publish(raw)

    def _on_grip_event(self, event: GripEvent) -> None:
        log_change(self._node, grip_words(event), is_warning=event.outcome in (MISSED, LOST))

    def _on_grip(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        assert self._world.gripper is not None
        event = self._world.gripper.move(request.data, self._world.time_ns)
        for topic, raw in self._reports.events():
            self._publishers[topic].publish(raw)
        if event is None:
            response.success = True
            response.message = "nothing changed: it was so already, or holds nothing"
            return response
        response.success = event.outcome in (GRASPED, "released")
        response.message = grip_words(event)
        return response


class BridgeTiming:
    """Wall-clock figures of the bridge.

    A cycle is the time between two published states; a joint's latency the time from a state's
    publication to the arrival of the joint's answer to it.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._cycles = Durations()
        self._latencies = {joint: Durations() for joint in joints}
        self.published_ns = self._first_ns = 0
        self._reported = time.perf_counter_ns(), 0

    def published(self) -> None:
        now = time.perf_counter_ns()
        if self.published_ns:
            self._cycles.note(now - self.published_ns)
        else:
            self._first_ns = now
        self.published_ns = now

    def answered(self, joints: Sequence[str]) -> None:
        """Note that the answers of joints to the last published state have come."""
        delay_ns = time.perf_counter_ns() - self.published_ns
        for joint in joints:
            if joint in self._latencies:
                self._latencies[joint].note(delay_ns)

    @property
    def elapsed(self) -> float:
        return (time.perf_counter_ns() - self._first_ns) / NANOSECONDS

    def recent(self, simulated_ns: int) -> dict[str, float]:
        """Return the figures since the last call, with their units, for ``/diagnostics``."""
        now, (then, before) = time.perf_counter_ns(), self._reported
        self._reported = now, simulated_ns
        figures = {
            "real-time factor": max(simulated_ns - before, 0) / max(now - then, 1),
            **self._cycles.recent().readings("cycle"),
        }
        for joint, durations in self._latencies.items():
            latency = durations.recent()
            figures[f"{joint}: answer latency, median [us]"] = latency.median
            figures[f"{joint}: answer latency, 99th percentile [us]"] = latency.p99
        return figures

    def whole(self) -> dict[str, Any]:
        """Return the figures of the whole run, in [us], for a parent process."""
        return {
            "cycle": self._cycles.whole()._asdict(),
            "latency": {
                joint: durations.whole()._asdict() for joint, durations in self._latencies.items()
            },
        }
