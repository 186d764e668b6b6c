"""Documents that extend others: merged wherever they are read, refused where they cannot be."""

import hashlib
from pathlib import Path

import pytest
import yaml

from hpid_bench.experiment.description import load_experiment, load_reference
from hpid_ros.base.errors import ExperimentError, SettingError, TrajectoryError
from hpid_ros.base.resources import share_folder
from hpid_ros.base.yaml_files import MOST_EXTENDED, load_document
from hpid_ros.simulation.world_file import world_of

PAPER = share_folder() / "config" / "experiments" / "paper.yaml"


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file and returns its path."""

    def written(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return written


def values(path):
    return load_document(path, ExperimentError).values


def test_mappings_are_merged_and_all_else_is_replaced(write):
    write("base.yaml", "a: {x: 1, y: [1, 2, 3], z: {q: 1}}\nb: 2\nc: 3\n")
    path = write("own.yaml", "extends: base.yaml\na: {y: [9], z: {r: 2}, w: 0}\nb: {n: 1}\nd: 4\n")
    found = values(path)
    assert found == {
        "a": {"x": 1, "y": [9], "z": {"q": 1, "r": 2}, "w": 0},
        "b": {"n": 1},
        "c": 3,
        "d": 4,
    }
    assert list(found) == ["a", "b", "c", "d"]
    assert list(found["a"]) == ["x", "y", "z", "w"]


def test_null_removes_a_key_and_only_one_that_is_there(write):
    write("base.yaml", "a: {x: 1, y: 2}\nb: 2\n")
    assert values(write("own.yaml", "extends: base.yaml\na: {x: null}\nb: null\n")) == {
        "a": {"y": 2}
    }
    path = write("wrong.yaml", "extends: base.yaml\na: {xx: null}\n")
    with pytest.raises(ExperimentError, match=r"wrong.yaml: null removes nothing: .*'a.xx'") as e:
        values(path)
    assert "\n" not in str(e.value)


def test_a_chain_is_merged_from_its_end_on_and_each_link_is_looked_for_beside_it(write):
    write("below/root.yaml", "a: 1\nb: 1\nc: 1\n")
    write("below/middle.yaml", "extends: root.yaml\nb: 2\nc: 2\n")
    path = write("top.yaml", "extends: below/middle.yaml\nc: 3\n")
    document = load_document(path, ExperimentError)
    assert document.values == {"a": 1, "b": 2, "c": 3}
    assert [file.name for file in document.files] == ["top.yaml", "middle.yaml", "root.yaml"]
    assert [folder.name for folder in document.folders] == [path.parent.name, "below"]
    assert yaml.safe_load(document.text) == document.values


def test_a_file_that_extends_nothing_is_itself_to_the_byte(write):
    path = write("alone.yaml", "# a comment\nb: 1.0e-3   # and another\n")
    assert load_document(path, ExperimentError).text == path.read_text()


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"a.yaml": "extends: a.yaml\n"}, "a.yaml -> a.yaml"),
        (
            {"a.yaml": "extends: b.yaml\n", "b.yaml": "extends: a.yaml\n"},
            "a.yaml -> b.yaml -> a.yaml",
        ),
        ({"a.yaml": "extends: nowhere.yaml\n"}, "there is no file nowhere.yaml (looked in "),
        ({"a.yaml": f"extends: {'x' * 10_000}\n"}, "there is no file x"),
        ({"a.yaml": 'extends: "nothing\\0"\n'}, "there is no file nothing"),
        ({"a.yaml": "extends: .\n"}, "there is no file ."),
        ({"a.yaml": "extends: [b.yaml, c.yaml]\n"}, "extends must name one file"),
        ({"a.yaml": "extends: b.yaml\n", "b.yaml": "- 1\n"}, "is not a mapping"),
        ({"a.yaml": "extends: b.yaml\n", "b.yaml": "a: [\n"}, "cannot read"),
    ],
)
def test_what_cannot_be_extended_is_refused_in_one_line(write, files, words):
    first, *_ = [write(name, text) for name, text in files.items()]
    with pytest.raises(ExperimentError) as refusal:
        values(first)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 1000


def test_a_link_to_itself_is_no_file(tmp_path):
    (tmp_path / "link.yaml").symlink_to("link.yaml")
    with pytest.raises(ExperimentError, match=r"link.yaml: too many levels of symbolic links"):
        values(tmp_path / "link.yaml")


def test_a_shared_experiment_is_found_by_its_name_and_one_beside_it_goes_first(write):
    path = write("own.yaml", "extends: paper.yaml\nname: own\n")
    assert values(path) == yaml.safe_load(PAPER.read_text()) | {"name": "own"}
    assert values(write("other.yaml", "extends: config/experiments/paper.yaml\n"))["name"]
    write("paper.yaml", "name: mine\n")
    assert values(path) == {"name": "own"}


def test_the_digest_covers_what_is_extended(write):
    base = write("base.yaml", PAPER.read_text())
    path = write("own.yaml", "extends: base.yaml\nname: own\n")
    before = load_experiment(path).digest
    base.write_text(PAPER.read_text() + "# only a comment\n")
    assert load_experiment(path).digest == before
    base.write_text(PAPER.read_text().replace("duration: 9.0", "duration: 8.0"))
    assert load_experiment(path).digest != before


def test_the_digest_of_a_file_that_extends_nothing_is_that_of_its_bytes():
    experiment = load_experiment(PAPER, "pybullet")  # any other engine counts, too
    robot = Path(experiment.world.robot_description).read_text()
    digest = hashlib.sha256(PAPER.read_bytes() + robot.encode()).hexdigest()
    assert experiment.digest == digest


def test_a_robot_is_looked_for_beside_every_file_of_the_chain(write):
    robot = share_folder() / "urdf" / "mobile_manipulator.urdf"
    write("below/robot.urdf", robot.read_text())
    changed = PAPER.read_text().replace("urdf/mobile_manipulator.urdf", "robot.urdf")
    write("below/base.yaml", changed)
    path = write("own.yaml", "extends: below/base.yaml\nname: own\n")
    found = load_experiment(path).world.robot_description
    assert Path(found).parent.name == "below"


BAD = {
    "unknown key": ("robot: {paylod: 2.0}", "unknown key 'robot.paylod'"),
    "unknown joint": (
        "controllers: {joints: {arm_joint_9: {inertia: 1.0}}}",
        "controllers.joints: unknown joint 'arm_joint_9'",
    ),
    "in a list": (
        "disturbances: {payload: [{time: -1.0, mass: 1.0}]}",
        "disturbances.payload[0].time must lie in",
    ),
    "parameter out of range": (
        "compare: {hPID: {mu: 0.5}}",
        "compare.hPID.mu: controller 'hPID', joint ",
    ),
    "parameter of one joint": (
        "controllers: {joints: {arm_joint_1: {gains: {p: many}}}}",
        "controllers.joints.arm_joint_1.gains.p: controller ",
    ),
}


@pytest.mark.parametrize(("bad", "words"), BAD.values(), ids=BAD)
def test_a_bad_entry_is_blamed_on_the_file_that_has_it(write, bad, words):
    base = write("base.yaml", f"extends: paper.yaml\n{bad}\n")
    # It touches the same sections, so that the section alone says nothing.
    path = write(
        "own.yaml",
        "extends: base.yaml\nrobot: {fixed_base: false}\ncompare: {hPID: {takeover_time: 0.1}}\n"
        "controllers: {joints: {arm_joint_1: {velocity_filter_time_constant: 0.01}}}\n",
    )
    with pytest.raises(ExperimentError) as refusal:
        load_experiment(path)
    assert str(refusal.value).startswith(f"{base}: ")
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_bad_entry_that_is_overridden_is_nobody_s_fault_and_a_worse_one_the_upper_file_s(write):
    write("base.yaml", "extends: paper.yaml\nrobot: {payload: -1.0}\nseed: few\n")
    path = write("own.yaml", "extends: base.yaml\nrobot: {payload: 0.5}\nseed: 2\n")
    assert load_experiment(path).world.payload_mass == 0.5
    write("own.yaml", "extends: base.yaml\nrobot: {payload: -2.0}\nseed: 2\n")
    with pytest.raises(ExperimentError, match=r"own\.yaml: robot.payload .* not -2.0"):
        load_experiment(path)


def test_whoever_reads_only_a_part_blames_the_same_file(write):
    write("base.yaml", "extends: paper.yaml\nreference: {kind: none}\nrobot: {payload: -1}\n")
    path = write("own.yaml", "extends: base.yaml\nreference: {}\nrobot: {}\n")
    with pytest.raises(TrajectoryError, match=r"base\.yaml: reference.kind: unknown kind 'none'"):
        load_reference(path)
    write("base.yaml", "extends: paper.yaml\nreference: {kind: null}\n")
    with pytest.raises(ExperimentError, match=r"base\.yaml: reference.kind is missing"):
        load_experiment(path)
    write("base.yaml", "extends: paper.yaml\nrobot: {payload: -1}\n")
    document = load_document(write("own.yaml", "extends: base.yaml\nname: own\n"), SettingError)
    with pytest.raises(SettingError, match=r"base\.yaml: robot.payload must be"):
        world_of(document.values, document)


def test_of_names_that_begin_alike_the_longest_is_meant(write):
    write("base.yaml", "compare: {PID: {a: 1}, PID 2: {a: 1}, PID.2: {b: {c: 1}}}\nseed: 1\n")
    path = write("own.yaml", "extends: base.yaml\ncompare: {PID: {b: 1}}\nseeds: 1\n")
    document = load_document(path, ExperimentError)
    for line, name in {
        "compare.PID.a is wrong": "base.yaml",
        "compare.PID.b is wrong": "own.yaml",
        "compare.PID 2.a is wrong": "base.yaml",
        "compare.PID.2.b.c is wrong": "base.yaml",
        "compare.PID.other is wrong": "own.yaml",
        "seed is wrong": "base.yaml",
        "seeds is wrong": "own.yaml",
        "something else is wrong": "own.yaml",
    }.items():
        assert document.blamed(line).name == name, line


def test_a_chain_of_files_has_an_end(write):
    write(f"{MOST_EXTENDED - 1}.yaml", "a: 1\n")
    for k in range(MOST_EXTENDED - 1):
        write(f"{k}.yaml", f"extends: {k + 1}.yaml\n")
    assert values(write("0.yaml", "extends: 1.yaml\n")) == {"a": 1}
    path = write("first.yaml", "extends: 0.yaml\n")
    with pytest.raises(ExperimentError, match=r"first.yaml: extends: more than 16 files in a row"):
        values(path)
