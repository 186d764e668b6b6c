"""hpid margins: from a file to a table, a document and a picture."""

import json
import math
import re

import pytest
import yaml
from harness.bags import MS, write_bag
from harness.bags import command as command_of
from harness.bags import state as state_of
from harness.bags import trajectory as trajectory_of
from harness.motions import excited_run, multisine

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.main import main
from hpid_ros.base.resources import share_folder
from hpid_ros.control import LoopSettings
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.motion import JointTrajectory, TrajectoryPoint
from hpid_ros.stability.frequency import SampledJoint

PAPER = str(share_folder() / "config" / "experiments" / "paper.yaml")
PARAMETERS = {
    "joint": "elbow",
    "law": "hpid",
    "mu": -0.2,
    "gains": {"p": 21.0, "i": 52.5, "d": 2.1},
    "inertia": 0.105,
    "velocity_source": "filtered",
    "norm": {"effort_scale": 3.0, "floor": 0.1, "type": "canonical"},
}


@pytest.fixture
def file(tmp_path):
    def write(**changes):
        path = tmp_path / "controllers.yaml"
        document = {"elbow_controller": {"ros__parameters": {**PARAMETERS, **changes}}}
        path.write_text(yaml.safe_dump(document))
        return str(path)

    return write


def document_of(arguments, tmp_path, code=DONE):
    path = tmp_path / "margins.json"
    assert main(["margins", *arguments, "--json", str(path), "--force"]) == code
    return json.loads(path.read_text())["loops"]


def test_both_verdicts_stand_side_by_side(file, tmp_path, capsys):
    loops = document_of([file()], tmp_path)
    (loop,) = loops.values()
    out = capsys.readouterr().out
    first, second = (out[out.index(word) :].splitlines() for word in ("loop ", "loop  certified"))
    assert [line.split()[0] for line in first[:4]] == ["loop", "elbow", "at", "as"]
    assert "yes stable" in second[1]
    assert loop["is_certified"]
    assert loop["is_stable_frozen"]
    pid, band = loop["pid"]["worst"], loop["band"]["worst"]
    assert band["disk"] < pid["disk"]
    assert loop["multiplier"] == pytest.approx([2.0**-0.2, 0.1**-0.2])
    assert loop["inertia"] == [0.105, 0.105]
    assert loop["at_rest"]["where"]["disk"] == {
        "inertia": 0.105,
        "multiplier": pytest.approx(0.1**-0.2),
    }
    assert {each["multiplier"] for each in loop["cases"]} >= {1.0, *loop["multiplier"]}


def test_friction_and_delay_of_an_experiment_are_in_its_margins(tmp_path):
    loops = document_of([PAPER, "--joint", "arm_joint_1", "--controller", "PID"], tmp_path)
    assert list(loops) == ["PID arm_joint_1"]
    assert loops["PID arm_joint_1"]["friction"] == 0.5
    changed = document_of(
        [PAPER, "--joint", "arm_joint_1", "--friction", "arm_joint_1=0", "--delay", "0.004"],
        tmp_path,
    )
    assert list(changed) == ["PID arm_joint_1", "hPID arm_joint_1"]
    pid = changed["PID arm_joint_1"]
    assert (pid["friction"], pid["delay"]) == (0.0, 0.004)
    assert pid["pid"]["worst"]["disk"] < loops["PID arm_joint_1"]["pid"]["worst"]["disk"]


def test_a_loop_that_sampling_breaks_is_unstable_and_has_no_margins(file, tmp_path, capsys):
    """Certified as an unsampled loop, and broken where it is sampled: both are said."""
    arguments = [file(control_period=0.02, norm={"floor": 1e-3, "rate_weight": 0.1})]
    loops = document_of([*arguments, "--delay", "0.02"], tmp_path, FAILED)
    out = capsys.readouterr().out
    assert loops["elbow"]["band"]["worst"] is None
    assert loops["elbow"]["band"]["unstable"]
    assert re.search(r"elbow: frozen at lam [\d.]+ [\d.]+ \(norm .* it is unstable", out)
    assert "UNSTABLE" in out
    assert loops["elbow"]["is_certified"]


def test_of_several_loops_there_is_a_picture_each(tmp_path):
    names = ["arm_joint_1", "arm_joint_6"]
    joints = [word for name in names for word in ("--joint", name)]
    options = [*joints, "--controller", "PID", "--plot", str(tmp_path / "m.svg")]
    assert main(["margins", PAPER, *options]) == DONE
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        f"m-PID-{name}.svg" for name in names
    ]


def test_pictures_of_controllers_do_not_replace_each_other(tmp_path, refused):
    file, plot = tmp_path / "mine.yaml", tmp_path / "m.svg"
    file.write_text(f"extends: {PAPER}\nname: mine\ncompare: {{hPID+: {{mu: -0.2}}}}")
    command = ["margins", str(file), "--joint", "arm_joint_1", "--plot", str(plot)]
    assert main(command) == DONE
    drawn = {each.name for each in tmp_path.glob("*.svg")}
    assert drawn == {"m-hPID-arm_joint_1.svg", "m-hPID+-arm_joint_1.svg"}
    file.write_text(
        f"extends: {PAPER}\nname: mine\ncompare: {{a b: {{mu: -0.2}}, a-b: {{mu: -0.2}}}}"
    )
    told = refused(*command, "--force")
    assert "--plot of a b arm_joint_1 and --plot of a-b arm_joint_1 must name different" in told


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Eight seconds of a PID on a joint of 0.105 kg m^2 with friction, excited."""
    flat = {k: v for k, v in PARAMETERS.items() if not isinstance(v, dict)}
    flat |= {f"gains.{term}": value for term, value in PARAMETERS["gains"].items()}
    settings = LoopSettings.from_parameters({**flat, "law": "pid"})
    reference = multisine(8192, 2e-4, range(1, 500), 0.001)
    (series,) = excited_run(settings, SampledJoint(0.105, 0.001, 0.5), reference).joints
    stamps = [int(each) for each in series.state_stamps_ns]
    points = tuple(
        TrajectoryPoint(stamp, (float(x),)) for stamp, x in zip(stamps, reference, strict=True)
    )
    log = [trajectory_of(0, JointTrajectory(("elbow",), points))]
    for stamp, position, effort in zip(stamps, series.position, series.effort, strict=True):
        log += [state_of(stamp, elbow=position), command_of(stamp, elbow=effort)]
    return write_bag(tmp_path_factory.mktemp("bag") / "excited", log)


def test_a_recorded_excitation_lies_on_the_computed_loop(file, bag, tmp_path, capsys):
    plot = tmp_path / "measured.svg"
    arguments = [file(), "--friction", "0.5", "--bag", str(bag), "--plot", str(plot)]
    (loop,) = document_of(arguments, tmp_path).values()
    measured = loop["measured"]
    assert measured["median"] < 0.01
    assert measured["inertia"] == pytest.approx(0.105, rel=0.01)
    assert len(measured["frequency"]) > 50
    assert min(measured["coherence"]) >= 0.95
    out = capsys.readouterr().out
    assert re.search(r"elbow: measured at \d+ of \d+ frequencies, .* inertia of 0.105 kg m", out)
    assert "measured" in plot.read_text()
    assert "hPID, lam frozen in [0.871, 1.58]" in plot.read_text()
    # The same bag against a joint that is another one.
    arguments = [file(inertia=0.0), "--inertia", "0.2", *arguments[1:]]
    (other,) = document_of(arguments, tmp_path).values()
    assert other["measured"]["median"] > 0.3
    assert other["measured"]["inertia"] == pytest.approx(0.105, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "arguments", "words"),
    [
        ({}, ["--joint", "knee"], "unknown joint 'knee'"),
        ({}, ["--controller", "PID"], "--controller is for experiments"),
        ({}, ["--norm-max", "0"], "largest norm must be positive"),
        ({}, ["--friction", "elbow=-1"], "--friction takes B or JOINT=B"),
        ({}, ["--friction", "knee=1"], "unknown joint in --friction 'knee'"),
        ({}, ["--plot", "m.gif"], "--plot must end in .png, .pdf, .svg, not 'm.gif'"),
        ({"inertia": 0.0}, [], "the inertia of 'elbow' is unknown"),
        ({"control_period": 0.002}, ["--bag", "BAG"], "but control_period is 0.002 s"),
        ({}, ["--bag", "BAG", "--coherence", "2"], "coherence must lie in (0, 1)"),
        ({}, ["--bag", "none"], "none"),
        (
            {"compensation": "decoupling", "gains": {"p": 200.0, "i": 500.0, "d": 20.0}},
            ["--bag", "BAG"],
            "cannot be compared",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_two(file, bag, changes, arguments, words, refused):
    arguments = [bag if each == "BAG" else each for each in arguments]
    assert words in refused("margins", file(**changes), *arguments)


def test_efforts_that_were_only_measured_are_not_taken_for_those_that_were_sent(
    file, tmp_path, refused
):
    points = tuple(TrajectoryPoint(k * MS, (0.1 * math.sin(k),)) for k in range(1000))
    states = JointStateTemplate(["elbow"], position=True, effort=True)
    log = [trajectory_of(0, JointTrajectory(("elbow",), points))]
    for k in range(1000):
        raw = states.encode(k * MS, position=[0.1 * math.sin(k)], effort=[math.cos(k)])
        log.append(("joint_states", k * MS, raw))
    told = refused("margins", file(), "--bag", write_bag(tmp_path / "bag", log))
    assert "elbow: its efforts are measured, of /joint_states; record the commands" in told


def test_nothing_is_overwritten_unasked(file, tmp_path, refused):
    own, there = file(), tmp_path / "there.json"
    there.write_text("mine")
    assert "exists" in refused("margins", own, "--json", there)
    assert "is an input" in refused("margins", own, "--json", own, "--force")
    assert there.read_text() == "mine"
