"""Tuning rules: the loop that they promise, their source's margins, the gains of the files."""

import math
import re

import numpy as np
import pytest
import yaml
from harness.engines import shipped
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_bench.cli.main import main
from hpid_bench.experiment.description import initial_inertias, load_experiment
from hpid_bench.tuning.autotune import autotuned, effective_delay
from hpid_bench.tuning.gain_design import RULES, pole_placement, simc
from hpid_ros.base.errors import SettingError
from hpid_ros.base.resources import share_folder
from hpid_ros.control import LoopSettings
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import wheel_inertias
from hpid_ros.stability.margins import loop_family, margins_of

EXPERIMENTS = sorted((share_folder() / "config" / "experiments").glob("*.yaml"))
inertias = st.floats(1e-4, 10.0)
times = st.floats(0.03, 10.0)


@given(inertias, times)
def test_pole_placement_puts_three_poles_in_one_place(inertia, time):
    gains = pole_placement(inertia, time)
    s = -1.0 / time
    terms = [inertia * s**3, gains.d * s**2, gains.p * s, gains.i]
    derivative = [3.0 * inertia * s**2, 2.0 * gains.d * s, gains.p]
    second = [6.0 * inertia * s, 2.0 * gains.d]
    for row in (terms, derivative, second):
        assert abs(math.fsum(row)) <= 1e-12 * max(map(abs, row))


@given(inertias, times, st.floats(0.0, 1.0), st.floats(0.1, 50.0))
def test_the_parallel_form_is_the_series_form(inertia, time, delay, frequency):
    """Skogestad 2003, table 1: Kc = 1/k'' / (4 (tau_c + theta)^2), tau_I = tau_D."""
    gains, s, tau = simc(inertia, time, delay), 1j * frequency, 4.0 * (time + delay)
    series = inertia / (0.25 * tau**2) * (1.0 + 1.0 / (tau * s)) * (1.0 + tau * s)
    assert gains.p + gains.i / s + gains.d * s == pytest.approx(series, rel=1e-12)


def test_simc_has_the_margins_that_its_source_states():
    """Skogestad 2003: exp(-s)/s^2, tau_c = theta: Ms 1.96; sampled a hundred times as fast."""
    measured = {"velocity_source": "measured", "control_period": 0.01}
    settings = LoopSettings("joint", simc(1.0, 1.0, 1.0)).with_parameters(measured)
    margins = margins_of(loop_family(settings, (1.0, 1.0), delay=1.0).loop(1.0))
    assert margins.sensitivity == pytest.approx(1.96, abs=0.01)


@given(inertias, times, st.sampled_from(sorted(RULES)))
def test_every_rule_gives_a_stable_loop_as_fast_as_asked(inertia, time, rule):
    gains = RULES[rule](inertia, time, 0.0)
    slowest = np.roots([inertia, gains.d, gains.p, gains.i]).real.max() * time
    assert -1.01 < slowest < -0.17  # the slowest of simc is a pair at -0.176 / T
    twice = RULES[rule](2.0 * inertia, time, 0.0)
    assert (twice.p, twice.i, twice.d) == pytest.approx((2 * gains.p, 2 * gains.i, 2 * gains.d))
    deviation, name, found = recognise(gains, inertia)
    assert (name, found) == (rule, pytest.approx(time))
    assert deviation < 1e-9


def recognise(gains, inertia):
    """Return the rule that is closest to gains, its time [s] by their d, and how far it is off."""
    found = []
    for name, rule in RULES.items():
        time = rule(inertia, 1.0, 0.0).d / gains.d  # in every rule d is inversely proportional
        wanted = rule(inertia, time, 0.0)
        deviation = max(abs(gains.p / wanted.p - 1.0), abs(gains.i / wanted.i - 1.0))
        found.append((deviation, name, time))
    return min(found)


@pytest.mark.parametrize("numbers", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, -1.0)])
@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_impossible_numbers_are_refused(rule, numbers):
    with pytest.raises(SettingError, match="must be"):
        rule(*numbers)
    with pytest.raises(SettingError, match="must be"):
        rule(*(math.nan if n <= 0.0 else n for n in (*numbers[:2], numbers[2] or 1.0)))


def test_a_wheel_accelerates_the_robot_that_rolls_on_it():
    """Against a planar robot by hand: M v^2/2 + Iz w^2/2 + two wheels' J rate^2/2."""
    experiment = load_experiment(EXPERIMENTS[[e.stem for e in EXPERIMENTS].index("tracking")])
    description = RobotDescription.load(experiment.world.robot_description)
    drive = DifferentialDrive.of(description, "wheel_left_joint", "wheel_right_joint")
    pose = {"arm_joint_2": -0.5, "arm_joint_3": 1.8, "arm_joint_5": 1.2}
    found = wheel_inertias(description, drive, pose)
    assert found["wheel_left_joint"] == pytest.approx(found["wheel_right_joint"], rel=1e-9)
    heavier = wheel_inertias(description, drive, pose, 2.0)
    assert heavier["wheel_left_joint"] > found["wheel_left_joint"]
    mass, yaw, spin, r, b = 22.850003, 0.8625593, 0.01475, drive.radius, drive.separation
    own = spin + mass * r**2 / 4.0 + yaw * r**2 / b**2
    other = mass * r**2 / 4.0 - yaw * r**2 / b**2
    by_hand = own - other**2 / own
    assert found["wheel_left_joint"] == pytest.approx(by_hand, rel=0.01)


@pytest.mark.parametrize("path", shipped(EXPERIMENTS))
def test_the_baseline_of_every_experiment_follows_one_published_rule(path):
    """One rule and one closed-loop time for all joints, on inertias that are the robot's."""
    experiment = load_experiment(path)
    baseline = next(iter(experiment.controllers.values()))
    deviations, rules, found = zip(
        *(recognise(each.gains, each.plant_inertia) for each in baseline), strict=True
    )
    assert len(set(rules)) == 1
    assert max(deviations) < 0.01
    assert max(found) <= 1.01 * min(found)
    if "controllers" not in yaml.safe_load(path.read_text()):
        return  # gains and inertias are those of the pose of the file that it extends
    wanted = initial_inertias(experiment, baseline)
    for each in baseline:
        assert each.plant_inertia == pytest.approx(wanted[each.joint], rel=0.02), each.joint


def test_the_command_prints_a_part_of_an_experiment_file(tmp_path, capsys):
    path, document = tmp_path / "own.yaml", {"extends": "tracking.yaml"}
    path.write_text(yaml.safe_dump(document))
    options = ["--rule", "pole-placement", "--closed-loop-time", "0.1"]
    assert main(["gains", str(path), *options]) == DONE
    out = capsys.readouterr().out
    assert "certified for mu in (" in out
    printed = yaml.safe_load(out)["controllers"]["joints"]
    path.write_text(yaml.safe_dump({**document, "controllers": {"joints": printed}}))
    for each in load_experiment(path).controllers["PID"]:
        assert recognise(each.gains, each.inertia)[2] == pytest.approx(0.1, rel=1e-4)


MARGINS = r"GM (\S+ \S+) dB, PM (\S+) deg, DM (\S+) ms, Ms (\S+)"


def test_gains_and_margins_of_a_file_print_the_same_margins(tmp_path, capsys):
    """Of the loop as it is sampled, with the joints' friction and the drives' delays."""
    document = {
        "extends": "paper.yaml",
        "control": {"rate": 50},
        "actuators": {"joints": {"arm_joint_3": {"delay": 1}}},
    }
    path, late = tmp_path / "own.yaml", ["--delay", "0.002"]
    path.write_text(yaml.safe_dump(document))
    rule = ["--rule", "simc", "--closed-loop-time", "0.05", *late]
    main(["gains", str(path), *rule])
    printed = capsys.readouterr().out
    gains = {
        joint: tuple(numbers)
        for joint, *numbers in re.findall(rf"^ +(\w+): .*{MARGINS}", printed, re.MULTILINE)
    }
    path.write_text(yaml.safe_dump(document | yaml.safe_load(printed)))
    joints = ["wheel_left_joint", "arm_joint_3"]
    named = ["--controller", "PID", *(word for joint in joints for word in ("--joint", joint))]
    assert main(["margins", str(path), *named, *late]) == DONE
    cells = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = {row[1]: row[3:] for row in cells[1 : 1 + len(joints)]}
    margins = {
        joint: (f"{low} {high}", pm, dm, ms)
        for joint, (low, high, pm, dm, _, _, ms, *_) in rows.items()
    }
    assert margins == {joint: gains[joint] for joint in joints}


def test_the_command_says_when_a_delay_is_too_long(capsys):
    rule = ["--rule", "pole-placement", "--closed-loop-time", "0.01"]
    assert main(["gains", "--inertia", "0.1", *rule, "--delay", "0.02"]) == FAILED
    assert "is unstable: spectral radius" in capsys.readouterr().out
    assert main(["gains", "--inertia", "0.1", *rule, "--delay", "0.3"]) == FAILED
    assert "the delay must lie in [0, 0.2] s" in capsys.readouterr().out
    assert main(["gains", "--inertia", "-1", *rule]) == BAD_INPUT
    assert main(["gains", "x.yaml", "--inertia", "0.1", *rule]) == BAD_INPUT
    assert main(["gains", "x.yaml", "--period", "0.1", *rule]) == BAD_INPUT
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_a_joint_that_its_friction_holds_is_named(experiment_file, capsys):
    command = ["gains", str(experiment_file()), "--rule", "pole-placement", "--closed-loop-time"]
    main([*command, "0.1"])
    assert "friction" not in "".join(capsys.readouterr())
    main([*command, "1.0"])
    text, told = capsys.readouterr()
    p = yaml.safe_load(text)["controllers"]["joints"]["arm_joint_6"]["gains"]["p"]
    line = f"arm_joint_6: its friction of 0.08 N m holds it up to {0.08 / p:.2g} rad off"
    assert line in " ".join(told.split())
    assert f"# {line}" in text


RUNNING = {"joint": "elbow", "gains.p": 30.0, "gains.i": 90.0, "gains.d": 3.0}
FILTERED = {"velocity_source": "filtered", "velocity_filter_time_constant": 0.006}


def test_filter_and_hold_count_as_delay():
    plain = LoopSettings.from_parameters({**RUNNING, "control_period": 0.004})
    assert effective_delay(plain, 0.003) == pytest.approx(0.005)
    assert effective_delay(plain, 0.003, has_velocities=False) == pytest.approx(0.010)
    filtered = LoopSettings.from_parameters({**RUNNING, **FILTERED, "control_period": 0.004})
    assert effective_delay(filtered, 0.003) == pytest.approx(0.011)


def test_the_gains_are_simc_s_and_the_rest_of_the_loop_stays():
    settings = LoopSettings.from_parameters({**RUNNING, **FILTERED, "u_clamp_max": 7.0})
    found = autotuned(settings, (0.095, 0.105), 0.004, 0.05, "fast")
    exact = simc(0.1, 0.05, found.delay)
    assert found.pid.gains.p == pytest.approx(exact.p, rel=1e-3)
    assert found.pid.gains.d == pytest.approx(exact.d, rel=1e-3)
    upgraded = found.upgrade.settings
    assert upgraded.gains == found.pid.gains
    assert upgraded.effort.u_clamp_max == 7.0
    low, high = found.upgrade.interval
    assert low < upgraded.mu < 0.0 < high
    assert "SIMC" in found.upgrade.reasons["gains.p"]


def test_by_itself_the_closed_loop_takes_four_delays():
    settings = LoopSettings.from_parameters(RUNNING)
    found = autotuned(settings, (0.1, 0.1), 0.01, None, "smooth")
    assert found.closed_loop_time == pytest.approx(4.0 * found.delay)


def test_a_loop_that_decouples_is_refused():
    model = {"compensation": "decoupling", "model.description": "arm.urdf"}
    settings = LoopSettings.from_parameters({**RUNNING, **model, "gains.i": 50.0})
    with pytest.raises(SettingError, match="unit inertia"):
        autotuned(settings, (0.1, 0.1), 0.01, None, "fast")
