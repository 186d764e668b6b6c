"""The JSON Schema of experiment files says of them what their reader says."""

import json

import jsonschema
import pytest
import yaml
from harness.experiments import changed
from harness.places import ROOT

from hpid_ros.base.errors import ExperimentError
from hpid_ros.cli.main import main
from hpid_ros.experiment.description import experiment_schema, load_experiment

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
