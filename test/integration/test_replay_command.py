"""``hpid replay``: what was recorded against what the law answers."""

import shutil

import pytest
import yaml

from hpid_ros.bags import BagReader, BagWriter
from hpid_ros.bags.metadata import PARAMETERS, custom_data
from hpid_ros.cli.main import main
from hpid_ros.wire import JointStateTemplate, decode_joint_state


@pytest.fixture
def bag(experiment_file, tmp_path):
    """The bag of a short run in this process."""
    folder = tmp_path / "result"
    options = ["--in-process", "--no-figures", "--output", str(folder)]
    assert main(["compare", str(experiment_file()), *options]) == 0
    return folder / "bags" / "hPID"


def replay(capsys, *arguments):
    """Return exit code, output and errors."""
    capsys.readouterr()
    code = main(["replay", *map(str, arguments)])
    told = capsys.readouterr()
    return code, told.out, told.err


def rewritten(bag, target, change, keeps_parameters=True):
    """Write a bag again, with each message as ``change(topic, raw)`` gives it; None drops it."""
    metadata = {PARAMETERS: custom_data(bag)[PARAMETERS]} if keeps_parameters else {}
    with BagReader(bag) as reader, BagWriter(target, metadata=metadata) as writer:
        topics = {name: writer.add_topic(name, each.type) for name, each in reader.topics.items()}
        for message in reader.messages():
            raw = change(message.topic, message.raw)
            if raw is not None:
                writer.write(topics[message.topic], message.log_time_ns, raw)
    return target


def test_every_command_of_a_run_is_the_laws(bag, capsys):
    code, out, _ = replay(capsys, bag)
    assert code == 0
    assert "arm_joint_6: 301 commands, every one the law's" in out
    assert out.splitlines()[-1] == "every one of 2 408 commands is the law's, to the last bit"


def test_one_joint_alone(bag, capsys):
    code, out, _ = replay(capsys, bag, "--joint", "arm_joint_2")
    assert code == 0
    assert out.splitlines()[-1] == "every one of 301 commands is the law's, to the last bit"


def test_a_tampered_command_is_named(bag, tmp_path, capsys):
    def change(topic, raw):
        fields = decode_joint_state(raw) if topic == "/joint_commands" else None
        if fields is None or fields.names != ("arm_joint_2",) or fields.stamp_ns != 100_000_000:
            return raw
        template = JointStateTemplate(fields.names, fields.frame_id, effort=True)
        return template.encode(fields.stamp_ns, effort=[1.5])

    code, out, _ = replay(capsys, rewritten(bag, tmp_path / "bag", change))
    assert code == 1
    assert "arm_joint_2: 1 of 301 commands differ" in out
    assert "at 0.100 s: 1.5 N m was sent, the law answers " in out
    assert out.splitlines()[-1] == "2 407 of 2 408 commands are the law's"


def test_other_parameters_are_another_law(bag, tmp_path, capsys):
    document = yaml.safe_load(custom_data(bag)[PARAMETERS])
    document["/**/arm_joint_3_controller"]["ros__parameters"]["mu"] = 0.0
    file = tmp_path / "controllers.yaml"
    file.write_text(yaml.safe_dump(document))
    code, out, _ = replay(capsys, bag, "--params", file)
    assert code == 1
    assert "arm_joint_3: 3" in out
    assert "arm_joint_4: 301 commands, every one the law's" in out


def test_what_is_missing_is_said_in_one_line(bag, tmp_path, capsys):
    def kept(topic, raw):
        return raw

    bare = rewritten(bag, tmp_path / "bare", kept, keeps_parameters=False)
    code, _, err = replay(capsys, bare)
    assert (code, err.count("\n")) == (2, 1)
    assert "does not hold its controllers' parameters" in err
    code, _, err = replay(capsys, bag, "--joint", "elbow")
    assert (code, err.count("\n")) == (2, 1)
    assert "elbow" in err
    code, _, err = replay(capsys, tmp_path / "nothing")
    assert (code, err.count("\n")) == (2, 1)

    def without_commands(topic, raw):
        return None if topic == "/joint_commands" else raw

    quiet = rewritten(bag, tmp_path / "quiet", without_commands)
    code, _, err = replay(capsys, quiet)
    assert (code, err.count("\n")) == (2, 1)
    assert "no command for" in err
    damaged = tmp_path / "damaged"
    shutil.copytree(bag, damaged)
    (damaged / "metadata.yaml").write_text("{")
    code, _, err = replay(capsys, damaged)
    assert code == 2
