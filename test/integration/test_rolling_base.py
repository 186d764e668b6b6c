"""The mobile base in the simulation: it rolls, it tells where it is, and it does not hide slip."""

import json
import math

import numpy as np
import pytest
from harness.places import URDF
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.experiment.compare import compute
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_ros.base.errors import BagError, ExperimentError, SettingError
from hpid_ros.messages.messages import BagMessages
from hpid_ros.messages.run import read_run
from hpid_ros.metrics.task import PoseErrors, base_figures
from hpid_ros.robot.differential_drive import DifferentialDrive, PlanarPose, integrated
from hpid_ros.simulation.reports import BaseMonitor, Reports, ReportTimes, SlipMeter, planar
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

WHEELS = ("wheel_left_joint", "wheel_right_joint")
JOINTS = (*WHEELS, *(f"arm_joint_{number}" for number in range(1, 7)))
HOME = {"arm_joint_2": -0.5, "arm_joint_3": 1.8, "arm_joint_5": 1.2}
DRIVE = DifferentialDrive(*WHEELS, 0.075, 0.5)
BASE = {
    "left_wheel": DRIVE.left,
    "right_wheel": DRIVE.right,
    "wheel_radius": DRIVE.radius,
    "wheel_separation": DRIVE.separation,
}
# A stiff joint controller of the arm, by joint: [N m/rad] and [N m s/rad].
STIFFNESS = np.array([900.0, 1500.0, 900.0, 200.0, 200.0, 60.0])
DAMPING = np.array([60.0, 90.0, 60.0, 10.0, 10.0, 3.0])

GENTLE = {
    "times": [0.0, 3.0, 5.0, 6.5],
    "poses": [[0, 0, 0], [0.6, 0.2, 0.6], [0.6, 0.2, -0.4], [0.3, 0.35, -0.4]],
    "directions": ["forward", "forward", "backward"],
}


def slippery(tmp_path, friction):
    """Return the URDF of the robot on wheels with less friction; its own is 0.9."""
    text = URDF.read_text()
    changed = text.replace(
        '<lateral_friction value="0.9"/>', f'<lateral_friction value="{friction}"/>'
    )
    assert changed != text
    path = tmp_path / "slippery.urdf"
    path.write_text(changed)
    return str(path)


@pytest.fixture
def drive(experiment_file, tmp_path):
    """Return a function that drives a path with the arm at home, and returns the result."""

    def run(path, friction=None):
        times = path["times"]
        still = {joint: [HOME.get(joint, 0.0)] * 2 for joint in JOINTS[2:]}
        parts = [
            {"kind": "base_path", "base": BASE, **path},
            {"kind": "minimum_jerk", "times": [times[0], times[-1]], "positions": still},
        ]
        changes = {"robot__description": slippery(tmp_path, friction)} if friction else {}
        file = experiment_file(
            duration=times[-1] + 0.3,
            simulation__physics_steps=2,  # with one the wheels of a driven base slip by 0.1 m
            reference={"kind": "combined", "parts": parts},
            compare={"PID": {"law": "pid"}},
            **changes,
        )
        experiment = load_experiment(file)
        run_without_ros(experiment, "PID", tmp_path / "bag", NoProgress())
        return compute(experiment, {"PID": tmp_path / "bag"})

    return run


def test_gently_driven_the_base_goes_where_its_wheels_say_and_where_it_was_sent(drive):
    result = drive(GENTLE)
    base = result.base["PID"]
    assert base.path_length == pytest.approx(0.97, abs=0.03)
    assert max(base.slip_left, base.slip_right, base.slip_lateral) < 3e-4 * base.path_length
    assert base.odometry.largest_position < 3e-4
    assert base.odometry.largest_heading < 3e-4
    assert base.tracking.final_position < 2e-3
    assert base.tracking.largest_position < 5e-3
    assert not base.has_slipped
    assert result.notes == ()


def test_on_slippery_ground_odometry_departs_from_the_truth_and_the_result_says_so(drive):
    result = drive(GENTLE, friction=0.05)
    base = result.base["PID"]
    assert min(base.slip_left, base.slip_right) > 0.05
    assert base.slip_lateral > 0.005
    assert base.has_slipped
    assert base.odometry.largest_position > 0.02
    (note,) = result.notes
    assert note.startswith("PID: the base slipped: left wheel ")
    assert "odometry ends" in note


def test_result_and_bag_hold_the_base(experiment_file, tmp_path):
    experiment = load_experiment(experiment_file(duration=0.31))
    bags = {label: tmp_path / label for label in experiment.controllers}
    for label, bag in bags.items():
        run_without_ros(experiment, label, bag, NoProgress())
    result = compute(experiment, bags)
    base = json.loads(json.dumps(result.as_mapping()))["base"]
    assert list(base) == ["PID", "hPID"]
    assert set(base["PID"]) == {
        "path_length",
        "odometry",
        "tracking",
        "slip_left",
        "slip_right",
        "slip_lateral",
    }
    bag = bags["PID"]
    for topic in ("odom", "base_pose_ground_truth"):
        stamps = BagMessages(bag).planar(topic).stamps_ns
        # Fifty a second, and the last state.
        assert stamps.tolist() == [*range(0, 310_000_000, 20_000_000), 310_000_000]
    stamps, slips = BagMessages(bag).vectors("wheel_slip")
    assert slips.shape == (len(stamps), 3)
    assert (np.diff(slips, axis=0) >= 0.0).all()
    assert base["PID"]["slip_left"] == slips[-1, 0]
    with pytest.raises(BagError, match="odom is nav_msgs/msg/Odometry, but must be"):
        BagMessages(bag).vectors("odom")


def test_odometry_is_what_the_encoders_said(experiment_file, tmp_path):
    file = experiment_file(duration=2.6, sensors__encoder_counts=512, simulation__physics_steps=2)
    experiment = load_experiment(file)
    run_without_ros(experiment, "PID", tmp_path / "bag", NoProgress())
    run = read_run(tmp_path / "bag", "PID", joints=WHEELS)
    left, right = run.joints
    odom = BagMessages(tmp_path / "bag").planar("odom")
    by_hand = integrated(DRIVE, left.position, right.position)
    at = np.searchsorted(left.state_stamps_ns, odom.stamps_ns)
    assert np.abs(odom.poses[-1]).max() > 0.01
    assert odom.poses == pytest.approx(by_hand[at], abs=1e-12)
    truth = BagMessages(tmp_path / "bag").planar("base_pose_ground_truth")
    away, count = np.abs(odom.poses - truth.poses), DRIVE.radius * math.tau / 512
    assert 1e-5 < away[:, :2].max() < count
    assert away[:, 2].max() < 2.0 * count / DRIVE.separation


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ({**BASE, "left_wheel": "wheel"}, "robot.base: unknown joint 'wheel'"),
        ({**BASE, "left_wheel": WHEELS[1], "right_wheel": WHEELS[0]}, "left and right of"),
    ],
)
def test_a_bad_base_is_refused_with_its_place(experiment_file, base, message):
    with pytest.raises(ExperimentError, match=message):
        load_experiment(experiment_file(robot__base=base))


def test_wheels_must_be_driven():
    with pytest.raises(SettingError, match="base: unknown driven joint 'wheel_left_joint'"):
        WorldSettings(URDF, JOINTS[2:], base=DRIVE)


ARCS = st.tuples(st.floats(-0.5, 0.5), st.floats(-2.0, 2.0))


@given(st.lists(ARCS, max_size=6), st.floats(-3.0, 3.0))
def test_rolling_is_no_slip(arcs, heading):
    x = y = left = right = 0.0
    meter = SlipMeter(DRIVE, (left, right), PlanarPose(x, y, heading))
    for distance, turn in arcs:
        half = 0.5 * DRIVE.separation * turn
        rates = ((distance - half) / DRIVE.radius, (distance + half) / DRIVE.radius)
        left, right = left + rates[0], right + rates[1]
        chord = distance * np.sinc(turn / 2.0 / math.pi)
        x += chord * math.cos(heading + turn / 2.0)
        y += chord * math.sin(heading + turn / 2.0)
        heading = math.remainder(heading + turn, math.tau)
        meter.update((left, right), PlanarPose(x, y, heading))
    assert meter.slip == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("wheels", "pose", "slip"),
    [
        ((2.0, 0.0), (0.0, 0.0, 0.0), (0.15, 0.0, 0.0)),  # one wheel spins
        ((0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.1, 0.0)),  # pulled ahead with locked wheels
        ((0.0, 0.0), (0.0, -0.1, 0.0), (0.0, 0.0, 0.1)),  # pushed aside
        ((0.0, 0.0), (0.0, 0.0, 0.2), (0.05, 0.05, 0.0)),  # twisted
    ],
)
def test_slip_is_what_the_wheels_do_not_explain(wheels, pose, slip):
    meter = SlipMeter(DRIVE, (0.0, 0.0), PlanarPose(0.0, 0.0, 0.0))
    meter.update(wheels, PlanarPose(*pose))
    assert meter.slip == pytest.approx(slip)
    meter.update((0.0, 0.0), PlanarPose(0.0, 0.0, 0.0))  # and back: both ways count
    assert meter.slip == pytest.approx([2.0 * each for each in slip])


def test_reports_come_first_then_in_their_period_and_last():
    times = ReportTimes(50.0, 75_000_000)
    told = [t for t in range(0, 76_000_000, 3_000_000) if times.is_due(t)]
    assert told == [0, 21_000_000, 42_000_000, 63_000_000, 75_000_000]
    assert times.is_due(0)  # a reset
    assert not times.is_due(3_000_000)
    assert not any(ReportTimes(0.0).is_due(t) for t in range(100))


def drive_open_loop(world, efforts):
    """Hold the arm at home and give the wheels efforts, one pair for each control period."""
    home = np.array(world.true_positions())[2:]
    for pair in efforts:
        error = home - np.array(world.true_positions())[2:]
        rates = np.array(world.true_velocities())[2:]
        world.step([*pair, *(STIFFNESS * error - DAMPING * rates)])
        yield


def test_pose_errors_know_that_angles_wrap():
    one = np.array([[0.0, 0.0, 3.1], [3.0, 4.0, 3.1]])
    other = np.array([[0.0, 0.0, 3.1 - 2.0 * np.pi], [0.0, 0.0, -3.1]])
    errors = PoseErrors.between(one, other)
    assert errors.final_position == errors.largest_position == 5.0
    assert errors.rms_position == pytest.approx(5.0 / math.sqrt(2.0))
    assert errors.final_heading == pytest.approx(2.0 * math.pi - 6.2)


def test_odometry_without_a_base_is_the_truth():
    with World(WorldSettings(URDF, JOINTS, initial_positions=HOME)) as world:
        sent = dict(Reports(world, "payload", 50.0, None).sample(0, world.read()))
    assert sent["odom"] == sent["base_pose_ground_truth"]
    assert "wheel_slip" not in sent


def test_odometry_says_how_sure_it_is_and_starts_again_with_a_reset():
    settings = WorldSettings(URDF, JOINTS, initial_positions=HOME, encoder_counts=4096, base=DRIVE)
    with World(settings) as world:
        monitor = BaseMonitor(world)
        with pytest.raises(SettingError, match="when a state has been noted"):
            monitor.report()
        reports = []
        for _ in range(2):
            world.reset()
            monitor.note(world.read())
            assert monitor.report()[0] == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            for _ in drive_open_loop(world, [(0.5, 0.9)] * 300):
                monitor.note(world.read())
            reports.append(monitor.report())
        pose = planar(world.base_pose())
    assert reports[0] == reports[1]
    found, covariance, twist, rates = reports[0]
    assert planar(found) == pytest.approx(pose, abs=1e-3)
    assert twist.linear[0] == pytest.approx(pose.x / 0.3, rel=0.05)
    assert abs(pose.x) > 0.02
    plane = np.ix_([0, 1, 5], [0, 1, 5])
    for each in (np.reshape(covariance, (6, 6)), np.reshape(rates, (6, 6))):
        assert (each == each.T).all()
        assert (np.linalg.eigvalsh(each[plane]) > -1e-15).all()
        assert 0.0 < each[0, 0] < 0.1 > each[5, 5] > 0.0
        assert (np.diag(each)[[2, 3, 4]] == 1e6).all()  # which wheels do not measure


def test_where_the_truth_begins_does_not_matter():
    generator = np.random.default_rng(1)
    poses = generator.normal(size=(20, 3))
    poses[0] = 0.0
    c, s = math.cos(1.2), math.sin(1.2)
    moved = poses.copy()
    moved[:, :2] = poses[:, :2] @ np.array([[c, s], [-s, c]]) + (5.0, -3.0)
    moved[:, 2] += 1.2
    figures = base_figures(poses, moved, poses, (0.0, 0.0, 0.0))
    assert figures.odometry.largest_position < 1e-12
    assert figures.tracking.largest_heading < 1e-12
