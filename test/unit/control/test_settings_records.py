"""The records of parameters: nothing of the tables is missing, and each record checks itself."""

import math
from dataclasses import fields, is_dataclass, replace
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from harness.loops import loop_settings

from hpid_ros.base.errors import SettingError
from hpid_ros.base.records import record_fields, to_parameters
from hpid_ros.control import LOOP_PARAMETERS, Gains, LoopSettings
from hpid_ros.control.settings import (
    MODEL_PARAMETERS,
    PARAMETERS,
    EffortLimits,
    FeedforwardSettings,
    IntegralLimits,
    ModelSettings,
    MotionSettings,
    NormSettings,
    ObserverSettings,
    SoftStop,
    Timing,
)

# Another value of each parameter, all of them possible together.
OTHERS = {
    **{"joint": "k", "law": "pid", "gains.p": 30.0, "gains.i": 4.0, "gains.d": 5.0, "mu": 0.1},
    **{"norm.type": "canonical", "norm.error_scale": 0.3, "norm.rate_weight": 0.2},
    **{"norm.floor": 0.01, "norm.cap": 50.0, "u_clamp_max": 9.0, "u_clamp_min": -8.0},
    **{"i_clamp_max": 7.0, "i_clamp_min": -6.0, "antiwindup_strategy": "back_calculation"},
    **{"tracking_time_constant": 0.4, "velocity_source": "homogeneous_differentiator"},
    **{"velocity_filter_time_constant": 0.01, "acceleration_bound": 40.0},
    **{"discretization": "semi_implicit", "encoder_wrap": 6.28, "angle_wraparound": True},
    **{"position_step_max": 0.2, "effort_rate_max": 300.0, "velocity_max": 3.0},
    **{"soft_stop.margin": 0.1, "soft_stop.k_position": 4.0, "soft_stop.k_velocity": 3.0},
    **{"takeover_time": 0.3, "fallback_effort": 1.0, "state_timeout": 0.2},
    **{"state_clock": "simulated", "control_period": 0.002, "encoder_resolution": 1e-4},
    **{"inertia": 0.2, "compensation": "gravity", "model.description": "arm.urdf"},
    **{"model.payload": 2.0, "model.payload_link": "hook", "model.mass_scale": 1.1},
    **{"model.locked_joints": "a,b", "model.left_wheel": "l", "model.right_wheel": "r"},
    **{"model.wheel_radius": 0.1, "model.wheel_separation": 0.4},
    **{"observer.bandwidth": 90.0, "observer.degree": -0.1},
    **{"observer.innovation_scale": 1e-3, "observer.feed_disturbance": True},
    **{"feedforward.inertia": 0.4, "feedforward.viscous_friction": 0.1},
    **{"feedforward.coulomb_friction": 0.5, "feedforward.friction_velocity": 0.02},
    **{"feedforward.trajectory_effort": False, "model.effort_filter_time_constant": 0.02},
}
IN_EFFORT = {"norm.effort_scale": 3.0}  # not beside scales of the joint's own
STOPS = {"position_max": 2.0, "position_min": -3.0}  # not where angles wrap around
TURNS = {"multi_turn": True}  # nor this
SCALES = ("norm.error_scale", "norm.rate_weight")
GROUPS = [
    *(NormSettings, EffortLimits, IntegralLimits, MotionSettings, SoftStop, Timing),
    *(ObserverSettings, FeedforwardSettings, ModelSettings),
]


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


def test_every_choice_of_a_parameter_is_one_of_its_fields_and_the_other_way_round():
    typed = [get_args(kind) for kind in leaves(LoopSettings) if get_origin(kind) is Literal]
    choices = [spec.choices for spec in PARAMETERS.values() if spec.choices]
    assert len(choices) == 7
    assert sorted(typed) == sorted(choices)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_has_a_place_of_its_own(name):
    """It can be changed alone, nothing else changes with it, and it comes back."""
    value = {**OTHERS, **STOPS, **TURNS, **IN_EFFORT}[name]
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
        {**OTHERS, **IN_EFFORT, **own_scales},
        {**OTHERS, **STOPS, **TURNS, "angle_wraparound": False},
        OTHERS,
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
        spec = PARAMETERS[each.key]
        bad = [math.nan, math.inf, "x", True, None] if isinstance(spec.default, float) else [7.0]
        for value in bad:
            with pytest.raises(SettingError, match=rf"^{spec.name} must "):
                kind(**{each.name: value})


def test_whole_numbers_become_floats():
    assert type(Timing(takeover_time=1).takeover_time) is float
    whole = loop_settings(gains__p=3, norm__cap=2)
    assert whole == loop_settings(gains__p=3.0, norm__cap=2.0)
    assert type(whole.gains.p) is float


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"u_clamp_min": 2.0, "u_clamp_max": 1.0},
            r"^u_clamp_min = 2.0 must not exceed u_c",
        ),
        (
            {"i_clamp_min": 2.0, "i_clamp_max": 1.0},
            r"^i_clamp_min = 2.0 must not exceed i_c",
        ),
        ({"position_min": 2.0, "position_max": 1.0}, r"^position_min = 2.0 must not exceed posit"),
        ({"position_max": 1.0, "angle_wraparound": True}, "^angle_wraparound takes the shorter"),
        ({"angle_wraparound": True, "multi_turn": True}, "^angle_wraparound takes the shorter"),
        ({"control_period": 0.1}, "^state_timeout = 0.1 s must be at least 1.5 times"),
        ({"discretization": "semi_implicit"}, "needs the inertia"),
        ({"model.left_wheel": "l"}, "needs model.left_wheel and model.right_wheel"),
        ({"norm.scale": 1.0}, "unknown parameter 'norm.scale'; did you mean 'norm."),
    ],
)
def test_what_does_not_go_together_is_refused_however_it_is_said(change, message):
    with pytest.raises(SettingError, match=message):
        LoopSettings.from_parameters({"joint": "j", **change})
    with pytest.raises(SettingError, match=message):
        loop_settings().with_parameters(change)


def test_settings_are_not_changed_by_changing_them():
    settings = loop_settings(norm__error_scale=0.5)
    assert settings.norm_floor == settings.norm_floor
    changed = settings.with_parameters({"norm.floor": 0.25})
    assert (settings.norm.floor, changed.norm.floor, changed.norm_floor) == (-1.0, 0.25, 0.25)
    assert settings == loop_settings(norm__error_scale=0.5)
    assert hash(settings) == hash(replace(changed, norm=NormSettings(error_scale=0.5)))
