"""Experiment files: what they give, how bad ones are refused, and the schema that says so, too."""

import json
import math
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
import yaml
from harness.experiments import changed
from harness.places import ROOT

from hpid_bench.cli.main import main
from hpid_bench.experiment.description import experiment_schema, load_experiment
from hpid_bench.experiment.in_process import write_reference
from hpid_bench.experiment.processes import parameters
from hpid_ros.base.errors import ExperimentError, TrajectoryError
from hpid_ros.base.yaml_files import load_document
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
    assert {each.encoder.encoder_resolution for each in loops} == {math.tau / 1000}
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
        document.values, "reference", lambda section: section.load(RobotDescription.load)
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
        ({"compare__hPID": {"gains": {"i": 9e5}}}, "the loop is unstable"),
        ({"duration": 0.0005}, "not a whole number of control periods"),
        ({"robot__description": "none.urdf"}, "there is no file none.urdf"),
        ({"robot__initial_positions": {"arm_joint_1": 99.0}}, "not within its limits"),
        ({"reference__kind": "sinus"}, "did you mean 'sine'"),
        ({"reference__positions": {"elbow": [0.0, 1.0, 0.0, 0.0, 0.0]}}, "unknown joint 'elbow'"),
        ({"controllers__joints": {"arm_joint_7": {}}}, "did you mean 'arm_joint_"),
        ({"compare__PID__joints": {"arm_joint_9": {}}}, "compare.PID.joints: unknown joint"),
        ({"judge": {"joints": ["arm_joint_9"]}}, "judge.joints: unknown joint 'arm_joint_9'"),
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


@pytest.mark.parametrize(("rate", "end_ns"), [(1000, 100_000_000), (300, 99_999_990)])
def test_a_duration_is_whole_periods_of_every_rate(experiment_file, rate, end_ns):
    experiment = load_experiment(experiment_file(control={"rate": rate}, duration=0.1))
    assert experiment.periods == 0.1 * rate
    assert experiment.duration == end_ns / 1e9


def test_an_event_as_a_period_begins_is_of_that_period_at_every_rate(experiment_file):
    changes = [{"time": time, "mass": 1.0} for time in (0.1, 0.1001)]
    push = {"link": "payload", "from": 0.1, "duration": 0.01}
    path = experiment_file(
        control={"rate": 300},
        duration=0.2,
        disturbances={"payload": changes, "wrenches": [push]},
        scene={"grips": [{"time": 0.1, "closed": True}]},
    )
    world = load_experiment(path).world
    begins_ns = [each.start_ns for each in world.disturbances.in_order()]
    assert begins_ns == [99_999_990, 99_999_990, 100_100_000]
    assert world.workplace.grips[0].time_ns == 99_999_990


def test_what_a_model_has_and_nothing_drives_is_locked(experiment_file, tmp_path):
    text = (ROOT / "urdf" / "mobile_manipulator.urdf").read_text()
    joint = (
        '<joint name="more" type="continuous"><parent link="tool0"/><child link="more"/></joint>'
    )
    model = tmp_path / "more.urdf"
    model.write_text(text.replace("</robot>", f'<link name="more"/>{joint}</robot>'))
    given = {"compensation": "gravity", "model.description": str(model)}
    experiment = load_experiment(experiment_file(controllers__common=given))
    assert experiment.controllers["PID"][0].model.locked == ("more",)
    given["model.locked_joints"] = "arm_joint_6"
    path = experiment_file(controllers__common=given)
    with pytest.raises(ExperimentError, match=r"common\.model\.locked_joints: .* lacks more"):
        load_experiment(path)


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


FILES = sorted((ROOT / "config" / "experiments").glob("*.yaml"))


@pytest.fixture(scope="module")
def validator():
    schema = experiment_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_the_command_prints_it(capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(experiment_schema()))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_experiment_fits(file, validator):
    validator.validate(yaml.safe_load(file.read_text()))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("speed", 1.0),
        ("robot.payload", -1.0),
        ("robot.joints", {"arm_joint_1": {"friktion": 1.0}}),
        ("simulation.physics_steps", 0),
        ("seed", "one"),
        ("sensors.noise", {"arm_joint_1": "much"}),
        ("disturbances.payload", {"time": 1.0}),
        ("disturbances.wrenches", [{"link": "tool0", "from": 0.0}]),
        ("scene.bricks", {"a": {"size": [1.0, 1.0], "position": [0.0, 0.0, 0.0]}}),
        ("reference.kind", "polynomial"),
        ("controllers.common", {"gains": {"q": 1.0}}),
        ("compare", {"PID": {"joints": {"arm_joint_1": {"law": "PID"}}}}),
        ("compare", {}),
        ("judge", {"joints": []}),
    ],
)
def test_what_the_reader_refuses_the_schema_refuses(path, value, validator, tmp_path):
    document = yaml.safe_load((ROOT / "config" / "experiments" / "tracking.yaml").read_text())
    assert "extends" not in document
    validator.validate(document)
    changed(document, **{path.replace(".", "__"): value})
    assert not validator.is_valid(document)
    file = tmp_path / "wrong.yaml"
    file.write_text(yaml.safe_dump(document))
    with pytest.raises(ExperimentError):
        load_experiment(file)


@pytest.mark.parametrize(
    ("changes", "is_good"),
    [
        ({"compare": {"PID": None}}, True),
        ({"reference": {"kind": "step", "positions": None}}, True),
        ({"actuators": {"motor": {"resistance": 2.0}}}, True),
        ({"actuators": {"motor": {"resistance": 0.0}}}, False),
        ({"disturbance": {}}, False),
        ({"sensors": {"noise": {"arm_joint_1": "much"}}}, False),
    ],
)
def test_a_file_that_extends_another_one_may_say_as_little_as_it_likes(
    changes, is_good, validator
):
    assert validator.is_valid({"extends": "tracking.yaml", **changes}) == is_good
