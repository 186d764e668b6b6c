"""Experiment files: what they give, and how bad ones are refused."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from hpid_ros.base.errors import ExperimentError, TrajectoryError
from hpid_ros.base.yaml_files import load_document
from hpid_ros.experiment.description import load_experiment
from hpid_ros.experiment.in_process import write_reference
from hpid_ros.experiment.processes import parameters
from hpid_ros.motion.references import planned_reference
from hpid_ros.robot.description import RobotDescription


def test_later_layers_win(experiment_file):
    path = experiment_file(
        controllers__common__mu=0.1,
        controllers__joints__arm_joint_1__mu=0.2,
        compare__hPID={"mu": 0.3},
        compare__PID={"law": "pid", "joints": {"arm_joint_3": {"mu": 0.4, "gains": {"p": 99.0}}}},
    )
    experiment = load_experiment(path)
    assert {each.mu for each in experiment.controllers["hPID"]} == {0.3}
    by_joint = {each.joint: each for each in experiment.controllers["PID"]}
    assert [by_joint[f"arm_joint_{k}"].mu for k in (1, 2, 3)] == [0.2, 0.1, 0.4]
    (other,) = [e for e in experiment.controllers["hPID"] if e.joint == "arm_joint_3"]
    assert by_joint["arm_joint_3"].gains == replace(other.gains, p=99.0)


def test_judged_joints_are_in_the_robot_s_order_and_all_by_default(experiment_file):
    some = load_experiment(experiment_file(judge={"joints": ["arm_joint_3", "arm_joint_1"]}))
    assert some.judged == ("arm_joint_1", "arm_joint_3")
    every = load_experiment(experiment_file(judge={}))
    assert every.judged == every.world.joints


def test_loops_know_the_robot_s_encoders_and_limits_unless_the_file_says_more(experiment_file):
    own = {"u_clamp_max": 3.0}
    path = experiment_file(sensors__encoder_counts=1000, controllers__joints__arm_joint_2=own)
    loops = load_experiment(path).controllers["PID"]
    assert {each.encoder.resolution for each in loops} == {math.tau / 1000}
    limits = {each.joint: (each.effort.u_clamp_min, each.effort.u_clamp_max) for each in loops}
    assert limits["arm_joint_1"] == (-30.0, 30.0)
    assert limits["arm_joint_2"] == (-45.0, 3.0)


def test_the_reference_is_the_one_that_was_read_whatever_becomes_of_the_file(
    experiment_file, tmp_path
):
    """Several controllers follow it, one after the other."""
    path = experiment_file(duration=0.5)
    experiment = load_experiment(path)
    path.write_text("half a fi: [")
    document = load_document(write_reference(tmp_path, experiment), TrajectoryError)
    again, _ = planned_reference(
        document.values, "reference", lambda name: RobotDescription.load(name)
    )
    assert again == experiment.trajectory


@pytest.mark.parametrize(
    "value", [Path("run #3: é/😀"), "lockstep", True, 0.5, 3, ["a", "b"], "null", "-"]
)
def test_what_a_node_is_given_arrives_as_it_is(value):
    flag, text = parameters(name=value)
    name, _, given = text.partition(":=")
    assert (flag, name) == ("-p", "name")
    assert yaml.safe_load(given) == (str(value) if isinstance(value, Path) else value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"durations": 3.0}, "did you mean 'duration'"),
        ({"compare__hPID": {"mu": 0.5}}, r"controller 'hPID', .*\(-0.5, 0.5\), not 0.5"),
        ({"compare__hPID": {"gains": {"p": float("nan")}}}, "gains.p must lie in"),
        ({"compare__hPID": {"gains": {"i": 9e5}}}, "the loop is unstable"),
        ({"compare": {}}, "compare must name at least one controller"),
        ({"duration": 0.0005}, "not a whole number of control periods"),
        ({"robot__initial_positions": {"arm_joint_1": 99.0}}, "not within its limits"),
        ({"reference__kind": "sinus"}, "did you mean 'sine'"),
        ({"reference__positions": {"elbow": [0.0, 1.0, 0.0, 0.0, 0.0]}}, "unknown joint 'elbow'"),
        ({"controllers__joints": {"arm_joint_7": {}}}, "did you mean 'arm_joint_"),
        ({"compare__PID__joints": {"arm_joint_9": {}}}, "compare.PID.joints: unknown joint"),
        ({"judge": {"joints": ["arm_joint_9"]}}, "judge.joints: unknown joint 'arm_joint_9'"),
        ({"judge": {"joints": []}}, "judge.joints must be a list of joints"),
    ],
)
def test_bad_experiments_are_refused_in_one_line_that_names_the_place(
    experiment_file, changes, message
):
    path = experiment_file(**changes)
    with pytest.raises(ExperimentError, match=message) as refusal:
        load_experiment(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"cannot read .*bad\.yaml: no such file"),
        (b"", "the document must be a mapping, not None"),
        (b"a: [1", "line 1"),
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"1: 2", "must be a mapping"),
    ],
)
def test_files_that_are_no_experiment_are_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ExperimentError, match=message) as refusal:
        load_experiment(path)
    assert "\n" not in str(refusal.value)


def test_the_seed_decides_how_the_encoders_are_mounted(experiment_file):
    def phases(**changes):
        experiment = load_experiment(experiment_file(**changes))
        return [encoder.phase for encoder in experiment.world.encoders]

    assert phases(seed=1) == phases(seed=1) != phases(seed=2)
    assert len(set(phases(seed=1))) == 8
