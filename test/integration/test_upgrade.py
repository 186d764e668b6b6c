"""hpid upgrade: statistics of a recording, the choice of the degree, the file."""

import argparse
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from harness.loops import loop_settings

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.cli.commands import BAD_INPUT, DONE, FAILED
from hpid_ros.cli.main import main
from hpid_ros.cli.options import inertias_from
from hpid_ros.control import Gains
from hpid_ros.control.assembly import make_law
from hpid_ros.control.controller_files import parameter_file, settings_from_parameter_file
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics import Comparison
from hpid_ros.metrics.results import JointIndices, RunIndices
from hpid_ros.simulation.settings import Encoder
from hpid_ros.stability.certification import certified_degree_interval, verify_certificate
from hpid_ros.tuning.robot_identification import visited_poses
from hpid_ros.tuning.upgrade import (
    Candidate,
    loop_statistics,
    upgrade,
    upgrade_text,
    upgrades,
    worthwhile,
)

MS = 1_000_000


def recording(counts=4096, noise=0.0):
    """Return a decaying error, as an encoder sees it."""
    time = np.arange(3000) * 1e-3
    encoder = Encoder(counts, 0.3)
    true = 0.5 * (1.0 - np.exp(-4.0 * time))
    position = np.array([encoder.read(float(each)) for each in true])
    stamps = np.arange(3000) * MS
    reference = np.full(3000, 0.5)
    return JointSeries("elbow", stamps, position + noise, reference, stamps, position)


def pid(**changes):
    values = {"joint": "elbow", "law": "pid", "gains": Gains(39.6, 132.0, 3.96), "inertia": 0.132}
    return loop_settings(**{**values, **changes})


@pytest.mark.parametrize("counts", [1024, 4096, 16384])
def test_statistics_find_scales_and_the_encoder(counts):
    found = loop_statistics(recording(counts), filter_time_constant=0.01)
    assert found.largest_error == pytest.approx(0.5, abs=math.pi / counts)
    assert found.largest_rate == pytest.approx(2.0, rel=0.15)
    assert found.resolution == pytest.approx(math.tau / counts, rel=1e-6)
    assert found.period == pytest.approx(0.001)


def test_an_ideal_sensor_has_no_resolution():
    time = np.arange(500) * 1e-3
    stamps = np.arange(500) * MS
    position = 0.1 * np.sin(7.0 * time)
    series = JointSeries("elbow", stamps, position, np.zeros(500), stamps, position)
    assert loop_statistics(series, 0.005).resolution == 0.0


@pytest.mark.parametrize(("goal", "sign"), [("smooth", 1.0), ("fast", -1.0)])
def test_the_degree_has_the_goals_sign_and_is_certified(goal, sign):
    found = upgrade(pid(), (0.1, 0.2), goal, loop_statistics(recording(), 0.005))
    assert sign * found.settings.mu > 0.05
    assert found.interval[0] < found.settings.mu < found.interval[1]
    interval = certified_degree_interval(
        found.settings.gains, found.settings.norm_family, (0.1, 0.2)
    )
    assert verify_certificate(interval.certificate).rate > 0.0
    assert found.settings.gains == pid().gains
    law = make_law(found.settings)
    assert 0.5 <= law.norm_floor**found.settings.mu <= 2.0


def elbow_and_wrist():
    """Return a joint that works hard and one that hardly does, as they were recorded."""
    loops = pid(), pid(joint="wrist", gains=Gains(3.96, 13.2, 0.396), inertia=0.0132)
    statistics = loop_statistics(recording(), 0.005)
    return [Candidate(loop, (loop.inertia,) * 2, statistics) for loop in loops]


def test_balanced_gives_all_joints_one_scale_in_units_of_effort():
    both = elbow_and_wrist()
    proposals = upgrades(both, "balanced")
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


def test_balanced_needs_a_recording_and_forgets_the_joints_own_scales(capsys, tmp_path):
    own = pid(**{"norm.error_scale": 0.7, "norm.rate_weight": 0.4})
    with pytest.raises(SettingError, match="give --bag"):
        upgrade(own, (0.1, 0.2), "balanced")
    found = upgrade(own, (0.1, 0.2), "balanced", loop_statistics(recording(), 0.005)).settings
    assert found.norm_family.error_scale == pytest.approx(found.norm.effort_scale / 39.6)
    file = tmp_path / "pid.yaml"
    file.write_text(parameter_text(elbow=(39.6, 132.0, 3.96)))
    command = ["upgrade", str(file), "--goal", "balanced", "--inertia", "0.132"]
    assert main([*command, "-o", str(tmp_path / "out.yaml")]) == BAD_INPUT
    assert capsys.readouterr().err.count("give --bag") == 1
    assert not (tmp_path / "out.yaml").exists()


@pytest.mark.parametrize(
    ("ivc", "itae", "is_kept"), [(0.5, 0.6, False), (0.99, 0.6, True), (0.5, 1.2, True)]
)
def test_balanced_is_kept_or_left_for_the_robot_as_a_whole(ivc, itae, is_kept):
    found = upgrade(pid(), (0.1, 0.2), "balanced", loop_statistics(recording(), 0.005))
    pid_alone, proposed = prediction(elbow=1.0).runs
    totals = replace(proposed, totals=JointIndices(ivc, 1.0, itae))
    kept = worthwhile(found, "balanced", Comparison((pid_alone, totals)))
    assert (kept.settings.law == "pid") == is_kept
    if is_kept:
        assert ("IVC" if ivc > 0.9 else "ITAE") in kept.reasons["law"]


def test_every_number_of_the_proposal_has_a_reason_or_a_default():
    found = upgrade(pid(), (0.132, 0.132), "fast", loop_statistics(recording(), 0.005))
    for name in ("mu", "law", "norm.error_scale", "norm.rate_weight", "encoder_resolution"):
        assert found.reasons[name]
    assert "certified" in found.reasons["mu"]


def test_gains_near_the_limit_keep_a_small_degree():
    near = pid(gains=Gains(5.0, 9.0, 2.0), inertia=1.0, norm__rate_weight=3.0)
    found = upgrade(near, (1.0, 1.0), "smooth")
    assert 0.0 < found.settings.mu <= 0.8 * 0.1


def test_unstable_gains_are_not_upgraded():
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


@pytest.mark.parametrize("goal", ["smooth", "fast"])
def test_a_pid_that_feels_sampling_is_told_so(goal):
    found = upgrade(pid(control_period=0.01), (0.132, 0.132), goal)
    (remark,) = found.remarks
    assert "T kd / m = 0.3 (T 0.01 s, kd 3.96, least m 0.132 kg m^2), above 0.25" in remark
    if goal == "fast":  # whatever the degree, T kd lam / m would be larger: the floor has no room
        assert found.settings.mu == 0.0
        kept = worthwhile(found, goal, None)
        assert kept.settings.law == "pid"
        assert "nothing to gain, keep your PID: goal fast: no other degree" in kept.reasons["law"]


@pytest.mark.parametrize(("doubt", "is_kept"), [(0.0, False), (0.04, False), (0.2, True)])
def test_where_a_gain_is_less_than_the_doubt_the_pid_is_kept(doubt, is_kept):
    found = upgrade(pid(), (0.1, 0.2), "smooth")
    judged = worthwhile(found, "smooth", prediction(elbow=0.9), doubt)
    assert (judged.settings.law == "pid") == is_kept
    if is_kept:
        assert "between 0.737 and 1.1" in judged.reasons["law"]


def prediction(**ratios):
    """Return a comparison whose hPID has these multiples of every index of the PID's."""
    runs = []
    for label in ("PID", "hPID"):
        indices = {
            joint: JointIndices(*[3.0 * (ratio if label == "hPID" else 1.0)] * 3)
            for joint, ratio in ratios.items()
        }
        runs.append(RunIndices(label, indices, JointIndices(1.0, 1.0, 1.0), 1.0, 1.0))
    return Comparison(tuple(runs))


@pytest.mark.parametrize(
    ("ratio", "is_kept"), [(0.9, False), (0.979, False), (0.985, True), (1.3, True)]
)
def test_where_the_goals_index_does_not_fall_the_pid_is_kept(ratio, is_kept):
    found = upgrade(pid(), (0.1, 0.2), "smooth")
    judged = worthwhile(found, "smooth", prediction(elbow=ratio))
    assert (judged.settings.law == "pid") == is_kept
    assert judged.settings.gains == pid().gains
    assert ("nothing to gain" in judged.reasons["law"]) == is_kept
    if is_kept:
        assert f"the predicted IVC is {ratio:.3f} of the PID's" in judged.reasons["law"]


@pytest.mark.parametrize(
    ("own", "limit", "clamps"),
    [
        ((-1e6, 1e6), 30.0, (-30.0, 30.0)),
        ((-10.0, 50.0), 30.0, (-10.0, 30.0)),
        ((-10.0, 10.0), 30.0, (-10.0, 10.0)),
        ((-1e6, 1e6), 0.0, (-1e6, 1e6)),  # a URDF's 0 says nothing
        ((-1e6, 1e6), math.inf, (-1e6, 1e6)),
    ],
)
def test_effort_limits_are_the_narrower_of_the_urdfs_and_the_pids(own, limit, clamps):
    loop = pid(u_clamp_min=own[0], u_clamp_max=own[1])
    (found,) = upgrades([Candidate(loop, (0.132, 0.132), effort=limit)], "smooth")
    assert (found.settings.effort.u_clamp_min, found.settings.effort.u_clamp_max) == clamps
    for name, was, now in zip(("u_clamp_min", "u_clamp_max"), own, clamps, strict=True):
        assert ("effort limit of the URDF" in found.reasons.get(name, "")) == (was != now)


def test_the_range_of_inertia_is_in_the_file_and_counts_when_gains_are_checked(tmp_path, capsys):
    found = upgrade(pid(inertia=0.0), (0.1, 0.2), "fast")
    file = tmp_path / "upgraded.yaml"
    file.write_text(upgrade_text([found], ["A test."], {}))
    known = parameter_file(file)
    assert known.inertias == {"elbow": (0.1, 0.2)}
    assert list(known.loops) == ["elbow_controller"]
    assert main(["check-gains", str(file), "--json"]) == DONE
    assert json.loads(capsys.readouterr().out)["elbow"]["inertia"] == [0.1, 0.2]
    assert main(["check-gains", str(file), "--inertia", "elbow=0.15:0.3", "--json"]) == DONE
    assert json.loads(capsys.readouterr().out)["elbow"]["inertia"] == [0.15, 0.3]
    file.write_text(file.read_text().replace("[0.1, 0.2]", "[0.1]"))
    assert main(["check-gains", str(file)]) == BAD_INPUT
    assert "least and largest inertia, not [0.1]" in capsys.readouterr().err


def parameter_text(**joints):
    """Return a parameter file of PIDs with these gains."""
    return yaml.safe_dump(
        {
            f"{joint}_controller": {
                "ros__parameters": {
                    "joint": joint,
                    "law": "pid",
                    "gains": dict(zip("pid", gains, strict=True)),
                }
            }
            for joint, gains in joints.items()
        }
    )


def test_a_joint_that_fails_is_named_and_the_others_go_on(tmp_path, capsys):
    file, new = tmp_path / "pids.yaml", tmp_path / "new.yaml"
    good = (39.6, 132.0, 3.96)
    file.write_text(parameter_text(a=good, unstable=(1.0, 9.0, 1.0), b=good))
    command = ["upgrade", str(file), "--goal", "fast", "-o", str(new)]
    command += ["--inertia", "a=0.132", "b=0.1:0.2", "--inertia", "unstable=1"]
    assert main(command) == FAILED
    said = capsys.readouterr()
    assert "unstable: NOT upgraded, kept as it was\n  the loop is unstable: p d = 1" in said.out
    lines = [line.split() for line in said.err.splitlines()]
    assert {words[1] for words in lines} == {"a", "b", "unstable"}
    assert [words[2:] for words in lines] == [[f"({k}", "of", "3)"] for k in (1, 2, 3)]
    text = new.read_text()
    assert "# NOT upgraded: the loop is unstable" in text
    after = parameter_file(new)
    assert [each.law for each in after.loops.values()] == ["hpid", "hpid", "pid"]
    assert after.inertias == {"a": (0.132, 0.132), "b": (0.1, 0.2)}
    assert after.loops["unstable_controller"].gains == Gains(1.0, 9.0, 1.0)


def test_where_every_joint_fails_nothing_is_written(tmp_path, capsys):
    file, new = tmp_path / "pids.yaml", tmp_path / "new.yaml"
    file.write_text(parameter_text(a=(1.0, 9.0, 1.0)))
    command = ["upgrade", str(file), "--goal", "fast", "-o", str(new), "--inertia", "1"]
    assert main(command) == BAD_INPUT
    assert "no joint can be upgraded: the loop is unstable" in capsys.readouterr().err
    assert not new.exists()


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (["0.5"], {"a": (0.5, 0.5), "b": (0.5, 0.5)}),
        (["0.5", "1"], {"a": (0.5, 1.0), "b": (0.5, 1.0)}),
        (["a=0.5"], {"a": (0.5, 0.5)}),
        (["a=0.5:1", "b=2"], {"a": (0.5, 1.0), "b": (2.0, 2.0)}),
        (["3", "b=2"], {"a": (3.0, 3.0), "b": (2.0, 2.0)}),
        (["1", "2", "3"], "not 3"),
        (["c=1"], "unknown joint in --inertia 'c'; known: a, b"),
        (["a=x"], "not 'a=x'"),
        (["=1"], "not '=1'"),
        (["a=1:2:3"], "not 'a=1:2:3'"),
        (["a=2:1"], "inertia of 'a' must be positive and finite"),
        (["nan"], "must be positive and finite"),
    ],
)
def test_inertia_is_said_of_all_joints_or_of_one(given, found):
    options = argparse.Namespace(inertia=[given], urdf=None, payload=0.0, poses=None)
    if isinstance(found, dict):
        assert inertias_from(options, ["a", "b"]) == found
    else:
        with pytest.raises(SettingError, match=re.escape(found)):
            inertias_from(options, ["a", "b"])


def test_inertias_beside_a_robot_are_its_own_but_for_those_that_are_said():
    joints = ["arm_joint_1", "arm_joint_2"]
    options = argparse.Namespace(
        inertia=[["arm_joint_1=0.5:0.7"]],
        urdf="urdf/mobile_manipulator.urdf",
        payload=0.0,
        poses=None,
    )
    everywhere = inertias_from(options, joints)
    assert everywhere["arm_joint_1"] == (0.5, 0.7)
    low, high = everywhere["arm_joint_2"]
    visited = inertias_from(options, joints, [{"arm_joint_3": 0.1}, {"arm_joint_3": 0.12}])
    assert low < visited["arm_joint_2"][0] <= visited["arm_joint_2"][1] < high
    asked = argparse.Namespace(**{**vars(options), "poses": 200})
    assert inertias_from(asked, joints, [{"arm_joint_3": 0.1}]) == everywhere


def test_the_poses_of_a_recording_are_spread_over_its_time():
    poses = visited_poses([recording()])
    assert len(poses) == 200
    assert poses[0]["elbow"] == pytest.approx(0.0, abs=1e-2)
    assert poses[-1]["elbow"] == pytest.approx(0.5, abs=1e-2)
    assert visited_poses([]) == []


def test_the_poses_of_two_recordings_are_of_these_and_not_of_the_time_between():
    one = np.arange(0, 10_000_000_000, 10_000_000)
    stamps = np.concatenate([one, one + 10**15])
    position = np.sin(stamps % 10**12 * 1e-9)
    series = JointSeries("elbow", stamps, position, position, stamps, position)
    visited = [pose["elbow"] for pose in visited_poses([series])]
    assert np.quantile(visited, [0.1, 0.9]) == pytest.approx(
        np.quantile(position, [0.1, 0.9]), abs=0.05
    )


@pytest.mark.parametrize(
    ("series", "words"),
    [
        (
            JointSeries("j", np.arange(3) * MS, np.zeros(3), np.ones(3), np.arange(3), np.ones(3)),
            "3 states",
        ),
        (
            JointSeries(
                "j", np.arange(20) * MS, np.ones(20), np.ones(20), np.arange(20), np.ones(20)
            ),
            "zero throughout",
        ),
    ],
)
def test_recordings_that_say_nothing_are_refused(series, words):
    with pytest.raises(SettingError, match=words):
        loop_statistics(series, 0.005)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a run: parameter files of its controllers and its bag."""
    from hpid_ros.base.files import share_folder
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.experiment.in_process import run_without_ros, write_run_files
    from hpid_ros.experiment.progress import NoProgress

    folder = tmp_path_factory.mktemp("upgrade")
    document = yaml.safe_load((share_folder() / "config/experiments/tracking.yaml").read_text())
    document |= {"duration": 1.0, "simulation": {"engine": "mujoco", "physics_steps": 2}}
    (folder / "short.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    experiment = load_experiment(folder / "short.yaml")
    write_run_files(folder, experiment, experiment.controllers["PID"])
    run_without_ros(experiment, "PID", folder / "PID", NoProgress())
    return folder


def test_from_recording_to_a_file_that_runs_and_is_certified(result, tmp_path, capsys):
    file = tmp_path / "upgraded.yaml"
    parameters = result / "controllers.yaml"
    command = ["upgrade", str(parameters), "--goal", "fast", "--bag", str(result / "PID")]
    command += ["--urdf", "urdf/mobile_manipulator.urdf", "--poses", "3", "-o", str(file)]
    assert main(command) == DONE
    said = capsys.readouterr()
    assert "Predicted, simulated on the model" in said.out
    assert "simulating the PID and the proposal" in said.err
    before, after = map(settings_from_parameter_file, (parameters, file))
    assert list(before) == list(after)
    for name, settings in after.items():
        assert settings.law == "hpid"
        assert settings.mu < 0.0
        assert settings.gains == before[name].gains
        assert settings.encoder.resolution == pytest.approx(math.tau / 16384, rel=1e-4)
    numbers = [line for line in file.read_text().splitlines() if ": " in line and "#" not in line]
    joints = [settings.joint for settings in after.values()]  # in the section of inertias
    assert [line.split(":")[0].strip() for line in numbers] == ["joints", *joints]
    assert main(["check-gains", str(file)]) == DONE
    assert "exists" in refused(command, capsys)
    own = [*command[:-1], str(parameters), "--force"]
    assert "is an input; name another file with -o" in refused(own, capsys)
    assert list(map(settings_from_parameter_file, (parameters, file))) == [before, after]


def refused(command, capsys):
    capsys.readouterr()
    assert main(command) == BAD_INPUT
    *progress, line = capsys.readouterr().err.strip().splitlines()
    assert all(each.startswith("certified: ") for each in progress)
    return line


def test_a_bag_without_the_joint_is_one_line(result, tmp_path, capsys):
    parameters = {"joint": "elbow", "law": "pid", "inertia": 1.0}
    parameters["gains"] = {"p": 3.0, "i": 1.0, "d": 3.0}
    file = tmp_path / "elbow.yaml"
    file.write_text(yaml.safe_dump({"elbow_controller": {"ros__parameters": parameters}}))
    command = ["upgrade", str(file), "--goal", "fast", "-o", str(tmp_path / "new.yaml")]
    assert "elbow" in refused([*command, "--bag", str(result / "PID")], capsys)
    assert main(command) == DONE  # and without the bag it works
    assert "cannot write" in refused([*command[:-1], "/proc/new.yaml"], capsys)
