"""``hpid identify``: from a bag to numbers that other commands take."""

import json
from operator import itemgetter

import numpy as np
import pytest
import yaml
from harness.bags import command, odometry, state, write_bag
from harness.motions import Plant, motion, needed

from hpid_bench.cli.main import main
from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.resources import share_folder
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.metadata import missed_entries
from hpid_ros.messages.writer import BagWriter
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import InverseDynamics

JOINT_STATE = "sensor_msgs/msg/JointState"
PERIOD_NS = 2_000_000
JOINTS = ("arm_joint_4", "arm_joint_6")
PLANT = Plant(inertia=0.05, viscous=0.2, coulomb=0.1, offset=0.02, delay=0.004)
URDF = share_folder() / "urdf" / "mobile_manipulator.urdf"


def write(path, runs=1, seconds=10.0, effort_in_states=False, missed=(), lost=0):
    """Write a bag: the first joint moves, the other one stands still; each run begins at 1 s.

    States of which the controllers missed the command are numbers in each run; the recorder says
    that it lost some states.
    """
    times = 1.0 + np.arange(0.0, seconds, PERIOD_NS * 1e-9)
    state = JointStateTemplate(JOINTS, position=True, effort=effort_in_states)
    command = JointStateTemplate(JOINTS, effort=True)
    with BagWriter(path) as bag:
        names = ("/joint_states",) if effort_in_states else ("/joint_states", "/joint_commands")
        topics = [bag.add_topic(name, JOINT_STATE) for name in names]
        for run in range(runs):
            position = motion(times, run + 1, 0.4)[0]
            effort = needed(PLANT, *motion(times + PLANT.delay + 1e-3, run + 1, 0.4))
            for k, time in enumerate(times):
                stamp = round(time * 1e9)
                log = stamp + run * 100_000_000_000
                at, efforts = (position[k], 0.3), (effort[k], 0.5)
                if effort_in_states:
                    bag.write(topics[0], log, state.encode(stamp, position=at, effort=efforts))
                else:
                    bag.write(topics[0], log, state.encode(stamp, position=at))
                    if k in missed:
                        continue
                    bag.write(topics[1], log, command.encode(stamp, effort=efforts))
        if lost:
            for name, text in missed_entries({"/joint_states": lost}, 0.0).items():
                bag.describe(name, text)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("identify") / "bag")


@pytest.mark.parametrize("effort_in_states", [False, True])
def test_a_bag_gives_numbers_and_a_still_joint_a_reason(tmp_path, hpid, effort_in_states):
    bag = write(tmp_path / "bag", effort_in_states=effort_in_states)
    code, out, _ = hpid("identify", bag, "--json", tmp_path / "found.json")
    assert code == 0
    source = "measured, of /joint_states" if effort_in_states else "/joint_commands"
    assert f"efforts: {source}" in out
    assert "nothing found: it did not move" in out
    document = json.loads((tmp_path / "found.json").read_text())["joints"]
    moving, still = (document[name] for name in JOINTS)
    assert still["estimates"] == {}
    assert still["not_told"]
    assert hpid("identify", bag, "--joint", JOINTS[1])[0] == 1
    for name in ("inertia", "viscous", "coulomb", "offset"):
        each = moving["estimates"][name]
        assert each["value"] == pytest.approx(getattr(PLANT, name), rel=0.02)
        assert each["low"] < each["value"] < each["high"]
    delay = PLANT.delay + (1e-3 if effort_in_states else 0.0)  # which no hold delays
    assert moving["estimates"]["delay"]["value"] == pytest.approx(delay, abs=2e-4)
    assert moving["estimates"]["inertia"]["unit"] == "kg m^2"


@pytest.mark.parametrize("amplitude", [0.0, 0.25])
def test_a_joint_that_nobody_drives_counts_where_it_was(amplitude, tmp_path, hpid):
    driven, other, file = "arm_joint_2", "arm_joint_3", tmp_path / "found.json"
    plant = Plant(delay=0.0)
    times = 1.0 + np.arange(0.0, 8.0, PERIOD_NS * 1e-9)

    def moved(times):
        moved = np.array([motion(times, 1), motion(times, 2, amplitude)])
        moved[1, 0] += 1.5
        return moved

    body = InverseDynamics(RobotDescription.load(URDF), [driven, other])
    between = moved(times + 0.5e-9 * PERIOD_NS)
    effort = needed(plant, *between[0]) + body.efforts(*between.swapaxes(0, 1))[0]
    log = []
    for time, (one, two), u in zip(times, moved(times)[:, 0].T, effort, strict=True):
        stamp = round(time * 1e9)
        log += [state(stamp, **{driven: one, other: two}), command(stamp, **{driven: u})]
    for k in range(10):  # too few to follow it, and no reason to read nothing else
        log.append(state(round(1e9 * (1.5 + 0.6 * k)), arm_joint_6=0.005 * k))
    bag = write_bag(tmp_path / "bag", sorted(log, key=itemgetter(1)))
    code, out, _ = hpid("identify", bag, "--urdf", URDF, "--json", file)
    assert code == 0
    assert "arm_joint_6 moved, but has few states" in " ".join(out.split())
    found = json.loads(file.read_text())["joints"]
    assert list(found) == [driven]
    inertia = found[driven]["estimates"]["inertia"]["value"]
    assert inertia == pytest.approx(plant.inertia, rel=0.02)
    out = " ".join(hpid("identify", bag, "--joint", driven)[1].split())
    assert (f"{other} moved at the same time" in out) is bool(amplitude)


def test_what_its_recording_lacks_is_told_with_the_numbers(bag, tmp_path, hpid):
    lacking = write(tmp_path / "bag", lost=7, missed=range(0, 5000, 50))
    files = ["--json", tmp_path / "found.json", "-o", tmp_path / "found.yaml"]
    code, out, _ = hpid("identify", lacking, *files)
    line = "the recorder missed 7 messages on /joint_states"
    assert code == 0
    assert line in out
    assert json.loads((tmp_path / "found.json").read_text())["missing"] == [line]
    assert f"# Not whole: {line}.\n" in (tmp_path / "found.yaml").read_text()
    unanswered = "states have no command of their own"
    assert f"100 of 5000 {unanswered}" in " ".join(out.split())
    assert unanswered not in " ".join(hpid("identify", bag)[1].split())


def test_runs_after_a_reset_of_the_clock_are_all_used(tmp_path, hpid):
    bag, file = write(tmp_path / "bag", runs=3, seconds=4.0), tmp_path / "found.json"
    assert hpid("identify", bag, "--json", file)[0] == 0
    found = json.loads(file.read_text())["joints"][JOINTS[0]]
    assert found["time"] > 4.0  # of one run less than two are looked at
    assert found["estimates"]["inertia"]["value"] == pytest.approx(PLANT.inertia, rel=0.02)


def test_what_is_written_is_taken_by_other_commands(bag, tmp_path, hpid):
    found, pid, upgraded = (tmp_path / name for name in ("found.yaml", "pid.yaml", "up.yaml"))
    code, out, _ = hpid("identify", bag, "--urdf", URDF, "-o", found)
    assert code == 0
    assert f"written: {found}" in out
    document = yaml.safe_load(found.read_text())
    own = document["robot"]["joints"]["arm_joint_4"]
    assert own["damping"] == pytest.approx(PLANT.viscous, rel=0.02)
    assert own["friction"] == pytest.approx(PLANT.coulomb, rel=0.05)
    assert "95 %" in found.read_text()
    assert own["gear_ratio"] > 1.0
    assert 0.0 < own["rotor_inertia"] * own["gear_ratio"] ** 2 < PLANT.inertia
    assert "arm_joint_6" not in document["robot"]["joints"]
    inertia = document["controllers"]["joints"]["arm_joint_4"]["inertia"]
    gains = {"p": 400.0 * inertia, "i": 500.0 * inertia, "d": 40.0 * inertia}
    node = {"ros__parameters": {"joint": "arm_joint_4", "law": "pid", "gains": gains}}
    pid.write_text(yaml.safe_dump({"a": node}))
    for arguments in (
        ["check-gains", pid, "--inertia", found],
        ["check-gains", pid, "--urdf", found],
        ["robot", found],
        ["upgrade", pid, "--goal", "fast", "--inertia", found, "-o", upgraded],
    ):
        assert main(list(map(str, arguments))) == 0
    assert upgraded.is_file()


@pytest.mark.parametrize("share", [share_folder(), "package://hpid_ros"])
def test_an_experiment_is_amended_by_what_was_found(bag, tmp_path, hpid, share):
    found = tmp_path / "identified.yaml"
    paper = f"{share}/config/experiments/paper.yaml"
    assert hpid("identify", bag, "--urdf", paper, "-o", found)[0] == 0
    experiment = load_experiment(found)
    own = yaml.safe_load(found.read_text())["controllers"]["joints"]["arm_joint_4"]["inertia"]
    loops = {each.joint: each for each in experiment.controllers["PID"]}
    assert loops["arm_joint_4"].inertia == own


def test_without_a_robot_the_inertia_alone_is_taken(bag, tmp_path, hpid):
    found = tmp_path / "identified.yaml"
    assert hpid("identify", bag, "-o", found)[0] == 0
    document = yaml.safe_load(found.read_text())
    assert "rotor_inertia" not in document["robot"]["joints"]["arm_joint_4"]
    own = document["controllers"]["joints"]["arm_joint_4"]["inertia"]
    assert own == pytest.approx(PLANT.inertia, rel=0.02)
    assert main(["check-gains", "--p", "1", "--i", "1", "--d", "1", "--inertia", str(URDF)]) == 2


def test_nothing_that_is_there_is_replaced_and_a_picture_is_drawn(bag, tmp_path, hpid, refused):
    there = tmp_path / "there.png"
    there.write_text("mine")
    for option in ("-o", "--json", "--plot"):
        assert "exists" in refused("identify", bag, option, there)
    assert there.read_text() == "mine"
    assert hpid("identify", bag, "--plot", there, "--force")[0] == 0
    assert there.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--joint", "nope"], "unknown joint 'nope'"),
        (["--urdf", "no.urdf"], "no.urdf"),
        (["--plot", "x.gif"], "--plot must end in"),
        (["--effort-unit", "any"], "needs --urdf"),
        (["--cutoff", "0"], "cutoff must be above 0"),
        (["--longest-delay", "7"], "longest_delay must be"),
        (["-o", "same", "--json", "same"], "different files"),
    ],
)
def test_bad_input_is_one_line(bag, refused, options, told):
    assert told in refused("identify", bag, *options)


def write_wheels(path, rolled):
    """Write a bag of two wheels and odometry that moves, stands still or is not there."""
    times = np.arange(0.0, 5.0, 0.002)
    position = motion(times, 1, 0.4)[0]
    effort = needed(PLANT, *motion(times + PLANT.delay + 1e-3, 1, 0.4))
    state = JointStateTemplate(
        ("left_wheel_joint", "right_wheel_joint"), position=True, effort=True
    )
    log = []
    for k, time in enumerate(times):
        stamp, at, efforts = round(time * 1e9), [position[k]] * 2, [effort[k]] * 2
        log.append(("joint_states", stamp, state.encode(stamp, position=at, effort=efforts)))
        if rolled is not None and k % 50 == 0:
            log.append(odometry(stamp, rolled * time))
    return write_bag(path, log)


@pytest.mark.parametrize(
    ("rolled", "asked", "reason"),
    [
        (0.1, True, "the robot rolled on it (0.49 m and 0 rad by its odometry)"),
        (None, False, "a wheel by its name, and no odometry tells whether the robot rolled"),
        (None, True, ""),
        (0.0, False, ""),
    ],
)
def test_wheels_are_told_only_where_the_robot_does_not_roll(rolled, asked, reason, tmp_path, hpid):
    bag, file = write_wheels(tmp_path / "bag", rolled), tmp_path / "found.json"
    options = ("--joint", "left_wheel_joint") if asked else ()
    code, out, _ = hpid("identify", bag, *options, "--json", file)
    found = json.loads(file.read_text())["joints"]["left_wheel_joint"]
    if reason:
        assert code == 1
        assert found["estimates"] == {}
        assert reason in out
    else:
        assert code == 0
        assert found["estimates"]["inertia"]["value"] == pytest.approx(PLANT.inertia, rel=0.02)
