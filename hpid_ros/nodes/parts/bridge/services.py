"""The bridge's services: pause, single steps, reset."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from hpid_ros.base.errors import HpidError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.middleware import RARE
from hpid_ros.nodes.ros.parameters import read_number
from hpid_ros.simulation.world.world import World


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
        self._reset = reset
        self._resume = resume
        self._is_paused = False
        self._steps = 0
        duration = read_number(
            node,
            "wrench_duration",
            0.1,
            "How long one message on ~/wrench pushes [s]",
            (1e-6, 3600.0),
        )
        self._wrench_ns = round(duration * NANOSECONDS)
        node.create_service(SetBool, "~/pause", self._on_pause)
        node.create_service(Trigger, "~/step", self._on_step)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_subscription(WrenchStamped, "~/wrench", self._on_wrench, RARE)

    @property
    def is_paused(self) -> bool:
        """Whether time stands still but for single steps."""
        return self._is_paused

    def pause(self, is_paused: bool) -> None:
        """Let time stand still from now on, or go on."""
        self._is_paused, self._steps = is_paused, 0
        if not is_paused:
            self._resume()

    def step(self) -> bool:
        """Let a paused simulation go on by one control period, and tell whether it is paused."""
        if self._is_paused:
            self._steps += 1
            self._resume()
        return self._is_paused

    def reset(self) -> None:
        """Go back to time zero."""
        self._reset()

    def may_advance(self) -> bool:
        """Tell whether one more control period may be simulated, and use up a single step."""
        if not self._is_paused:
            return True
        if self._steps == 0:
            return False
        self._steps -= 1
        return True

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = True
        response.message = self._told("paused" if request.data else "running")
        self.pause(request.data)
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.step()
        response.message = (
            self._told("one control period")
            if response.success
            else "not paused: call ~/pause with data: true first"
        )
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.reset()
        response.success, response.message = True, self._told("reset")
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
            self._node.get_logger().warning(f"wrench refused: {error}")

    def _told(self, what: str) -> str:
        return f"{what} at {self._world.time_ns / NANOSECONDS:.3f} s"
