"""Settings of a loop: records, round trips, sets that are refused, and a scale in effort."""

import math
from dataclasses import fields, is_dataclass, replace
from typing import get_type_hints

import pytest
from harness.examples import examples
from harness.loops import IN_EFFORT, OTHER_VALUES, STOPS, TURNS, loop_settings
from hypothesis import example, given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, HpidError, NormError, SettingError
from hpid_ros.base.records import record_fields, to_parameters
from hpid_ros.control import LOOP_PARAMETERS, Gains, LoopSettings
from hpid_ros.control.assembly import (
    make_anti_windup,
    make_law,
    make_motion_limits,
    make_velocity_source,
)
from hpid_ros.control.homogeneous_pid import SemiImplicitHomogeneousPid
from hpid_ros.control.model import ModelSettings
from hpid_ros.control.norms import NORMS
from hpid_ros.control.settings import (
    MODEL_PARAMETERS,
    PARAMETERS,
    EffortLimits,
    FeedforwardSettings,
    IntegralLimits,
    MotionSettings,
    NormSettings,
    ObserverSettings,
    SoftStop,
    Timing,
)
from hpid_ros.stability.gain_check import kind_of

SCALES = ("norm.error_scale", "norm.rate_weight")
GROUPS = [
    NormSettings,
    EffortLimits,
    IntegralLimits,
    MotionSettings,
    SoftStop,
    Timing,
    ObserverSettings,
    FeedforwardSettings,
    ModelSettings,
]


NORM_TYPES = st.sampled_from([*NORMS])
GAINS = {"gains.p": 21.0, "gains.i": 52.5, "gains.d": 2.1}
SCALED = {**GAINS, "mu": -0.3, "norm.effort_scale": 3.0, "norm.floor": 0.0}
scales = st.floats(1e-2, 1e2)
errors = st.floats(-10.0, 10.0)


def leaves(kind):
    """Yield the type of every field that is no record itself."""
    hints = get_type_hints(kind)
    for each in fields(kind):
        if is_dataclass(hints[each.name]):
            yield from leaves(hints[each.name])
        else:
            yield hints[each.name]


def test_the_settings_hold_each_parameter_once_with_the_tables_default():
    plain = loop_settings(joint="j")
    held = to_parameters(plain)
    assert list(held) == list(PARAMETERS)
    assert len(list(leaves(LoopSettings))) == len(PARAMETERS)
    assert held == {name: spec.default for name, spec in PARAMETERS.items()} | {"joint": "j"}
    assert plain == LoopSettings("j", Gains(0.0, 0.0, 0.0))


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_has_a_place_of_its_own(name):
    """It can be changed alone, nothing else changes with it, and it comes back."""
    value = {**OTHER_VALUES, **STOPS, **TURNS, **IN_EFFORT}[name]
    assert value != PARAMETERS[name].default
    beside = {"inertia": 0.2, "gains.p": 20.0, "gains.d": 3.0} | (
        {"model.left_wheel": "L", "model.right_wheel": "R"} if "wheel" in name else {}
    )
    before = LoopSettings.from_parameters({"joint": "j", **beside})
    after = before.with_parameters({name: value})
    assert to_parameters(after) == to_parameters(before) | {name: value}
    assert after == LoopSettings.from_parameters(to_parameters(after))


def test_all_parameters_together_survive_the_round_trip():
    own_scales = {name: PARAMETERS[name].default for name in SCALES}
    for values in (
        {**OTHER_VALUES, **IN_EFFORT, **own_scales},
        {**OTHER_VALUES, **STOPS, **TURNS, "angle_wraparound": False},
        OTHER_VALUES,
    ):
        found = LoopSettings.from_parameters(values)
        assert found.to_parameters() == {**to_parameters(loop_settings()), **values}
        assert LoopSettings.from_parameters(found.to_parameters()) == found
    assert set(loop_settings().to_parameters()) == set(LOOP_PARAMETERS)
    assert set(found.to_parameters()) == set(LOOP_PARAMETERS) | set(MODEL_PARAMETERS)


@pytest.mark.parametrize("kind", GROUPS)
def test_a_group_made_in_python_names_the_parameter_that_it_refuses(kind):
    for each in record_fields(kind):
        if is_dataclass(each.kind):
            continue
        spec = PARAMETERS[each.name]
        bad = [math.nan, math.inf, "x", True, None] if isinstance(spec.default, float) else [7.0]
        for value in bad:
            with pytest.raises(SettingError, match=rf"^{spec.name} must "):
                kind(**{each.path: value})


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"gain.p": 1.0}, SettingError, "did you mean 'gains.p'"),
        ({"norm.scale": 1.0}, SettingError, "unknown parameter 'norm.scale'; did you mean 'norm."),
        ({"mu": 0.5}, NormError, r"\(-0.5, 0.5\), not 0.5"),
        ({"mu": "much"}, SettingError, "mu must be a number, not 'much'"),
        ({"mu": True}, SettingError, "mu must be a number, not True"),
        ({"gains.p": math.nan}, SettingError, "gains.p must lie in"),
        ({"gains.i": -1.0}, SettingError, "gains.i must lie in"),
        ({"law": "PID"}, SettingError, "law must be one of hpid, pid, not 'PID'"),
        ({"joint": ""}, SettingError, "must name the joint"),
        ({"state_timeout": 1000.0}, SettingError, r"state_timeout must lie in \[1e-06, 1\]"),
        ({"control_period": 0.1}, SettingError, "^state_timeout = 0.1 s must be at least 1.5 tim"),
        ({"u_clamp_min": 2.0, "u_clamp_max": 1.0}, SettingError, "^u_clamp_min = 2.0 must not ex"),
        ({"i_clamp_min": 2.0, "i_clamp_max": 1.0}, SettingError, "^i_clamp_min = 2.0 must not ex"),
        ({"position_min": 2.0, "position_max": 1.0}, SettingError, "^position_min = 2.0 must not"),
        ({"position_max": 1.0, "angle_wraparound": True}, SettingError, "lead through a stop"),
        ({"angle_wraparound": True, "multi_turn": True}, SettingError, "set one of them"),
        ({"discretization": "semi_implicit"}, SettingError, "needs the inertia"),
        ({"model.left_wheel": "l"}, SettingError, "needs model.left_wheel and model.right_wheel"),
        (
            {"gains.p": 1.0, "gains.d": 1.0, "gains.i": 3.0, "inertia": 0.5},
            GainError,
            "p d = 1 must exceed i x inertia = 1.5",
        ),
        (
            {"mu": -0.001, "gains.d": 500.0},
            NormError,
            r"T kd / m = 0\.5 .* mu = -0\.001 .* 1\.07e\+301 .* 1e\+06",
        ),
        (
            {"encoder_resolution": 1.0, "norm.rate_weight": 1e6},
            NormError,
            "encoder_resolution .* must lie below",
        ),
        *(
            (SCALED | change, SettingError, message)
            for change, message in (
                ({"norm.error_scale": 0.3}, "norm.error_scale, which must stay at its default 1,"),
                ({"norm.rate_weight": 0.2}, "norm.rate_weight, which must stay at its default"),
                ({"gains.d": 0.0, "gains.i": 0.0}, "neither may be 0, as of 21 and 0"),
                ({"norm.effort_scale": math.inf}, "norm.effort_scale must"),
                ({"norm.effort_scale": -1.0}, r"\[0, 1e\+06\], not -1"),
            )
        ),
        ({"compensation": "decoupling", "feedforward.inertia": 0.5}, SettingError, "must be 0 wi"),
        ({"feedforward.inertia": -1.0}, SettingError, "takes the parameter inertia, which is unk"),
    ],
)
def test_a_set_that_cannot_be_is_refused_in_one_line_however_it_is_given(change, error, message):
    for make in (
        lambda: make_law(LoopSettings.from_parameters({"joint": "j", **change})),
        lambda: make_law(loop_settings().with_parameters(change)),
    ):
        with pytest.raises(error, match=message) as refusal:
            make()
        assert isinstance(refusal.value, HpidError)
        assert isinstance(refusal.value, ValueError)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("law", ["pid", "hpid"])
def test_the_semi_implicit_step_is_that_of_the_joints_inertia(law):
    gains = {"gains": Gains(9.0, 1.0, 9.0), "inertia": 0.7}
    changes = {"law": law, "mu": -0.1, "discretization": "semi_implicit", **gains}
    made = make_law(loop_settings(**changes))
    assert type(made) is SemiImplicitHomogeneousPid
    assert (made.inertia, made.norm.degree) == (0.7, -0.1 if law == "hpid" else 0.0)


@pytest.mark.parametrize(
    ("changes", "warns"),
    [
        ({}, True),
        ({"inertia": 0.1}, False),
        ({"mu": 0.1}, False),
        ({"law": "pid"}, False),
        ({"norm__floor": 0.1}, False),
    ],
)
def test_a_floor_that_rests_on_an_unknown_inertia_is_warned_of(changes, warns):
    values = {"gains__p": 40.0, "gains__d": 4.0, "mu": -0.2, **changes}
    assert bool(loop_settings(**values).floor_warning) == warns


def test_settings_are_not_changed_by_changing_them():
    settings = loop_settings(norm__error_scale=0.5)
    assert settings.norm_floor == settings.norm_floor
    changed = settings.with_parameters({"norm.floor": 0.25})
    assert (settings.norm.floor, changed.norm.floor, changed.norm_floor) == (-1.0, 0.25, 0.25)
    assert make_law(changed).norm_floor == 0.25  # given, not computed
    assert settings == loop_settings(norm__error_scale=0.5)
    assert hash(settings) == hash(replace(changed, norm=NormSettings(error_scale=0.5)))


ANYWHERE = [0.0, -0.0, 5e-324, 1e-300, 1e-12, 1.0, math.nan, math.inf, 1e300, 3, 10**400]
ANYWHERE += [True, None, "x"]


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
    if reason:
        assert len(reason.strip().splitlines()) == 1
        return
    law = make_law(loop)
    make_velocity_source(loop.velocity)
    make_anti_windup(loop)
    make_motion_limits(loop)
    for error, rate in ((0.0, 0.0), (1e-9, -1e-9), (1.0, 10.0)):
        assert math.isfinite(law.update(error, rate, loop.timing.control_period))


def scaled(**changes):
    return loop_settings(**{k.replace(".", "__"): v for k, v in SCALED.items()} | changes)


def simc(inertia, time):
    """Return the gains of SIMC's rule for a double integrator."""
    return {
        "gains__p": inertia / (2.0 * time**2),
        "gains__i": inertia / (16.0 * time**3),
        "gains__d": inertia / time,
    }


@given(NORM_TYPES, scales, st.floats(-0.45, 0.45))
def test_the_norm_is_1_where_either_term_of_the_pid_is_the_scale(norm_type, scale, mu):
    norm = scaled(norm__type=norm_type, norm__effort_scale=scale).norm_family(mu)
    assert norm(scale / GAINS["gains.p"], 0.0) == pytest.approx(1.0, rel=1e-12)
    assert norm(0.0, -scale / GAINS["gains.d"]) == pytest.approx(1.0, rel=1e-12)


@given(NORM_TYPES, errors, errors, scales, scales, st.floats(-0.45, 0.45))
def test_laws_that_differ_by_their_units_of_effort_are_one(norm_type, e, de, scale, unit, mu):
    """Gains and scale in other units of effort: the same multiplier, so the effort in the unit."""
    law = make_law(scaled(norm__type=norm_type, norm__effort_scale=scale, mu=mu))
    gains = {name.replace(".", "__"): unit * value for name, value in GAINS.items()}
    other = make_law(scaled(norm__type=norm_type, norm__effort_scale=unit * scale, mu=mu, **gains))
    effort = law.update(e, de, 0.001)
    assert other.update(e, de, 0.001) == pytest.approx(unit * effort, rel=1e-9, abs=1e-12)


@given(NORM_TYPES, scales, st.floats(1e-3, 10.0), st.floats(0.02, 0.5))
def test_joints_tuned_by_one_rule_share_a_certificate_whatever_the_scale(
    norm_type, scale, inertia, time
):
    """rho and kd / kp in the loop's own time say it all: the scale in N m is not among them."""
    one = scaled(norm__type=norm_type, norm__effort_scale=scale, **simc(inertia, time))
    other = scaled(norm__type=norm_type, **simc(0.105, 0.05))
    kinds = kind_of(one, (inertia, inertia)), kind_of(other, (0.105, 0.105))
    first, second = ((k.p, k.d, k.least_inertia, k.rate_weight) for k in kinds)
    assert first == pytest.approx(second, rel=1e-9)
    damped = kind_of(scaled(norm__type=norm_type, gains__d=2.5), (0.1, 0.1))
    assert damped.rate_weight != pytest.approx(kinds[1].rate_weight)


def test_a_gain_that_changes_keeps_the_scale():
    changed = scaled().with_parameters({"gains.p": 42.0, "gains.d": 4.2})
    assert changed.norm_family.error_scale == 3.0 / 42.0
    assert changed.norm_family.rate_weight == 4.2 / 3.0
    assert changed.norm.effort_scale == 3.0
    off = scaled(norm__effort_scale=0.0, norm__error_scale=0.3, norm__rate_weight=0.2)
    assert (off.norm_family.error_scale, off.norm_family.rate_weight) == (0.3, 0.2)


def test_with_decoupling_the_scale_is_still_an_effort():
    """There the gains are accelerations: the joint's inertia makes efforts of them."""
    loop = scaled(compensation="decoupling", **simc(1.0, 0.05), inertia=0.105)
    assert loop.norm_family.error_scale == pytest.approx(3.0 / (0.105 * loop.gains.p))
    with pytest.raises(SettingError, match="needs the inertia"):
        make_law(loop.with_parameters({"inertia": 0.0}))
