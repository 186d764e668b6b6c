"""hpid upgrade: statistics of a recording, the choice of the degree, the file."""

import argparse
import json
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness.loops import loop_settings
from harness.places import URDF
from harness.runs import indices

from hpid_bench.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_bench.cli.commands import upgrade as command_module
from hpid_bench.cli.main import main
from hpid_bench.cli.options import inertias_from, parameter_file
from hpid_bench.tuning.identification.robot_identification import visited_poses
from hpid_bench.tuning.loop_simulation import simulate
from hpid_bench.tuning.loop_statistics import loop_statistics
from hpid_bench.tuning.upgrade import Candidate, effort_scale, upgrade, upgrades, worthwhile
from hpid_bench.tuning.upgrade_file import upgrade_text
from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control import Gains
from hpid_ros.control.assembly import make_law
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics import Comparison
from hpid_ros.metrics.results import RunIndices
from hpid_ros.simulation.settings import Encoder

MS = 1_000_000
ARM = ("arm_joint_1", "arm_joint_4")


def recording(counts=4096):
    """Return a decaying error, as an encoder sees it."""
    encoder = Encoder(counts, 0.3)
    true = 0.5 * (1.0 - np.exp(-4e-3 * np.arange(3000)))
    return series(np.array([encoder.read(float(each)) for each in true]), np.full(3000, 0.5))


def pid(**changes):
    values = {"joint": "elbow", "law": "pid", "gains": Gains(39.6, 132.0, 3.96), "inertia": 0.132}
    return loop_settings(**{**values, **changes})


DECOUPLED = {"compensation": "decoupling", "inertia": 0.0}


@pytest.mark.parametrize("counts", [1024, 16384])
def test_statistics_find_scales_and_the_encoder(counts):
    found = loop_statistics(recording(counts), filter_time_constant=0.01)
    assert found.largest_error == pytest.approx(0.5, abs=math.pi / counts)
    assert found.largest_rate == pytest.approx(2.0, rel=0.15)
    assert found.resolution == pytest.approx(math.tau / counts, rel=1e-6)
    assert found.period == pytest.approx(0.001)


def series(position, reference):
    stamps = np.arange(len(position)) * MS
    return JointSeries("elbow", stamps, position, reference, stamps, position)


def test_an_ideal_sensor_has_no_resolution_and_a_recording_must_say_something():
    smooth = 0.1 * np.sin(7e-3 * np.arange(500))
    assert loop_statistics(series(smooth, np.zeros(500)), 0.005).resolution == 0.0
    for nothing, words in ((smooth[:3], "3 states"), (np.ones(20), "zero throughout")):
        with pytest.raises(SettingError, match=words):
            loop_statistics(series(nothing, np.ones(len(nothing))), 0.005)


@cache  # to certify it takes a second
def upgraded(goal):
    return upgrade(pid(), (0.1, 0.2), goal, loop_statistics(recording(), 0.005))


@pytest.mark.parametrize(("goal", "sign"), [("smooth", 1.0), ("fast", -1.0)])
def test_the_degree_has_the_goals_sign_and_is_certified(goal, sign):
    found = upgraded(goal)
    settings = found.settings
    assert sign * settings.mu > 0.05
    assert found.interval[0] < settings.mu < found.interval[1]
    assert settings.gains == pid().gains
    assert 0.5 <= make_law(settings).norm_floor ** settings.mu <= 2.0
    assert all(found.reasons[name] for name in ("law", "norm.error_scale", "encoder_resolution"))
    assert "certified" in found.reasons["mu"]


@pytest.mark.parametrize("period", [0.001, 0.004])
def test_an_inertia_that_the_file_lacks_is_known_while_the_degree_is_sought(period):
    """At 1 kg m^2, which a loop without inertia is taken for, the floor would be another one."""
    values = {"gains": Gains(2667.0, 11852.0, 200.0), "control_period": period}
    known, unknown = (
        upgrade(pid(inertia=inertia, **values), (5.0, 5.0), "fast") for inertia in (5.0, 0.0)
    )
    assert unknown.settings == known.settings
    assert 1.0 < make_law(known.settings).norm_floor ** known.settings.mu <= 2.0


def test_balanced_gives_all_joints_one_scale_in_units_of_effort():
    """Of a joint that works hard and one that hardly does, as they were recorded."""
    loops = pid(), pid(joint="wrist", gains=Gains(3.96, 13.2, 0.396), inertia=0.0132)
    statistics = loop_statistics(recording(), 0.005)
    both = [Candidate(loop, (loop.inertia,) * 2, statistics) for loop in loops]
    proposals = list(upgrades(both, "balanced").found.values())
    mean_square = np.mean(np.square(recording().error))
    expected = math.sqrt(0.5 * (39.6**2 + 3.96**2) * mean_square)
    for proposal, candidate in zip(proposals, both, strict=True):
        settings = proposal.settings
        assert settings.norm.effort_scale == pytest.approx(expected, rel=5e-3)
        assert settings.mu == pytest.approx(-0.3)
        assert settings.gains == candidate.pid.gains
        assert proposal.interval == proposals[0].interval  # one rule, one certificate
        least, most = make_law(settings).multiplier(0.0, 0.0), make_law(settings).multiplier(9, 9)
        assert 1.9 < least <= 2.0
        assert most < 1.0
    # At the same share of its largest error the wrist is firmer than its PID, the elbow gentler.
    elbow, wrist = (make_law(each.settings).multiplier(0.25, 0.0) for each in proposals)
    assert elbow < 1.0 < wrist


@pytest.mark.parametrize("goal", ["smooth", "fast"])
def test_without_a_floor_no_degree_is_proposed(goal):
    """The multiplier would be 0 or infinite at rest."""
    found = upgrade(pid(norm__floor=0.0), (0.132, 0.132), goal)
    assert found.settings.mu == 0.0
    assert "at the norm's floor" in found.reasons["mu"]


def test_no_inertia_is_written_for_a_joint_that_decouples():
    found = upgrade(pid(gains=Gains(300.0, 1000.0, 30.0), **DECOUPLED), (1.0, 1.0), "fast")
    assert found.settings.inertia == 0.0
    assert "inertia" not in found.reasons


def test_the_scale_of_joints_that_decouple_is_in_units_of_effort():
    unit = {name: value / 0.132 for name, value in vars(pid().gains).items()}
    statistics = loop_statistics(recording(), 0.005)
    plain, decoupled, lacking = (
        Candidate(loop, (1.0, 1.0), statistics)
        for loop in (
            pid(),
            pid(gains=Gains(**unit), **{**DECOUPLED, "inertia": 0.132}),
            pid(gains=Gains(**unit), **DECOUPLED),
        )
    )
    assert effort_scale([decoupled]) == effort_scale([plain])
    with pytest.raises(SettingError, match="needs the inertia of 'elbow'"):
        effort_scale([lacking])


def test_balanced_needs_a_recording_and_forgets_the_joints_own_scales():
    own = pid(**{"norm.error_scale": 0.7, "norm.rate_weight": 0.4})
    with pytest.raises(SettingError, match="give --bag"):
        upgrade(own, (0.1, 0.2), "balanced")
    found = upgrade(own, (0.1, 0.2), "balanced", loop_statistics(recording(), 0.005)).settings
    assert found.norm_family.error_scale == pytest.approx(found.norm.effort_scale / 39.6)


@pytest.mark.parametrize(
    ("ivc", "itae", "short"), [(0.5, 0.6, ""), (0.99, 0.6, "IVC"), (0.5, 1.2, "ITAE")]
)
def test_balanced_is_kept_or_left_for_the_robot_as_a_whole(ivc, itae, short):
    alone, proposed = prediction(elbow=1.0).runs
    totals = replace(proposed, totals={**proposed.totals, "ivc": ivc, "itae": itae})
    kept = worthwhile(upgraded("balanced"), "balanced", Comparison((alone, totals)))
    assert (kept.settings.law == "pid") == bool(short)
    assert not short or short in kept.reasons["law"]


def test_gains_near_the_limit_keep_a_small_degree_and_unstable_ones_none():
    near = pid(gains=Gains(5.0, 9.0, 2.0), inertia=1.0, norm__rate_weight=3.0)
    assert 0.0 < upgrade(near, (1.0, 1.0), "smooth").settings.mu <= 0.8 * 0.1
    with pytest.raises(GainError, match="unstable"):
        upgrade(pid(gains=Gains(1.0, 9.0, 1.0), inertia=0.0), (1.0, 1.0), "fast")


def test_a_pid_beyond_the_sampling_limit_is_refused_with_its_figures():
    too_fast = pid(
        gains=Gains(400.0, 132.0, 3.96), control_period=0.1, state_timeout=0.5, inertia=0.0
    )
    with pytest.raises(GainError, match=r"the PID itself .* T kd / m = 3\.04 .* breaks at 0\.85"):
        upgrade(too_fast, (0.13026, 0.2), "fast")
    # backward Euler bears it
    slow = replace(too_fast, inertia=0.2, discretization="semi_implicit")
    assert upgrade(slow, (0.13026, 0.2), "fast").remarks == ()


def test_a_pid_that_feels_sampling_is_told_so():
    found = upgrade(pid(control_period=0.01), (0.132, 0.132), "fast")
    (remark,) = found.remarks
    assert "T kd / m = 0.3 (T 0.01 s, kd 3.96, least m 0.132 kg m^2), above 0.25" in remark
    # Whatever the degree, T kd lam / m would be larger: the floor has no room.
    assert found.settings.mu == 0.0
    assert worthwhile(found, "fast", None).settings.law == "pid"


def prediction(**ratios):
    """Return a comparison whose hPID has these multiples of every index of the PID's."""
    runs = []
    for label in ("PID", "hPID"):
        joints = {
            joint: indices(*[3.0 * (ratio if label == "hPID" else 1.0)] * 3)
            for joint, ratio in ratios.items()
        }
        totals = {**indices(1, 1, 1), "effort_l2": 1.0, "error_l2": 1.0}
        runs.append(RunIndices(label, joints, totals))
    return Comparison(tuple(runs))


@pytest.mark.parametrize(
    ("ratio", "doubt", "is_kept"),
    [
        (0.9, 0.0, False),
        (0.979, 0.0, False),
        (0.985, 0.0, True),
        (1.3, 0.0, True),
        (0.9, 0.04, False),
        (0.9, 0.2, True),
    ],
)
def test_where_the_goals_index_does_not_fall_for_certain_the_pid_is_kept(ratio, doubt, is_kept):
    judged = worthwhile(upgraded("smooth"), "smooth", prediction(elbow=ratio), doubt)
    assert judged.settings.gains == pid().gains
    assert (judged.settings.law == "pid") == is_kept
    assert ("nothing to gain" in judged.reasons["law"]) == is_kept
    assert ("between 0.737 and 1.1" in judged.reasons["law"]) == (doubt == 0.2)


def test_effort_limits_are_the_narrower_of_the_urdfs_and_the_pids():
    cases = [
        ((-1e6, 1e6), 30.0, (-30.0, 30.0)),
        ((-10.0, 50.0), 30.0, (-10.0, 30.0)),
        ((-10.0, 10.0), 30.0, (-10.0, 10.0)),
        ((-1e6, 1e6), math.inf, (-1e6, 1e6)),
    ]
    candidates = [
        Candidate(
            pid(joint=f"j{k}", u_clamp_min=least, u_clamp_max=most), (0.132,) * 2, None, each
        )
        for k, ((least, most), each, _) in enumerate(cases)
    ]
    proposals = upgrades(candidates, "smooth").found.values()
    for found, (own, _, clamps) in zip(proposals, cases, strict=True):
        assert (found.settings.effort.u_clamp_min, found.settings.effort.u_clamp_max) == clamps
        for name, was, now in zip(("u_clamp_min", "u_clamp_max"), own, clamps, strict=True):
            assert ("effort limit of the URDF" in found.reasons.get(name, "")) == (was != now)


def test_the_range_of_inertia_is_in_the_file_and_counts_when_gains_are_checked(
    tmp_path, hpid, refused
):
    found = upgrade(pid(inertia=0.0), (0.1, 0.2), "fast")
    file = tmp_path / "upgraded.yaml"
    file.write_text(upgrade_text([found], ["A test."], {}))
    known = parameter_file(file)
    assert known.inertias == {"elbow": (0.1, 0.2)}
    assert list(known.loops) == ["elbow_controller"]
    for options, inertia in (([], [0.1, 0.2]), (["--inertia", "elbow=0.15:0.3"], [0.15, 0.3])):
        code, printed, _ = hpid("check-gains", file, "--json", *options)
        assert (code, json.loads(printed)["elbow"]["inertia"]) == (DONE, inertia)
    file.write_text(file.read_text().replace("[0.1, 0.2]", "[0.1]"))
    assert "least and largest inertia, not [0.1]" in refused("check-gains", file)


def parameter_text(**joints):
    """Return a parameter file of PIDs with these gains."""
    nodes = {}
    for joint, gains in joints.items():
        pid = {"joint": joint, "law": "pid", "gains": dict(zip("pid", gains, strict=True))}
        nodes[f"{joint}_controller"] = {"ros__parameters": pid}
    return yaml.safe_dump(nodes)


def test_a_joint_that_fails_is_named_and_the_others_go_on(tmp_path, capsys):
    file, new = tmp_path / "pids.yaml", tmp_path / "new.yaml"
    good = (39.6, 132.0, 3.96)
    file.write_text(parameter_text(a=good, unstable=(1.0, 9.0, 1.0), b=good))
    command = ["upgrade", str(file), "--goal", "fast", "-o", str(new)]
    command += ["--inertia", "a=0.132", "b=0.1:0.2", "--inertia", "unstable=1"]
    assert main(command) == FAILED
    out, err = capsys.readouterr()
    assert "unstable: NOT upgraded, kept as it was\n  the loop is unstable: p d = 1" in out
    assert sorted(line.split()[1] for line in err.splitlines()) == ["a", "b", "unstable"]
    assert "# NOT upgraded: the loop is unstable" in new.read_text()
    after = parameter_file(new)
    assert [each.law for each in after.loops.values()] == ["hpid", "hpid", "pid"]
    assert after.inertias == {"a": (0.132, 0.132), "b": (0.1, 0.2)}
    assert after.loops["unstable_controller"].gains == Gains(1.0, 9.0, 1.0)


@pytest.mark.parametrize(
    ("gains", "options", "words"),
    [
        ((1.0, 9.0, 1.0), ["--goal", "fast"], "no joint can be upgraded: the loop is unstable"),
        ((39.6, 132.0, 3.96), ["--goal", "balanced"], "give --bag"),
        ((39.6, 132.0, 3.96), ["--goal", "fast", "--bag", "BAG"], "'a'"),
    ],
)
def test_where_nothing_can_be_upgraded_nothing_is_written(
    result, tmp_path, capsys, gains, options, words
):
    file, new = tmp_path / "pids.yaml", tmp_path / "new.yaml"
    file.write_text(parameter_text(a=gains))
    options = [str(result / "PID") if each == "BAG" else each for each in options]
    assert main(["upgrade", str(file), "--inertia", "1", "-o", str(new), *options]) == BAD_INPUT
    assert words in capsys.readouterr().err
    assert not new.exists()


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (["0.5"], {"a": (0.5, 0.5), "b": (0.5, 0.5)}),
        (["0.5", "1"], {"a": (0.5, 1.0), "b": (0.5, 1.0)}),
        (["a=0.5"], {"a": (0.5, 0.5)}),
        (["a=0.5:1", "b=2"], {"a": (0.5, 1.0), "b": (2.0, 2.0)}),
        (["3", "b=2"], {"a": (3.0, 3.0), "b": (2.0, 2.0)}),
        (["own.yaml", "b=2"], {"a": (3.0, 3.0), "b": (2.0, 2.0)}),
        (["1", "2", "3"], "not 3"),
        (["c=1"], "unknown joint in --inertia 'c'; known: a, b"),
        (["a=x"], "not 'a=x'"),
        (["=1"], "not '=1'"),
        (["a=1:2:3"], "not 'a=1:2:3'"),
        (["a=2:1"], "inertia of 'a' must be positive and finite"),
        (["nan"], "must be positive and finite"),
    ],
)
def test_inertia_is_said_of_all_joints_or_of_one(given, found, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = "controllers: {joints: {a: {inertia: 3}, b: {inertia: 3}}}"
    Path("own.yaml").write_text(own)
    options = argparse.Namespace(inertia=[given], urdf=None, payload=0.0, poses=None)
    if isinstance(found, dict):
        assert inertias_from(options, ["a", "b"]) == found
    else:
        with pytest.raises(SettingError, match=re.escape(found)):
            inertias_from(options, ["a", "b"])


def test_inertias_of_a_robot_are_its_own_but_for_those_that_are_said():
    """Over its poses and with a payload; poses that were visited narrow them."""
    joints, urdf = ["arm_joint_1", "arm_joint_2"], "urdf/mobile_manipulator.urdf"
    said = {"inertia": [["arm_joint_1=0.5:0.7"]], "urdf": urdf, "payload": 0.0}
    everywhere = inertias_from(argparse.Namespace(**said, poses=None), joints)
    assert everywhere["arm_joint_1"] == (0.5, 0.7)
    low, high = everywhere["arm_joint_2"]
    poses = [{"arm_joint_3": 0.1}, {"arm_joint_3": 0.12}]
    visited = inertias_from(argparse.Namespace(**said, poses=None), joints, poses)
    assert low < visited["arm_joint_2"][0] <= visited["arm_joint_2"][1] < high
    assert inertias_from(argparse.Namespace(**said, poses=200), joints, poses) == everywhere
    loaded = inertias_from(argparse.Namespace(**{**said, "payload": 2.0}, poses=None), joints)
    assert loaded["arm_joint_2"][1] > 1.2 * high


def test_the_poses_of_recordings_are_of_these_and_not_of_the_time_between():
    assert visited_poses([]) == []
    one = np.arange(0, 10_000_000_000, 10_000_000)
    stamps = np.concatenate([one, one + 10**15])
    position = np.sin(stamps % 10**12 * 1e-9)
    visited = [
        pose["elbow"]
        for pose in visited_poses(
            [JointSeries("elbow", stamps, position, position, stamps, position)]
        )
    ]
    assert len(visited) == 200
    shares = [0.1, 0.9]
    expected = np.quantile(position, shares)
    assert np.quantile(visited, shares) == pytest.approx(expected, abs=0.05)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a run: a parameter file of two of its controllers, and its bag."""
    from hpid_bench.experiment.description import load_experiment
    from hpid_bench.experiment.in_process import NoProgress, run_without_ros, write_run_files
    from hpid_ros.base.resources import share_folder

    folder = tmp_path_factory.mktemp("upgrade")
    document = yaml.safe_load((share_folder() / "config/experiments/tracking.yaml").read_text())
    document |= {"duration": 1.0, "simulation": {"engine": "mujoco", "physics_steps": 2}}
    (folder / "short.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    experiment = load_experiment(folder / "short.yaml")
    arm = [each for each in experiment.controllers["PID"] if each.joint in ARM]
    write_run_files(folder, experiment, arm)
    run_without_ros(experiment, "PID", folder / "PID", NoProgress())
    return folder


def test_from_recording_to_a_file_that_runs_and_is_certified(
    result, tmp_path, capsys, monkeypatch
):
    is_held = []
    monkeypatch.setattr(
        command_module,
        "simulate",
        lambda robot, *given: is_held.append(robot.fixed_base) or simulate(robot, *given),
    )
    file = tmp_path / "upgraded.yaml"
    parameters = result / "controllers.yaml"
    command = ["upgrade", str(parameters), "--goal", "fast", "--bag", str(result / "PID")]
    command += ["--urdf", "urdf/mobile_manipulator.urdf", "--poses", "3", "-o", str(file)]
    assert main(command) == DONE
    out, err = capsys.readouterr()
    assert "Predicted, simulated on the model" in out
    assert "simulating the PID and the proposal" in err
    assert is_held == [True]  # the base of a URDF
    before, after = (parameter_file(each).loops for each in (parameters, file))
    assert list(before) == list(after) == [f"{joint}_controller" for joint in ARM]
    for name, settings in after.items():
        assert settings.law == "hpid"
        assert settings.mu < 0.0
        assert settings.gains == before[name].gains
        assert settings.encoder.encoder_resolution == pytest.approx(math.tau / 16384, rel=1e-4)
    assert main(["check-gains", str(file)]) == DONE
    (urdf := tmp_path / "robot.urdf").write_text(URDF.read_text())
    command[command.index("--urdf") + 1] = str(urdf)
    for own, words in ((file, "exists"), (parameters, "is an input"), (urdf, "is an input")):
        force = [] if own is file else ["--force"]
        assert main([*command[:-1], str(own), *force]) == BAD_INPUT
        assert words in capsys.readouterr().err.splitlines()[-1]
    assert [parameter_file(each).loops for each in (parameters, file)] == [before, after]
