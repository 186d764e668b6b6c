"""The bridge's answers to simulation_interfaces, with messages that stand in for its own."""

from types import SimpleNamespace

import pytest

from hpid_ros.nodes.parts.bridge_services import StandardServices

# The numbers are those of simulation_interfaces 2.1.0.
STATES = SimpleNamespace(
    STATE_STOPPED=0, STATE_PLAYING=1, STATE_PAUSED=2, STATE_QUITTING=3, STATE_LOADING=4
)
RESULTS = SimpleNamespace(RESULT_FEATURE_UNSUPPORTED=0, RESULT_OK=1, RESULT_OPERATION_FAILED=4)
FEATURES = SimpleNamespace(
    SIMULATION_RESET=30,
    SIMULATION_RESET_TIME=31,
    SIMULATION_RESET_STATE=32,
    SIMULATION_STATE_GETTING=40,
    SIMULATION_STATE_SETTING=41,
    SIMULATION_STATE_PAUSE=42,
    STEP_SIMULATION_SINGLE=50,
)
MSG = SimpleNamespace(SimulationState=STATES, Result=RESULTS, SimulatorFeatures=FEATURES)
ALREADY = 101
SRV = SimpleNamespace(
    SetSimulationState=SimpleNamespace(Response=SimpleNamespace(ALREADY_IN_TARGET_STATE=ALREADY)),
    ResetSimulation=SimpleNamespace(
        Request=SimpleNamespace(SCOPE_DEFAULT=0, SCOPE_TIME=1, SCOPE_STATE=2)
    ),
)


class Simulation:
    def __init__(self, world):
        self.world, self.is_paused, self.steps = world, False, 0

    def pause(self, is_paused):
        self.is_paused = is_paused

    def step(self):
        self.steps += self.is_paused
        return self.is_paused

    def reset(self):
        self.world.time_ns = 0


class Bridge:
    def __init__(self):
        self.world = SimpleNamespace(time_ns=7)
        self.simulation = Simulation(self.world)
        self.stops = 0
        self.services = StandardServices(self, self.simulation, self.world, MSG, SRV)

    def request_stop(self):
        self.stops += 1

    def ask(self, service, **request):
        response = SimpleNamespace(
            result=SimpleNamespace(result=None, error_message=None),
            state=SimpleNamespace(state=None),
            features=SimpleNamespace(features=(), custom_info=""),
        )
        return getattr(self.services, service)(SimpleNamespace(**request), response)

    def set_state(self, state):
        return self.ask("set_state", state=SimpleNamespace(state=state)).result

    def state(self):
        return self.ask("state").state.state


@pytest.fixture
def bridge():
    return Bridge()


def test_a_state_that_is_set_is_the_one_that_is_got(bridge):
    assert bridge.state() == STATES.STATE_PLAYING
    for state in (STATES.STATE_PAUSED, STATES.STATE_PLAYING, STATES.STATE_STOPPED):
        assert bridge.set_state(state).result == RESULTS.RESULT_OK
        assert bridge.state() == state
        assert bridge.set_state(state).result == ALREADY
    assert bridge.world.time_ns == 0
    assert not bridge.stops


def test_quitting_ends_the_process_and_other_states_are_refused(bridge):
    assert bridge.set_state(STATES.STATE_QUITTING).result == RESULTS.RESULT_OK
    assert bridge.stops == 1
    found = bridge.set_state(STATES.STATE_LOADING)
    assert found.result == RESULTS.RESULT_FEATURE_UNSUPPORTED
    assert "not 4" in found.error_message


@pytest.mark.parametrize(("scope", "is_reset"), [(0, True), (3, True), (255, True), (1, False)])
def test_time_and_state_are_reset_together(bridge, scope, is_reset):
    found = bridge.ask("reset", scope=scope).result
    assert (found.result == RESULTS.RESULT_OK) is is_reset
    assert (bridge.world.time_ns == 0) is is_reset


def test_one_step_of_a_paused_simulation_at_a_time(bridge):
    assert bridge.ask("step", steps=1).result.result == RESULTS.RESULT_OPERATION_FAILED
    bridge.simulation.pause(True)
    assert bridge.ask("step", steps=2).result.result == RESULTS.RESULT_FEATURE_UNSUPPORTED
    assert bridge.simulation.steps == 0
    assert bridge.ask("step", steps=1).result.result == RESULTS.RESULT_OK
    assert bridge.simulation.steps == 1


def test_what_is_offered_is_said(bridge):
    offered = bridge.ask("features").features
    assert set(offered.features) == set(vars(FEATURES).values())
