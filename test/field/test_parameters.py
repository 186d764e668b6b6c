"""What people reported of parameters, tried on one real controller."""

import math

import pytest
from harness.graph import NAME
from harness.loops import pure_loop
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter

MS = 1_000_000
WHOLE = {"gains__p": 10, "gains__i": 4, "gains__d": 2, "u_clamp_max": 50, "u_clamp_min": -50}
LARGEST = 1.7976931348623157e308


@pytest.fixture(scope="module")
def controller(module_harness):
    """Return a harness with a controller that was given integers for all its doubles."""
    module_harness.start_controller(law="pid", **WHOLE)
    module_harness.stamps = iter(range(MS, 10**12, MS))
    module_harness.twin = pure_loop(law="pid", state_clock="simulated", **WHOLE)
    yield module_harness
    # Whatever was refused: the node is what its loop is.
    require_the_twins_answers(module_harness)


def require_the_twins_answers(harness):
    for place in (0.1, 0.2, 0.15):
        stamp_ns = next(harness.stamps)
        assert harness.ask(stamp_ns, place) == harness.twin.step(stamp_ns, place, 0.0)


def values_of(harness, names):
    request = GetParameters.Request(names=names)
    return harness.call(GetParameters, f"{NAME}/get_parameters", request).values


def test_integers_that_were_given_at_the_start_are_the_doubles_that_were_meant(controller):
    names = [name.replace("__", ".") for name in WHOLE]
    found = values_of(controller, names)
    assert {each.type for each in found} == {ParameterType.PARAMETER_DOUBLE}
    assert [each.double_value for each in found] == [float(value) for value in WHOLE.values()]
    require_the_twins_answers(controller)


@pytest.mark.parametrize("atomically", [True, False])
@pytest.mark.parametrize(("name", "value"), [("gains__p", 20), ("gains__i", 0), ("mu", 0)])
def test_an_integer_that_is_set_for_a_double_is_a_double(controller, atomically, name, value):
    name = name.replace("__", ".")
    assert controller.set_parameters(NAME, atomically, **{name: value}) == (True, "")
    (found,) = values_of(controller, [name])
    assert (found.type, found.double_value) == (ParameterType.PARAMETER_DOUBLE, float(value))
    controller.twin.retune(controller.twin.settings.with_parameters({name: float(value)}))
    require_the_twins_answers(controller)


def test_a_number_in_quotes_is_the_number(controller):
    """As launch files and command lines give it."""
    assert controller.set_parameters(NAME, **{"gains.d": "2.50"}) == (True, "")
    (found,) = values_of(controller, ["gains.d"])
    assert (found.type, found.double_value) == (ParameterType.PARAMETER_DOUBLE, 2.5)
    controller.twin.retune(controller.twin.settings.with_parameters({"gains.d": 2.5}))
    require_the_twins_answers(controller)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(
            (name, value)
            for name in ("mu", "gains.p", "velocity_max", "observer.degree")
            for value in (math.nan, math.inf, -math.inf, -2)
        ),
        *(("gains.d", value) for value in ("two", "2,0", True, [2.0], [2])),
        *(("angle_wraparound", value) for value in (1, 1.0, "yes", "true")),
        *(("law", value) for value in (True, 0, "PID")),
        ("gains.d", 10**15),
        ("gain.d", 2.0),
        ("gains", 2.0),
        ("gains.D", 2.0),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_reason_in_one_line(controller, name, value):
    for atomically in (True, False):
        is_set, reason = controller.set_parameters(NAME, atomically, **{name: value})
        assert not is_set
        assert name in reason
        assert "\n" not in reason
    require_the_twins_answers(controller)


def test_of_several_parameters_in_one_request_all_are_set_or_none(controller):
    """A request is one set of gains: half of it may be a loop that nobody meant."""
    for wrong in (("gains.p", math.nan), ("gains.x", 1.0), ("gains.i", "much")):
        wanted = [("gains.d", 3.0), wrong, ("u_clamp_max", 40.0)]
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in wanted]
        )
        answer = controller.call(SetParameters, f"{NAME}/set_parameters", request)
        assert [each.successful for each in answer.results] == [False] * 3
        assert wrong[0] in answer.results[1].reason
        require_the_twins_answers(controller)


def test_every_double_of_a_dump_can_be_put_into_a_message_again(controller):
    listed = controller.call(ListParameters, f"{NAME}/list_parameters", ListParameters.Request())
    names = list(listed.result.names)
    found = values_of(controller, names)
    doubles = {
        name: each.double_value
        for name, each in zip(names, found, strict=True)
        if each.type == ParameterType.PARAMETER_DOUBLE
    }
    assert len(doubles) > 40
    assert all(-LARGEST <= value <= LARGEST for value in doubles.values())
