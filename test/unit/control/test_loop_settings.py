"""Every set of parameters makes a loop, or is refused with a reason in one line."""

import math

import pytest
from harness.examples import examples
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, NormError
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings, WeightedNorm
from hpid_ros.control.assembly import (
    make_anti_windup,
    make_law,
    make_motion_limits,
    make_velocity_source,
)
from hpid_ros.control.norms import norm_floor

ANYWHERE = (
    0.0,
    -0.0,
    5e-324,
    1e-300,
    1e-12,
    1.0,
    math.nan,
    math.inf,
    1e300,
    3,
    10**400,
    True,
    None,
    "x",
)


def near(bound):
    """Return numbers at a bound and on either side of it, as close as may be and not so close."""
    steps = (bound, math.nextafter(bound, math.inf), math.nextafter(bound, -math.inf))
    return [*steps, *(bound + sign * 10.0**power for sign in (1, -1) for power in (-9, -3, 0))]


def values_of(spec):
    """Return a strategy of a parameter's values; most of them are allowed."""
    if isinstance(spec.default, bool):
        return st.sampled_from([True, False, True, False, 1.0, "true"])
    if isinstance(spec.default, str):
        texts = spec.choices or ("elbow", "", "\n")
        return st.sampled_from([*texts, *texts, "no such thing", 1.0])
    inside = st.floats(spec.minimum, spec.maximum)
    powers = st.floats(-12.0, math.log10(max(spec.maximum, 1e-6))).map(lambda power: 10.0**power)
    signed = powers if spec.minimum >= 0.0 else powers.flatmap(lambda x: st.sampled_from([x, -x]))
    within = signed.map(lambda x: min(max(x, spec.minimum), spec.maximum))
    at_bounds = st.sampled_from([*near(spec.minimum), *near(spec.maximum)])
    allowed = at_bounds.map(lambda x: min(max(x, spec.minimum), spec.maximum))
    usual = st.just(spec.default)
    rare = st.one_of(at_bounds, st.sampled_from(ANYWHERE))
    return st.one_of(usual, within, within, allowed, allowed, inside, inside, usual, rare)


SETS = st.fixed_dictionaries(
    {"joint": st.just("elbow")},
    optional={name: values_of(spec) for name, spec in LOOP_PARAMETERS.items() if name != "joint"},
)
LIKELY = st.fixed_dictionaries(  # what is seldom refused for one of many numbers
    {
        "joint": st.just("elbow"),
        "state_timeout": st.just(1.0),
        "control_period": st.floats(1e-6, 0.66),
        "mu": st.one_of(values_of(LOOP_PARAMETERS["mu"]), st.floats(-0.4999, 0.4999)),
        "gains.d": st.floats(-12.0, 6.0).map(lambda power: 10.0**power),
    },
    optional={
        name: values_of(LOOP_PARAMETERS[name])
        for name in LOOP_PARAMETERS
        if name.split(".")[0] in ("norm", "encoder_resolution", "discretization")
        or name == "velocity_filter_time_constant"
    },
)


TINY_SCALE = {"joint": "j", "norm.effort_scale": 5e-324, "gains.p": 1.0, "gains.d": 1.0}


@examples(4)
@given(st.one_of(SETS, LIKELY))
@example({"joint": "j", "mu": -0.001, "gains.d": 500.0})
@example(
    {"joint": "j", "mu": -1e-300, "gains.d": 1e6, "control_period": 0.5, "state_timeout": 1.0}
)
@example({"joint": "j", "mu": -5e-324, "gains.d": 1e6, "norm.type": "canonical"})
@example({"joint": "j", "mu": 0.3, "encoder_resolution": 1.0, "norm.rate_weight": 1e6})
@example(TINY_SCALE)
@example(TINY_SCALE | {"norm.type": "canonical"})
@example({"joint": "j", "encoder_wrap": 5e-324})
def test_a_set_is_taken_or_refused_with_a_reason(values):
    reason = ""
    try:
        loop = LoopSettings.from_parameters(values)
    except HpidError as error:
        reason = str(error)
        loop = None
    if loop is None:
        assert reason.strip()
        assert len(reason.splitlines()) == 1
        return
    law = make_law(loop)
    make_velocity_source(loop.velocity)
    make_anti_windup(loop)
    make_motion_limits(loop)
    for error, rate in ((0.0, 0.0), (1e-9, -1e-9), (1.0, 10.0)):
        assert math.isfinite(law.update(error, rate, loop.timing.control_period))


def test_a_floor_that_no_cap_leaves_room_for_is_refused_with_its_figures():
    figures = r"T kd / m = 0\.5 .* mu = -0\.001 .* 1\.07e\+301 .* 1e\+06"
    with pytest.raises(NormError, match=figures):
        LoopSettings.from_parameters({"joint": "j", "mu": -0.001, "gains.d": 500.0})
    with pytest.raises(NormError, match=r"encoder_resolution .* must lie below"):
        LoopSettings.from_parameters(
            {"joint": "j", "encoder_resolution": 1.0, "norm.rate_weight": 1e6}
        )


@pytest.mark.parametrize("degree", [-0.49, -0.2, -0.01])
@pytest.mark.parametrize("rate", [1.0, 100.0, 240.0])
def test_the_floor_keeps_the_sampled_gain_where_sampling_bears_it(degree, rate):
    norm = WeightedNorm(degree, 1.0, 0.1)
    floor = norm_floor(norm, period=1e-3, derivative_gain=rate)
    assert floor == pytest.approx(max(1e-6, (0.25 / (1e-3 * rate)) ** (1.0 / degree)), rel=1e-12)
    assert 1e-3 * rate * floor**degree <= 0.25 * (1.0 + 1e-9)


def test_a_floor_that_is_given_is_not_computed():
    values = {"joint": "j", "mu": -0.001, "gains.d": 500.0, "norm.floor": 0.01}
    assert make_law(LoopSettings.from_parameters(values)).norm_floor == 0.01
