"""The pure loop with a model's term: units, limits, anti-windup, takeover."""

import math
import re

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.cli.main import main
from hpid_bench.experiment.batch import TOTAL, RunTask, WorldKeeper, simulated
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import controllers_document
from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.base.resources import share_folder
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.assembly import soft_stop_gains
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot
from hpid_ros.stability.gain_check import check_gains, judged_inertia

MS = 1_000_000
SECOND = 1000 * MS
UNIT = {"gains.p": 300.0, "gains.i": 1000.0, "gains.d": 30.0}


def loop(**values):
    parameters = {"joint": "j", "law": "pid", **UNIT, **values}
    return JointLoop(LoopSettings.from_parameters(parameters))


def decoupled(**values):
    return loop(compensation="decoupling", **values)


def test_the_effort_is_the_models_plus_the_gain_times_law_and_acceleration():
    knots = (Knot(0, 0.05, 0.0, 0.0), Knot(SECOND, 1.0, 0.0, 0.0))
    for follows in (False, True):
        ours, law = decoupled(), loop(inertia=1.0)
        for each in (ours, law):
            each.follow(Column("j", knots))
        for k in range(300):
            term = ModelTerm(0.4, 7.0 - 0.01 * k, follows)
            effort = ours.step(k * MS, 0.05, 0.1, term)
            alone = law.step(k * MS, 0.05, 0.1)
            acceleration = Column("j", knots).start(0, 0.0).sample(k * MS)[2]
            expected = 0.4 * (alone + follows * acceleration) + term.effort
            assert effort == pytest.approx(expected, rel=1e-12)
            assert sum(ours.law.terms) + ours.law.model_effort == pytest.approx(effort, rel=1e-12)
            assert sum(ours.law.terms) == pytest.approx(0.4 * alone, rel=1e-12)
        assert abs(acceleration) > 1.0
        assert ours.law.model_effort == term.effort + follows * 0.4 * acceleration


@pytest.mark.parametrize("strategy", ["none", "conditional_integration", "back_calculation"])
@pytest.mark.parametrize("law", ["pid", "hpid"])
@given(
    gain=st.floats(0.01, 20.0),
    positions=st.lists(st.floats(-1.0, 1.0), min_size=20, max_size=60),
    limit=st.floats(1.0, 200.0),
)
def test_gains_per_inertia_times_the_inertia_are_the_gains(strategy, law, gain, positions, limit):
    """Integral, anti-windup and clamps are consistent: only the units of the law differ."""
    common = {
        "law": law,
        "mu": -0.2,
        "antiwindup_strategy": strategy,
        "u_clamp_max": limit,
        "u_clamp_min": -0.7 * limit,
        "norm.floor": 0.0,
        "tracking_time_constant": 0.05,
    }
    plain = loop(**common, i_clamp_max=0.5 * limit, i_clamp_min=-0.5 * limit)
    per_inertia = {name: value / gain for name, value in UNIT.items()}
    clamps = {"i_clamp_max": 0.5 * limit / gain, "i_clamp_min": -0.5 * limit / gain}
    # Gravity's units with a gain: Hurwitz on inertia 1 does not hold for every gain drawn.
    scaled = loop(**{**common, **per_inertia, **clamps})
    for k, position in enumerate(positions):
        expected = plain.step(k * MS, position, 0.0)
        assert scaled.step(k * MS, position, 0.0, ModelTerm(gain, 0.0)) == pytest.approx(
            expected, rel=1e-6, abs=1e-6 * limit
        )
        assert scaled.law.integral == pytest.approx(plain.law.integral, rel=1e-6, abs=1e-6 * limit)
    assert scaled.counts.saturated == plain.counts.saturated


@given(st.floats(-1e3, 1e3), st.floats(0.01, 10.0), st.floats(-1e6, 1e6), st.floats(-2.0, 2.0))
def test_limits_are_the_last_word(position, gain, effort, velocity):
    ours = decoupled(u_clamp_max=5.0, u_clamp_min=-3.0, position_max=1.0, inertia=0.3)
    answer = ours.step(0, position, velocity, ModelTerm(gain, effort, True))
    assert -3.0 <= answer <= 5.0


def test_a_model_effort_at_the_limit_does_not_wind_the_integral_up():
    ours = decoupled(u_clamp_max=10.0, u_clamp_min=-10.0)
    ours.follow(Setpoint(0.5))
    ours.step(0, 0.0, 0.0, ModelTerm(0.1, 50.0))
    for k in range(1, 500):
        assert ours.step(k * MS, 0.4, 0.0, ModelTerm(0.1, 50.0)) == 10.0
    assert ours.law.integral == 0.0


@pytest.mark.parametrize("fallback", [0.0, 4.0])
def test_a_takeover_begins_with_the_fallback_effort_also_with_a_model(fallback):
    ours = decoupled(fallback_effort=fallback)
    ramp = Column("j", (Knot(0, 0.0, 0.0, 2.0), Knot(4 * SECOND, 2.0, 0.0, 0.0)), stamp_ns=SECOND)
    ours.follow(ramp)
    for k in range(1000, 1200):
        ours.step(k * MS, 0.1, 0.0, ModelTerm(0.5, 6.0, True))
    assert ours.note_timeout() == fallback
    efforts = [ours.step(k * MS, 0.3, 0.0, ModelTerm(0.5, 6.0, True)) for k in (1500, 1501)]
    assert ours.counts.takeovers == 1
    assert efforts == pytest.approx([fallback] * 2)


def test_a_state_without_a_term_is_rejected_like_one_that_is_not_finite():
    ours, other = decoupled(fallback_effort=1.0), decoupled(fallback_effort=1.0)
    term = ModelTerm(0.5, 2.0, True)
    for k in range(20):
        assert ours.step(k * MS, 0.1, 0.0, term) == other.step(k * MS, 0.1, 0.0, term)
    assert ours.reject(20 * MS, "no model term") == other.step(20 * MS, math.nan) == 1.0
    assert ours.state.mode is LoopMode.FAULT
    assert ours.last_fault == "no model term"
    assert ours.reject(20 * MS, "asked again") == 1.0
    assert (ours.counts.rejected, ours.counts.repeats) == (1, 1)
    for k in range(21, 40):
        assert ours.step(k * MS, 0.1, 0.0, term) == other.step(k * MS, 0.1, 0.0, term)


def test_beyond_a_soft_stop_the_reference_rests_and_has_no_acceleration():
    ours = decoupled(position_max=0.5, inertia=0.3)
    knots = (Knot(0, 0.0, 0.0, 0.0), Knot(SECOND, 2.0, 0.0, 0.0))
    ours.follow(Column("j", knots))
    for k in range(500):
        ours.step(k * MS, 0.2, 0.0, ModelTerm(0.3, 0.0, True))
    assert ours.following.reference == (0.5, 0.0)
    assert ours.law.model_effort == 0.0


def test_a_damping_stop_is_in_the_joints_units():
    plain, ours = loop(), decoupled()
    plain.step(0, 0.0, 0.0)
    ours.step(0, 0.0, 0.0, ModelTerm(0.25, 3.0, True))
    assert ours.damping_stop(1.0).step(MS, 0.0, 1.0) == pytest.approx(
        0.25 * plain.damping_stop(1.0).step(MS, 0.0, 1.0)
    )


def test_soft_stops_brake_with_the_joints_inertia():
    per_inertia = LoopSettings.from_parameters(
        {"joint": "j", "law": "pid", **UNIT, "compensation": "decoupling", "inertia": 0.2,
         "position_max": 1.0}
    )  # fmt: skip
    scaled = {name: 0.2 * value for name, value in UNIT.items()}
    plain = LoopSettings.from_parameters(
        {"joint": "j", "law": "pid", **scaled, "inertia": 0.2, "position_max": 1.0}
    )
    assert soft_stop_gains(per_inertia) == pytest.approx(soft_stop_gains(plain))


def test_a_reset_forgets_the_models_gain():
    ours = decoupled()
    ours.step(0, 0.0, 0.0, ModelTerm(0.25, 3.0, True))
    ours.release()
    assert (ours.law.model_effort, ours.law.integral, ours.law.effort) == (0.0, 0.0, 0.0)


def test_compensation_cannot_change_while_the_loop_runs():
    ours = decoupled()
    with pytest.raises(SettingError, match="compensation"):
        ours.retune(LoopSettings.from_parameters({"joint": "j", "law": "pid", **UNIT}))
    ours.retune(LoopSettings.from_parameters({"joint": "j", "compensation": "decoupling", **UNIT}))
    assert ours.settings.law == "hpid"


# Gains on a unit double integrator


def test_decoupled_gains_are_judged_on_inertia_one_whatever_the_joints_is():
    parameters = {"joint": "j", "law": "hpid", "mu": -0.1, **UNIT, "inertia": 0.02}
    parameters |= {"compensation": "decoupling", "norm.error_scale": 0.3, "norm.rate_weight": 0.2}
    settings = LoopSettings.from_parameters(parameters)
    assert judged_inertia(settings) == judged_inertia(settings, (0.01, 0.5)) == (1.0, 1.0)
    (verdict,) = check_gains([(settings, judged_inertia(settings))])
    assert verdict.is_certified
    assert verdict.integral_ratio == pytest.approx(1000.0 / (300.0 * 30.0))
    with pytest.raises(GainError, match="unstable"):  # stable on 0.02 kg m^2, not on 1
        LoopSettings.from_parameters({**parameters, "gains.i": 1e5})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time_constant", "code", "words"),
    [(-1.0, 0, "settle by a factor 0."), (0.0, 1, "would not settle")],
)
def test_check_gains_says_whether_decoupled_joints_settle(
    tmp_path, capsys, time_constant, code, words
):
    """On the robot without rotors' inertia, whose joints feel each other most."""
    robot = share_folder() / "urdf" / "mobile_manipulator.urdf"
    urdf = tmp_path / "direct_drive.urdf"
    urdf.write_text(re.sub(r'rotor_inertia value="[^"]*"', 'rotor_inertia value="0"',
                           robot.read_text()))  # fmt: skip
    node = {"joint": "arm_joint_2", "law": "pid", **UNIT, "compensation": "decoupling"}
    node["model.effort_filter_time_constant"] = time_constant
    file = tmp_path / "controllers.yaml"
    file.write_text(yaml.safe_dump({"elbow": {"ros__parameters": node}}))
    assert main(["check-gains", str(file), "--urdf", str(urdf)]) == code
    assert words in capsys.readouterr().out
    assert main(["check-gains", str(file)]) == 0
    assert "not known without the robot" in capsys.readouterr().out


# What an experiment says of its models

DECOUPLED = {"law": "pid", "compensation": "decoupling", "gains": {"p": 300, "i": 1000, "d": 30}}


def test_in_an_experiment_the_model_rolls_where_the_robot_does(experiment_file):
    experiment = load_experiment(experiment_file(compare={"one": DECOUPLED, "none": {}}))
    for each in experiment.controllers["one"]:
        assert each.model.left_wheel == "wheel_left_joint"
        assert each.model.wheel_separation == pytest.approx(0.5)
        assert each.model.description == ""  # no path of this machine in the result
        assert each.plant_inertia == 1.0
    assert not any(each.model.left_wheel for each in experiment.controllers["none"])
    held = load_experiment(experiment_file(compare={"one": DECOUPLED}, robot__fixed_base=True))
    assert not any(each.model.left_wheel for each in held.controllers["one"])
    document = controllers_document(experiment.controllers["one"], "robot.urdf")
    assert document["/**/arm_joint_1_controller"]["ros__parameters"]["model"]["description"] == (
        "robot.urdf"
    )
    plain = controllers_document(experiment.controllers["none"], "robot.urdf")
    assert "model" not in plain["/**/arm_joint_1_controller"]["ros__parameters"]


def test_joints_that_are_not_driven_are_locked_and_an_unknown_inertia_is_the_models(
    experiment_file,
):
    reference = {"kind": "step", "times": [0.0], "positions": {"arm_joint_2": [0.1]}}
    controllers = {"common": {"inertia": 0.0}, "joints": {}}
    file = experiment_file(
        compare={"one": DECOUPLED}, reference=reference, controllers=controllers
    )
    text = yaml.safe_load(file.read_text())
    text["robot"].pop("base", None)
    text.pop("judge", None)
    file.write_text(yaml.safe_dump(text))
    experiment = load_experiment(file)
    (only,) = experiment.controllers["one"]
    assert len(only.model.locked) == 7
    assert 0.2 < only.inertia < 0.8
    assert simulated(RunTask.of(experiment, "one"), WorldKeeper()).numbers[TOTAL]["itae"] > 0.0


def test_another_robot_in_the_model_counts_in_the_digest(experiment_file, tmp_path):
    other = tmp_path / "other.urdf"
    text = (share_folder() / "urdf" / "mobile_manipulator.urdf").read_text()
    digests = set()
    for mass in ("16.0", "17.0"):
        other.write_text(text.replace('<mass value="16.0"/>', f'<mass value="{mass}"/>'))
        changed = {**DECOUPLED, "model": {"description": str(other)}}
        digests.add(load_experiment(experiment_file(compare={"one": changed})).digest)
    assert len(digests) == 2
