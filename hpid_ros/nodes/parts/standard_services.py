"""The services of ``simulation_interfaces``, which other simulators have, too.

Source: the definitions of ``simulation_interfaces``, 2.1.0; run with 1.5.1, Jazzy's, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.parts.bridge_services import BridgeServices
from hpid_ros.simulation.world import World


def offer_standard_services(node: ClosingNode, simulation: BridgeServices, world: World) -> None:
    """Offer them where their package is installed; do nothing where it is not."""
    try:
        from simulation_interfaces import srv
    except ImportError:
        return
    services = _StandardServices(node, simulation, world)
    offered: dict[str, tuple[Any, Callable[[Any, Any], Any]]] = {
        "get_simulator_features": (srv.GetSimulatorFeatures, services.features),
        "get_simulation_state": (srv.GetSimulationState, services.state),
        "set_simulation_state": (srv.SetSimulationState, services.set_state),
        "reset_simulation": (srv.ResetSimulation, services.reset),
        "step_simulation": (srv.StepSimulation, services.step),
    }
    for name, (kind, callback) in offered.items():
        node.create_service(kind, f"~/{name}", callback)


class _StandardServices:
    """Answers the requests."""

    def __init__(self, node: ClosingNode, simulation: BridgeServices, world: World) -> None:
        from simulation_interfaces import msg, srv

        self._node, self._simulation, self._world = node, simulation, world
        self._state, self._result = msg.SimulationState, msg.Result
        self._features, self._setting = msg.SimulatorFeatures, srv.SetSimulationState.Response
        self._scopes = srv.ResetSimulation.Request

    def features(self, request: Any, response: Any) -> Any:
        """Answer ``GetSimulatorFeatures``."""
        known = self._features
        response.features.features = [
            *(known.SIMULATION_RESET, known.SIMULATION_RESET_TIME, known.SIMULATION_RESET_STATE),
            *(known.SIMULATION_STATE_GETTING, known.SIMULATION_STATE_SETTING),
            *(known.SIMULATION_STATE_PAUSE, known.STEP_SIMULATION_SINGLE),
        ]
        response.features.custom_info = (
            "one step is one control period; a reset is of time and state"
        )
        return response

    @property
    def _present(self) -> int:
        if not self._simulation.is_paused:
            return int(self._state.STATE_PLAYING)
        is_at_start = self._world.time_ns == 0
        return int(self._state.STATE_STOPPED if is_at_start else self._state.STATE_PAUSED)

    def state(self, request: Any, response: Any) -> Any:
        """Answer ``GetSimulationState``."""
        response.state.state = self._present
        return self._with(response, self._result.RESULT_OK)

    def set_state(self, request: Any, response: Any) -> Any:
        """Answer ``SetSimulationState``: stopped is paused at time zero."""
        wanted, state = request.state.state, self._state
        if wanted == self._present:
            return self._with(response, self._setting.ALREADY_IN_TARGET_STATE)
        if wanted == state.STATE_PLAYING:
            self._simulation.pause(False)
        elif wanted in (state.STATE_PAUSED, state.STATE_STOPPED):
            self._simulation.pause(True)
            if wanted == state.STATE_STOPPED:
                self._simulation.reset()
        elif wanted == state.STATE_QUITTING:
            self._node.request_stop()
        else:
            return self._with(
                response,
                self._result.RESULT_FEATURE_UNSUPPORTED,
                f"the state may be stopped (0), playing (1), paused (2) or quitting (3), "
                f"not {wanted}",
            )
        return self._with(response, self._result.RESULT_OK)

    def reset(self, request: Any, response: Any) -> Any:
        """Answer ``ResetSimulation``: time and state go back together."""
        both = self._scopes.SCOPE_TIME | self._scopes.SCOPE_STATE
        if request.scope != self._scopes.SCOPE_DEFAULT and request.scope & both != both:
            return self._with(
                response,
                self._result.RESULT_FEATURE_UNSUPPORTED,
                f"time and state are reset together, by scope 0, {both} or 255, "
                f"not {request.scope}",
            )
        self._simulation.reset()
        return self._with(response, self._result.RESULT_OK)

    def step(self, request: Any, response: Any) -> Any:
        """Answer ``StepSimulation``: one control period; in lock-step it waits for the answers."""
        if request.steps != 1:
            return self._with(
                response,
                self._result.RESULT_FEATURE_UNSUPPORTED,
                f"one step at a time, not {request.steps}",
            )
        if not self._simulation.step():
            return self._with(
                response, self._result.RESULT_OPERATION_FAILED, "the simulation is not paused"
            )
        return self._with(response, self._result.RESULT_OK)

    def _with(self, response: Any, result: int, line: str = "") -> Any:
        response.result.result, response.result.error_message = int(result), line
        return response
