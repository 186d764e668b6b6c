"""``hpid upgrade BAG``: from one recording to parameters, a page and a prediction that holds."""

import json
import shutil

import numpy as np
import pytest
import yaml
from harness.bags import (
    MS,
    BagReader,
    command,
    odometry,
    parameter_event,
    ramp,
    state,
    trajectory,
    write_bag,
)

from hpid_bench.cli.main import main
from hpid_bench.cli.options import parameter_file
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_bench.tuning.upgrade_prediction import Prediction, _ran, read_prediction
from hpid_ros.base.resources import share_folder
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY, custom_data, missed_entries
from hpid_ros.messages.writer import BagWriter

DONE, FAILED, BAD_INPUT = 0, 1, 2
LINK = """<link name="{name}"><inertial><origin xyz="{at} 0 0"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="60" velocity="9"/></joint>"""
URDF = "\n".join(
    [
        '<robot name="two_links"><link name="stand"/>',
        LINK.format(name="upper", at=0.15, mass=2.0, i=0.02),
        LINK.format(name="lower", at=0.1, mass=1.0, i=0.006),
        JOINT.format(name="shoulder", parent="stand", child="upper", at=0.0),
        JOINT.format(name="elbow", parent="upper", child="lower", at=0.3),
        "</robot>",
    ]
)
TRUTH = {
    "shoulder": {"rotor_inertia": 8e-6, "gear_ratio": 100, "damping": 0.3, "friction": 0.4},
    "elbow": {"rotor_inertia": 3e-6, "gear_ratio": 100, "damping": 0.1, "friction": 0.15},
}
NOISE = 3e-6  # [rad]
DELAY = 1  # control periods
GAINS = {"shoulder": {"p": 80.0, "i": 240.0, "d": 8.0}, "elbow": {"p": 16.0, "i": 50.0, "d": 1.6}}


def experiment(folder, name, controllers, seed):
    """Return an experiment on the true robot, with these parameters of each joint."""
    (folder / "two_links.urdf").write_text(URDF)
    chance = np.random.default_rng(3)
    places = {name: [0.0, *map(float, chance.uniform(-0.7, 0.7, 7))] for name in TRUTH}
    document = {
        "name": name,
        "duration": 7.0,
        "seed": seed,
        "robot": {"description": "two_links.urdf", "fixed_base": True, "joints": TRUTH},
        "control": {"rate": 500},
        "simulation": {"engine": "mujoco"},
        "sensors": {"noise": NOISE, "encoder_counts": 2**21},
        "actuators": {"delay": DELAY},
        "reference": {"kind": "step", "times": [float(k) for k in range(8)], "positions": places},
        "controllers": {"joints": controllers},
        "compare": {"one": {}, "other": {}},
    }
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    return load_experiment(folder / f"{name}.yaml")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a robot and its recording under a PID."""
    folder = tmp_path_factory.mktemp("upgrade")
    pid = {name: {"law": "pid", "gains": gains} for name, gains in GAINS.items()}
    run_without_ros(experiment(folder, "pid", pid, 1), "one", folder / "before", NoProgress())
    return folder


@pytest.fixture(scope="module")
def upgraded(place):
    """Upgrade it by one command; return the folder."""
    assert upgrade(place / "before", "--urdf", place / "two_links.urdf", out=place) == DONE
    return place


def upgrade(*arguments, out):
    return main(["upgrade", *map(str, arguments), "-o", str(out / "upgrade.yaml")])


@pytest.fixture(scope="module")
def after(upgraded):
    """Return the recording of the same robot under what was proposed."""
    loops = parameter_file(upgraded / "upgrade.yaml").loops.values()
    proposed = {each.joint: dict(each.to_parameters()) for each in loops}
    for parameters in proposed.values():
        parameters.pop("joint")
    again = experiment(upgraded, "hpid", proposed, 2)
    run_without_ros(again, "one", upgraded / "after", NoProgress())
    return upgraded / "after"


def test_one_command_gives_parameters_a_page_and_a_prediction(upgraded):
    place = upgraded
    found = {each.joint: each for each in parameter_file(place / "upgrade.yaml").loops.values()}
    assert list(found) == list(GAINS)
    for name, settings in found.items():
        assert vars(settings.gains) == GAINS[name]
        assert settings.law == "hpid"
        assert settings.mu < 0.0
    assert len({each.norm.effort_scale for each in found.values()}) == 1  # one norm in N m
    page = (place / "upgrade.html").read_text()
    for title in ("was found", "is assumed", "will change", "to try first"):
        assert f'data-tab="What {title}"' in page
    assert "<script src" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    prediction = read_prediction(place / "upgrade.json")
    for key in ("ivc", "itae"):
        assert prediction.total(key).ratio < 0.98
        assert prediction.total(key).fidelity == pytest.approx(1.0, abs=0.1)


def test_the_prediction_comes_true(upgraded, after, capsys):
    place = upgraded
    assert verified(place, place / "before", after) == DONE
    said = capsys.readouterr().out
    assert "The prediction held" in said
    assert "!" not in said


def verified(folder, before, after):
    arguments = ["--verify", before, after, "--prediction", folder / "upgrade.json"]
    return main(["upgrade", *map(str, arguments)])


def changed_prediction(place, folder, **changes):
    """Write the prediction with other numbers of each index: functions of what it says."""
    document = json.loads((place / "upgrade.json").read_text())
    for joint in document["joints"].values():
        for name, index in joint["indices"].items():
            index["ratio"] = changes.get(name, float)(index["ratio"])
    (folder / "upgrade.json").write_text(json.dumps(document))


def test_a_prediction_that_is_wrong_is_told(upgraded, after, tmp_path, capsys):
    changed_prediction(upgraded, tmp_path, itae=lambda ratio: 1.3 * ratio)
    assert verified(tmp_path, upgraded / "before", after) == FAILED
    assert "did NOT hold" in capsys.readouterr().out


def test_an_after_that_ran_something_else_is_told_even_where_the_numbers_agree(
    upgraded, tmp_path, capsys
):
    same = dict.fromkeys(("ivc", "iavc", "itae"), lambda ratio: 1.0)
    changed_prediction(upgraded, tmp_path, **same)
    assert verified(tmp_path, upgraded / "before", upgraded / "before") == FAILED
    said = " ".join(capsys.readouterr().out.split())
    assert "shoulder did not run what was proposed: law 'pid' for 'hpid'" in said
    assert "NOT tested: something else ran (IVC +0.0%, ITAE +0.0%)" in said


@pytest.mark.parametrize(("name", "value"), [("mu", 0.0), ("norm.floor", 0.5)])
def test_parameters_that_were_set_while_it_ran_are_something_else(
    upgraded, after, tmp_path, capsys, name, value
):
    with (
        BagReader(after) as old,
        BagWriter(tmp_path / "bag", metadata=custom_data(after)) as new,
    ):
        topics = {each.topic: new.add_topic(each.topic, each.msgtype) for each in old.connections}
        event = parameter_event("/elbow_controller", **{name: value})
        events = new.add_topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
        for k, (topic, log_time_ns, raw) in enumerate(old.messages()):
            new.write(topics[topic], log_time_ns, raw)
            if k == 2000:
                new.write(events, log_time_ns, event)
    assert verified(upgraded, upgraded / "before", tmp_path / "bag") == FAILED
    said = " ".join(capsys.readouterr().out.split())
    assert f"while it ran, /elbow_controller was set: {name} = {value:g}" in said
    assert "NOT tested: something else ran" in said


def test_the_norm_of_a_joint_that_keeps_its_pid_does_not_matter(place):
    kept = {"elbow": {"law": "pid", "norm.floor": 0.5}}
    assert _ran(Prediction("before", "fast", {}, kept), place / "before") == ((), ())


def refused(capsys, *arguments):
    capsys.readouterr()
    assert main(["upgrade", *map(str, arguments)]) == BAD_INPUT
    return capsys.readouterr().err.strip().splitlines()[-1]


def with_custom_data(bag, folder, change):
    """Copy a bag with other texts in its metadata; ``change`` takes them as a mapping."""
    copy = shutil.copytree(bag, folder / "bag")
    metadata = yaml.safe_load((copy / "metadata.yaml").read_text())
    change(metadata["rosbag2_bagfile_information"]["custom_data"])
    (copy / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    return copy


def test_a_bag_without_parameters_says_what_to_give(place, tmp_path, capsys):
    bare = with_custom_data(place / "before", tmp_path, dict.clear)
    for file in bare.glob("*.mcap"):
        file.write_bytes(
            file.read_bytes().replace(CONTROLLERS_ENTRY.encode(), b"x" * len(CONTROLLERS_ENTRY))
        )
    new = ["--urdf", place / "two_links.urdf", "-o", tmp_path / "new.yaml"]
    assert "give them with --params FILE" in refused(capsys, bare, *new)
    assert not list(tmp_path.glob("new.*"))


def test_wheels_on_which_the_robot_rolled_are_left_out(tmp_path, capsys):
    wheels = ("wheel_left_joint", "wheel_right_joint")
    log = []
    for k in range(200):
        turned = dict.fromkeys(wheels, 0.01 * k)
        log += [state(k * 5 * MS, **turned), odometry(k * 5 * MS, 0.001 * k)]
    bag, params = write_bag(tmp_path / "bag", log), tmp_path / "pid.yaml"
    pid = {"law": "pid", "gains": {"p": 12.0, "d": 1.2}}
    nodes = {f"{each}_controller": {"ros__parameters": {"joint": each, **pid}} for each in wheels}
    params.write_text(yaml.safe_dump(nodes))
    urdf = share_folder() / "urdf" / "mobile_manipulator.urdf"  # of a base that is not held
    new = ["--params", params, "-o", tmp_path / "new.yaml"]
    line = refused(capsys, bag, "--urdf", urdf, *new)
    assert f"left out: {', '.join(wheels)}: the robot rolled on it (0.2 m and 0 rad" in line


def test_a_controller_that_never_ran_is_left_out(place, tmp_path, capsys):
    log = []
    for k in range(200):
        log += [state(k * 5 * MS, shoulder=0.01 * k, elbow=0.0), command(k * 5 * MS, shoulder=1.0)]
    bag, params = write_bag(tmp_path / "bag", log), tmp_path / "pid.yaml"
    pid = {"joint": "elbow", "law": "pid", "gains": {"p": 12.0, "d": 1.2}}
    params.write_text(yaml.safe_dump({"elbow_controller": {"ros__parameters": pid}}))
    new = ["--urdf", place / "two_links.urdf", "--params", params, "-o", tmp_path / "new.yaml"]
    line = refused(capsys, bag, *new)
    assert "left out: elbow: the recording has no effort or reference of it" in line


def test_a_bag_without_efforts_is_one_line(place, tmp_path, capsys):
    states = [state(k * 5 * MS, shoulder=0.01 * k, elbow=0.0) for k in range(200)]
    motion = trajectory(0, ramp("shoulder", t0=0.0, t1=2.0))
    pid = {"joint": "shoulder", "law": "pid", "gains": GAINS["shoulder"]}
    params = tmp_path / "pid.yaml"
    params.write_text(yaml.safe_dump({"shoulder_controller": {"ros__parameters": pid}}))
    bag = write_bag(tmp_path / "bag", [motion, *states])
    new = ["--urdf", place / "two_links.urdf", "--params", params, "-o", tmp_path / "new.yaml"]
    line = refused(capsys, bag, *new)
    assert "has no efforts of shoulder (no effort was recorded)" in line


def test_where_the_model_is_wrong_nothing_is_proposed(place, tmp_path, capsys):
    missed = missed_entries({"/joint_states": 7}, 0.0)
    bag = with_custom_data(place / "before", tmp_path, lambda own: own.update(missed))
    nodes = {}
    for name, gains in GAINS.items():  # eight times those that ran
        pid = {"joint": name, "law": "pid", "gains": {k: 8.0 * v for k, v in gains.items()}}
        nodes[f"{name}_controller"] = {"ros__parameters": pid}
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(nodes))
    options = ["--params", tmp_path / "other.yaml", "--urdf", place / "two_links.urdf"]
    assert upgrade(bag, *options, "--goal", "smooth", out=tmp_path) == FAILED
    said = " ".join(capsys.readouterr().out.split())
    assert "Nothing is proposed: the simulation of your PID is far from what was recorded" in said
    assert [each.name for each in tmp_path.glob("upgrade.*")] == ["upgrade.html"]
    page = (tmp_path / "upgrade.html").read_text()
    assert f"--params {tmp_path / 'other.yaml'}" in page
    for text in (said, page):
        assert "the recorder missed 7 messages on /joint_states" in text


def test_what_is_not_for_a_bag_or_in_the_way_is_one_line(upgraded, after, tmp_path, capsys):
    bag, new = upgraded / "before", ["-o", tmp_path / "new.yaml"]
    robot = ["--urdf", upgraded / "two_links.urdf"]
    (tmp_path / "other.json").write_text("{}")
    verify = ["--verify", bag, bag]
    cases = [
        ([bag, *new], "a BAG needs --urdf"),
        ([bag, *robot, "--bag", bag, *new], "--bag is for a parameter FILE"),
        ([bag, *robot, "--inertia", "1", *new], "--inertia and --poses"),
        ([bag, *robot, "-o", tmp_path / "new.html"], "must end in .yaml"),
        ([bag, *robot, "-o", upgraded / "upgrade.yaml"], "exists"),
        ([bag, *robot, "-o", bag / "metadata.yaml", "--force"], "input"),
        ([], "needs a parameter FILE"),
        (["--prediction", "x"], "--prediction is for --verify"),
        (["x.yaml"], "there is no parameter file and no bag x.yaml"),
        ([upgraded / "pid.yaml"], "--goal is missing"),
        (["x.yaml", "--goal", "fast", "--params", "y.yaml"], "--params is for a BAG"),
        ([*verify, "--goal", "fast"], "nothing else, not --goal"),
        ([*verify, "--prediction", tmp_path / "other.json"], "no prediction that"),
        ([after, *robot, *new], "was not recorded under a PID"),
    ]
    for arguments, words in cases:
        assert words in refused(capsys, *arguments)
    assert not list(tmp_path.glob("new.*"))


def test_motions_that_differ_are_not_compared(upgraded, tmp_path, capsys):
    log = [trajectory(0, ramp("shoulder", t0=0.0, t1=1.0)), trajectory(0, ramp("elbow", t1=1.0))]
    for k in range(1, 400):
        stamp = 2_000_000 * k
        log += [state(stamp, shoulder=0.1, elbow=0.2), command(stamp, shoulder=1.0, elbow=2.0)]
    other = write_bag(tmp_path / "other", log)
    arguments = ["--verify", upgraded / "before", other, "--prediction"]
    assert "cannot be compared" in refused(capsys, *arguments, upgraded / "upgrade.json")
