"""The brick task from the experiment file to the result, on the graph and without it."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from harness.experiments import changed, write_experiment

from hpid_bench.cli.main import main
from hpid_bench.experiment.compare import compute, save, save_numbers
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.graph_run import run_on_graph
from hpid_bench.experiment.in_process import NoProgress, RunReport, run_without_ros, write_document
from hpid_bench.experiment.result_folder import ResultFolder
from hpid_ros.base.errors import BagError, ExperimentError
from hpid_ros.base.records import Section
from hpid_ros.base.resources import share_folder
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.messages.messages import BagMessages, PoseColumns
from hpid_ros.messages.reports import POSE, POSES
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.task import EndEffector, TaskFrame, moving_joints
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.kinematics import Kinematics
from hpid_ros.simulation.world_file import read_world

EXPERIMENTS = share_folder() / "config" / "experiments"
ROBOT = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
WHEELS = ("wheel_left_joint", "wheel_right_joint")
SECOND = 1_000_000_000

# An arm on a stand carries a brick from one side to the other, as fast as it can be told to.
SMALL = {
    "extends": str(EXPERIMENTS / "tracking.yaml"),
    "name": "small",
    "duration": 4.4,
    "control": {"rate": 250, "answer_timeout": 120.0},
    "simulation": {"engine": "mujoco", "physics_steps": 4},
    "robot": {
        "base": None,
        "fixed_base": True,
        "initial_positions": {
            "arm_joint_2": 0.2,
            "arm_joint_3": 1.7,
            "arm_joint_5": math.pi - 1.9,
        },
    },
    "scene": {
        "supports": {"table": {"size": [0.3, 0.5, 0.1], "position": [0.45, 0.0, 0.15]}},
        "bricks": {
            "brick": {"size": [0.06, 0.06, 0.06], "mass": 0.5, "position": [0.42, 0.06, 0.23]}
        },
    },
    "reference": {
        "kind": "bricks",
        "times": None,
        "positions": None,
        "arm_speed": 0.8,
        "line_speed": 0.4,
        "clearance": 0.06,
        "settle": 0.4,
        "grip_time": 0.05,
        "bricks": [{"brick": "brick", "place": {"position": [0.42, -0.06, 0.23], "yaw": 0.4}}],
    },
    "controllers": {"joints": dict.fromkeys(WHEELS)},
    "compare": {"PID": None},
}


@pytest.fixture
def written(tmp_path):
    """Return a function that writes the small task, changed."""

    def write(file="small.yaml", **changes):
        document = changed(json.loads(json.dumps(SMALL)), **changes)
        path = tmp_path / file
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        return path

    return write


def carried(path, folder):
    """Run an experiment's first controller in this process; return the result and its bag."""
    experiment = load_experiment(path)
    (label, *_), bag = experiment.controllers, folder / "bag"
    run_without_ros(experiment, label, bag, NoProgress())
    return compute(experiment, {label: bag}), bag


@pytest.fixture(scope="module")
def small_result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return carried(path, folder)


def require_carried(brick):
    assert (brick["grasped"], brick["lost"]) == (True, False)
    assert brick["distance"] < 0.01
    assert brick["position_error"] < 0.02
    assert brick["orientation_error"] < 0.05


def test_a_brick_is_carried_to_its_place_and_the_result_shows_it(small_result, tmp_path):
    result, bag = small_result
    (brick,) = result.as_mapping()["bricks"]["hPID"].values()
    require_carried(brick)
    assert [event.message for event in BagMessages(bag).statuses("grip_events")] == [
        "grasped",
        "released",
    ]
    folder = ResultFolder.create(tmp_path / "result")
    save_numbers(result, folder, [RunReport("hPID", 1.0, 2201, 1)], "in one process")
    save(result, folder, "in one process")
    page = (folder.path / "report.html").read_text()
    assert '"end_effector"' in page
    assert f"hpid compare small.yaml --engine {result.experiment.world.engine}" in page
    for text in (page, (folder.path / "table.txt").read_text()):
        assert "hPID: brick brick carried" in text


def test_the_graph_does_the_same_task_to_the_last_bit(small_result, tmp_path):
    result, bag = small_result
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    experiment = load_experiment(path)
    nodes, on_graph = tmp_path / "nodes", tmp_path / "bag"
    nodes.mkdir()
    report = run_on_graph(experiment, "hPID", on_graph, nodes, NoProgress())
    assert report.warnings == []
    told = json.dumps(compute(experiment, {"hPID": on_graph}).as_mapping())
    assert told == json.dumps(result.as_mapping())
    events = [BagMessages(each).statuses("grip_events") for each in (on_graph, bag)]
    assert events[0] == events[1]
    for topic, kind in (("brick_poses", POSES), ("ee_pose", POSE)):
        one, other = (BagMessages(each).poses(topic, kind) for each in (on_graph, bag))
        for a, b in zip(one, other, strict=True):
            assert np.array_equal(a, b)
        assert one.stamps_ns[-1] == 4_400_000_000  # the last state is told in any case


def test_a_brick_that_is_not_where_it_is_believed_is_reported(written, tmp_path):
    believed = {"position": [0.42, 0.03, 0.23]}
    bricks = [{"brick": "brick", "pick": believed, "place": {"position": [0.42, -0.06, 0.23]}}]
    result, bag = carried(written(reference__bricks=bricks), tmp_path)
    (brick,) = result.as_mapping()["bricks"]["hPID"].values()
    assert not brick["grasped"]
    assert not brick["lost"]
    assert brick["distance"] == pytest.approx(0.03, abs=0.01)
    assert brick["position_error"] == pytest.approx(0.12, abs=1e-3)
    (line,) = [note for note in result.notes if "brick brick" in note]
    assert re.match(r"hPID: brick brick not grasped \(0\.0\d+ m away, at most 0\.015 m\)", line)
    (event,) = BagMessages(bag).statuses("grip_events")
    assert event.level == 1


def test_a_grip_that_is_too_weak_loses_the_brick_and_says_so(written, tmp_path):
    result, bag = carried(written(scene__gripper={"grip_force": 4.0}), tmp_path)
    (brick,) = result.as_mapping()["bricks"]["hPID"].values()
    assert brick["grasped"]
    assert brick["lost"]
    assert "the grip holds 4.8 N" in brick["reason"]
    assert brick["position_error"] > 0.05
    assert [event.level for event in BagMessages(bag).statuses("grip_events")] == [0, 2]


def test_the_shipped_task_puts_both_bricks_where_they_belong(tmp_path):
    document = {
        "extends": str(EXPERIMENTS / "bricks.yaml"),
        "control": {"rate": 125},  # an eighth of the file's rate, which takes less time
        "simulation": {"engine": "mujoco", "physics_steps": 4},
        "compare": {"PID": None},
    }
    path = tmp_path / "bricks.yaml"
    path.write_text(yaml.safe_dump(document))
    result, _ = carried(path, tmp_path)
    mapping = result.as_mapping()
    assert set(mapping["bricks"]["hPID"]) == {"light", "heavy"}
    for brick in mapping["bricks"]["hPID"].values():
        require_carried(brick)
    end_effector = mapping["end_effector"]["hPID"]
    assert (end_effector["link"], end_effector["frame"]) == ("payload", "odom")
    for which in ("tracking", "truth"):
        assert 1e-5 < end_effector[which]["rms_position"] < 0.02
        assert end_effector[which]["largest_position"] < 0.05


def test_a_robot_without_bricks_has_an_end_effector_all_the_same(experiment_file, tmp_path):
    result, _ = carried(experiment_file(), tmp_path)
    mapping = result.as_mapping()
    assert "bricks" not in mapping
    assert not any("brick" in note for note in result.notes)
    figures = mapping["end_effector"]["PID"]
    # The run begins where the arm is 0.3 rad away from its reference.
    assert 0.05 < figures["tracking"]["largest_position"] < 0.5
    truth, tracking = figures["truth"], figures["tracking"]
    assert truth["largest_position"] == pytest.approx(tracking["largest_position"], abs=5e-3)


def test_the_bridge_gets_the_same_scene(written, tmp_path):
    yaws = {"yaw": 0.3, "friction": 0.7}
    path = written(
        scene__bricks__second={"size": [0.05, 0.05, 0.05], "position": [0.5, 0, 0.225], "mass": 1}
        | yaws,
        scene__gripper={"tolerance": 0.01, "opening": 0.07},
    )
    experiment = load_experiment(path)
    write_document(tmp_path / "world.yaml", experiment.world_document())
    document = load_yaml(tmp_path / "world.yaml", ExperimentError)
    there = read_world(Section(document, "", ExperimentError), ()).world
    assert there == experiment.world
    assert load_experiment(path).trajectory == experiment.trajectory  # planned twice alike


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"duration": 2.0}, r"duration 2 s ends before the brick task, which takes \d"),
        ({"scene__bricks__brick__mass": 0.0}, r"scene\.bricks\.brick\.mass must be above 0"),
        ({"scene__gripper": {"link": "hand"}}, "unknown link 'hand'"),
        ({"scene__grips": [{"time": 1.0, "closed": True}]}, "plans them already"),
        (
            {"scene__supports__brick": {"size": [1, 1, 1], "position": [9, 9, 9]}},
            "'brick' is twice",
        ),
        ({"scene__gripper": {"angle_tolerance": 2.0}}, "above 0 and at most 0.785398"),
    ],
)
def test_an_experiment_that_cannot_be_done_is_one_line(written, changes, line):
    with pytest.raises(ExperimentError, match=line) as error:
        load_experiment(written(**changes))
    assert "\n" not in str(error.value)


def series(joint, position, reference, period_ns=1_000_000):
    stamps = np.arange(len(position), dtype=np.int64) * period_ns
    nothing = np.empty(0)
    return JointSeries(joint, stamps, position, reference, nothing.astype(np.int64), nothing)


def test_deviations_are_those_of_the_kinematics():
    """One joint is off by a known angle, the base drives an exact circle and lags behind it."""
    arm = Kinematics(ROBOT, "payload")
    base = DifferentialDrive.of(ROBOT, *WHEELS)
    count, off = 2000, 0.01
    pose = np.array([0.2, -0.4, 1.5, 0.3, 0.9, 0.1])
    joints = [
        series(name, np.full(count, value + off * (name == "arm_joint_1")), np.full(count, value))
        for name, value in zip(arm.joints, pose, strict=True)
    ]
    run = RunSeries("run", tuple(joints))
    radius = math.hypot(*arm.pose(pose).position[:2])
    figures = EndEffector(TaskFrame(ROBOT, "payload"), run).figures()
    assert figures.frame == "base_footprint"
    for value in (figures.tracking.rms_position, figures.tracking.largest_position):
        assert value == pytest.approx(2.0 * radius * math.sin(off / 2.0), rel=1e-9)
    assert figures.tracking.rms_orientation == pytest.approx(off, rel=1e-9)

    turned = np.linspace(0.0, 20.0, count)
    wheels = [
        series(name, 0.9 * turned * k, turned * k)
        for name, k in zip(WHEELS, (0.5, 1.0), strict=True)
    ]
    still = [
        series(name, np.full(count, v), np.full(count, v))
        for name, v in zip(arm.joints, pose, strict=True)
    ]
    frame = TaskFrame(ROBOT, "payload", base)
    alone = [replace(each, reference=np.empty(0)) for each in wheels]
    with pytest.raises(BagError, match="no reference of wheel_left_joint, wheel_right_joint was"):
        EndEffector(frame, RunSeries("run", (*alone, *still)))
    figures = EndEffector(frame, RunSeries("run", (*wheels, *still)))
    tracking = figures.figures().tracking
    assert figures.frame == "odom"
    heading = base.twist(10.0, 20.0).angular  # the end of the reference: 10 and 20 rad
    assert tracking.largest_orientation == pytest.approx(0.1 * heading, rel=1e-6)
    circle = base.twist(0.5, 1.0).linear / base.twist(0.5, 1.0).angular

    lowered = RobotDescription.load(ROBOT.xml.replace('<origin xyz="0 0 0.075"/>', "", 1))
    frame = TaskFrame(lowered, "payload", DifferentialDrive.of(lowered, *WHEELS))
    low = EndEffector(frame, RunSeries("run", (*wheels, *still))).path(10)
    assert low.position[:, 2] == pytest.approx(figures.path(10).position[:, 2])

    def hand(turn):
        x, y, _ = arm.pose(pose).position
        c, s = math.cos(turn), math.sin(turn)
        return np.array([circle * s + c * x - s * y, circle * (1 - c) + s * x + c * y])

    lag = np.linalg.norm(hand(heading) - hand(0.9 * heading))
    assert tracking.largest_position == pytest.approx(lag, rel=1e-4)


def test_wheels_that_turn_in_the_air_move_no_base_and_no_hand(tmp_path):
    result, _ = carried(write_experiment(tmp_path, robot__fixed_base=True), tmp_path)
    assert not result.base
    (hand, *_) = result.end_effectors.values()
    assert hand.frame == ROBOT.root
    assert hand.truth.largest_position == pytest.approx(hand.tracking.largest_position, rel=0.1)


def test_truth_is_compared_at_its_own_stamps():
    arm = Kinematics(ROBOT, "payload")
    count = 100
    joints = [series(name, np.zeros(count), np.zeros(count)) for name in arm.joints]
    end_effector = EndEffector(TaskFrame(ROBOT, "payload"), RunSeries("run", tuple(joints)))
    stamps = np.array([0, 20_000_000, 999 * SECOND], dtype=np.int64)
    position = arm.pose(np.zeros(6)).position + np.array([0.0, 0.003, 0.004])
    truth = PoseColumns(
        stamps, np.tile(position, (3, 1, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1, 1))
    )
    figures = end_effector.figures(truth)
    assert figures.tracking.largest_position == 0.0
    assert figures.truth.rms_position == pytest.approx(0.005)
    assert figures.truth.largest_orientation == pytest.approx(0.0, abs=1e-9)
    nowhere = truth._replace(stamps_ns=stamps + 1)
    assert end_effector.figures(nowhere).truth is None


def test_a_run_without_the_arm_has_no_end_effector():
    run = RunSeries("run", (series("elbow", np.zeros(3), np.zeros(3)),))
    with pytest.raises(BagError, match="no joint that moves 'payload'"):
        EndEffector(TaskFrame(ROBOT, "payload"), run)
    assert moving_joints(ROBOT, "base_link") == frozenset()


def test_metrics_tell_the_end_effector_of_any_bag(small_result, tmp_path, capsys):
    """The index needs no experiment: a bag and a URDF are enough."""
    result, bag = small_result
    known = result.as_mapping()["end_effector"]["hPID"]["tracking"]
    urdf = str(share_folder() / "urdf" / "mobile_manipulator.urdf")
    page = tmp_path / "page.html"
    options = ["--robot", urdf, "--json", "--report", str(page)]
    assert main(["metrics", str(bag), *options]) == 0
    told = json.loads(capsys.readouterr().out)["end_effector"]["bag"]
    assert (told["tracking"], told["frame"]) == (known, "base_footprint")
    assert '"end_effector"' in page.read_text()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--wheels", "a", "b"], "need --robot"),
        (["--robot", "nowhere.urdf"], "there is no file nowhere.urdf"),
        (["--robot", "urdf/mobile_manipulator.urdf", "--end-effector", "x"], "unknown link 'x'"),
        (["--robot", "urdf/mobile_manipulator.urdf", "--wheels", "a", "b"], "unknown joint 'a'"),
    ],
)
def test_metrics_refuse_a_robot_that_is_none(small_result, options, line, refused):
    assert line in refused("metrics", small_result[1], *options)
