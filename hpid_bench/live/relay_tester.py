"""Asks a joint's controller for a relay, and tells how it goes; the relay ends by itself."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray

from hpid_bench.live.exciter import MovingNode
from hpid_ros.base.names import ALLOW_RELAY
from hpid_ros.control.overrides import CYCLES_DONE
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.middleware import RARE

_ANSWERS_WITHIN = 3.0  # [s]; a controller tells how it is once a second
_TAKEN_BACK_WITHIN = 1.0  # [s]
_IN_FORCE = "; in force"


class RelayTester(MovingNode):
    """Allows relays, asks for one, listens to how it goes, and forbids them again."""

    def __init__(self) -> None:
        super().__init__("hpid_relay_tester")
        self._controller = str(self.order["controller"])
        self._publisher = self.create_publisher(
            Float64MultiArray, f"{self._controller}/relay", RARE
        )
        self._setter = self.create_client(SetParameters, f"{self._controller}/set_parameters")
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RARE)
        self._told: dict[str, str] = {}
        self._refused = ""
        self._heard = 0.0
        self._begun: float | None = None
        self._was_in_force = self._is_over = False
        self._allowed: Future | None = None
        self._code, self._leave_at = 0, 0.0
        self._left = Future()

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
            ending = relay.rpartition(";")[0] or f"{self._controller} knows of no relay any more"
            self._end("" if ending == CYCLES_DONE else ending)
        elif self._told.get("refused references") != self._refused:
            self._end(self._told.get("last fault", "the relay was refused"))

    def look(self) -> None:
        """Ask for the relay when all is ready; look for its end, and for silence."""
        now = time.monotonic()
        if self._is_over:
            if now > self._leave_at:
                self._leave()
        elif self._begun is None:
            if self.is_ready() and self._allowed is None:
                self._allowed = self._allow(is_allowed=True)
                self._allowed.add_done_callback(self._begin)
        elif now - self._heard > _ANSWERS_WITHIN:
            self._end(f"{self._controller} has told nothing for {_ANSWERS_WITHIN:g} s")
        else:
            self.status.send("at", seconds=now - self._begun)

    def lacking(self) -> str:
        """Return what is missing before the relay may begin."""
        lifecycle = self._told.get("lifecycle")
        if lifecycle != "active":
            return f"{self._controller} is not active ({lifecycle or 'it tells nothing'})"
        if not self._publisher.get_subscription_count():
            return f"{self._controller} does not hear ~/relay"
        if not self._setter.service_is_ready():
            return f"{self._controller} does not take parameters"
        if self._allowed is not None:
            return f"{self._controller} has not answered {ALLOW_RELAY}"
        return super().lacking()

    def fail(self, reason: str) -> None:
        self.status.send("failed", reason=reason)
        self._finish(executor.FAILED)

    def _allow(self, *, is_allowed: bool) -> Future:
        """Set the parameter that lets ``~/relay`` in."""
        parameter = Parameter(ALLOW_RELAY, value=is_allowed).to_parameter_msg()
        return self._setter.call_async(SetParameters.Request(parameters=[parameter]))

    def _begin(self, allowed: Future) -> None:
        if self._is_over:
            return
        (result,) = allowed.result().results
        if not result.successful:
            self.fail(f"{self._controller}: {result.reason}")
            return
        now = time.monotonic()
        self._refused = self._told.get("refused references", "")
        self._begun = self._heard = now
        self.status.send("begun")
        self._publisher.publish(
            Float64MultiArray(data=[float(each) for each in self.order["request"]])
        )

    def _end(self, reason: str) -> None:
        if self._is_over:
            return
        event = "stopped" if reason else "done"
        self.status.send(event, reason=reason, is_at_rest=True)
        self._finish(executor.FAILED if reason else 0)

    def _finish(self, code: int) -> None:
        """Take the permission back, if it was asked for, and leave."""
        self._is_over, self._code = True, code
        self._leave_at = time.monotonic() + _TAKEN_BACK_WITHIN
        if self._allowed is None:
            self._leave()
        else:
            self._allow(is_allowed=False).add_done_callback(lambda _: self._leave())

    def _leave(self) -> None:
        if not self._left.done():
            self._left.set_result(None)
            self.request_stop(self._code)

    def begin_stop(self) -> Future | None:
        """Have the relay give back, wait until it has, and forbid relays again."""
        if self._begun is not None and not self._is_over:
            self._publisher.publish(Float64MultiArray())
        elif not self._is_over:
            self._finish(executor.FAILED)
        return self._left


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [RelayTester()], args)


if __name__ == "__main__":
    sys.exit(main())
