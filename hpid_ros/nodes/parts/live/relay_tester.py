"""Asks a joint's controller for a relay, and tells how it goes; the relay ends by itself."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray

from hpid_ros.control.interludes.relay import DONE
from hpid_ros.nodes.parts.live.order import read_order
from hpid_ros.nodes.ros import executor
from hpid_ros.nodes.ros.middleware import NEWEST_STATES, RARE, subscribe_raw
from hpid_ros.nodes.ros.status import StatusPipe
from hpid_ros.nodes.ros.steady_timer import steady_timer

_LOOK_PERIOD = 0.05  # [s]
_READY_WITHIN = 15.0  # [s]
_ANSWERS_WITHIN = 3.0  # [s]; a controller tells how it is once a second
_IN_FORCE = "; in force"


class RelayTester(executor.ClosingNode):
    """Publishes one request, and listens to the controller's diagnostics.

    Raises:
        SettingError: There is no order that can be used.
    """

    def __init__(self) -> None:
        super().__init__("hpid_relay_tester")
        order = read_order(self)
        self._controller = str(order["controller"])
        self._recorder = str(order["recorder"])
        self._request = [float(each) for each in order["request"]]
        self._publisher = self.create_publisher(
            Float64MultiArray, f"{self._controller}/relay", RARE
        )
        self._states = subscribe_raw(self, "joint_states", lambda raw: None, NEWEST_STATES)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RARE)
        self._status = StatusPipe(self)
        self._told: dict[str, str] = {}
        self._refused = ""
        self._born = self._heard = time.monotonic()
        self._begun: float | None = None
        self._was_in_force = self._is_over = False
        self._ending: Future | None = None
        steady_timer(self, _LOOK_PERIOD, self._look)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._controller:
                self._told = {each.key: each.value for each in status.values}
                self._heard = time.monotonic()
                if self._begun is not None:
                    self._take(self._told.get("relay", "none"))

    def _take(self, relay: str) -> None:
        """Take what the controller says of its relay."""
        if _IN_FORCE in relay:
            self._was_in_force = True
        elif self._was_in_force:
            ending = relay.rpartition(";")[0]
            self._end("" if ending == DONE else ending)
        elif self._told.get("refused references") != self._refused:
            self._end(self._told.get("last fault", "the relay was refused"))

    def _look(self) -> None:
        now = time.monotonic()
        if self._is_over:
            return
        if self._begun is None:
            lacking = self._lacking()
            if not lacking:
                self._begin(now)
            elif now - self._born > _READY_WITHIN:
                self._status.send("failed", reason=lacking)
                self._is_over = True
                self.request_stop(executor.FAILED)
        elif now - self._heard > _ANSWERS_WITHIN:
            self._end(f"{self._controller} has told nothing for {_ANSWERS_WITHIN:g} s")
        else:
            self._status.send("at", seconds=now - self._begun)

    def _lacking(self) -> str:
        """Return what is missing before the relay may begin, in words."""
        lifecycle = self._told.get("lifecycle")
        if lifecycle != "active":
            return f"{self._controller} is not active ({lifecycle or 'it tells nothing'})"
        if not self._publisher.get_subscription_count():
            return f"{self._controller} does not hear ~/relay"
        infos = self.get_subscriptions_info_by_topic(self._states.topic_name)
        if self._recorder not in {info.node_name for info in infos}:
            return "the recorder does not hear the states"
        return ""

    def _begin(self, now: float) -> None:
        self._refused = self._told.get("refused references", "")
        self._begun = self._heard = now
        self._status.send("begun")
        self._publisher.publish(Float64MultiArray(data=self._request))

    def _end(self, reason: str) -> None:
        if self._is_over:
            return
        self._is_over = True
        event = "stopped" if reason else "done"
        self._status.send(event, reason=reason, is_at_rest=True)
        if self._ending is not None:
            self._ending.set_result(None)
        self.request_stop(executor.FAILED if reason else 0)

    def wind_down(self) -> Future | None:
        """Have the relay give back, and wait until it has."""
        if self._begun is None or self._is_over:
            return None
        self._publisher.publish(Float64MultiArray())
        self._ending = Future()
        return self._ending


def main(args: Sequence[str] | None = None) -> int:
    """Run the tester."""
    return executor.run(lambda: [RelayTester()], args)


if __name__ == "__main__":
    sys.exit(main())
