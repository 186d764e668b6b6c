"""References that begin late, end early, leave out turns, or are of other positions and speeds."""

import math
import struct

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    S,
    ramp,
    serialised,
    trajectory,
)
from harness.foreign_bags import float64, write
from harness.recordings import CONTROLLER_STATE, DOF, DOFS, STORE, T0, header, made
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.base.errors import BagError
from hpid_ros.base.resources import share_folder
from hpid_ros.messages.columns import controller_state_layout
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics import Measuring, measure
from hpid_ros.metrics.task import EndEffector, TaskFrame
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive

FLOAT64, STRING = "std_msgs/msg/Float64", "std_msgs/msg/String"
URDF = """<robot name="r"><link name="base"/><link name="arm"/><link name="tip"/>
<joint name="j1" type="{}"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit effort="10" velocity="5" lower="-3" upper="3"/></joint>
<joint name="end" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="1 0 0"/></joint>
</robot>"""
A, B = "/a_controller/controller_state", "/b_controller/controller_state"
T = np.arange(1000) / 100
WAVE, LATE = 0.8 * np.sin(T), 0.8 * np.sin(T - 0.01)
WHEEL = 2.5 * T
BEHIND = WHEEL - 0.02 * np.cos(T)


def states(positions, times=T):
    """Return states of j1, each received 0.2 ms after its stamp."""
    log = []
    for time, position in zip(times, positions, strict=True):
        stamp_ns, none = T0 + round(time * S), np.zeros(0)
        raw = made(JOINT_STATE, header(stamp_ns), ["j1"], np.array([position]), none, none)
        log.append(("/joint_states", stamp_ns + 200_000, raw))
    return log


def reports(topic, times, references, feedback=None, later=0.0):
    """Return what a joint_trajectory_controller reports of j1, stamped some seconds later."""
    none, zero = np.zeros(0), STORE.types["builtin_interfaces/msg/Duration"](0, 0)
    point = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    multi = STORE.types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], zero)
    rest, log = [point(none, none, none, none, zero)] * 2, []
    for k, (time, reference) in enumerate(zip(times, references, strict=True)):
        stamp_ns = T0 + round((time + later) * S)
        fed = none if feedback is None else np.array([feedback[k]])
        points = [point(x, none, none, none, zero) for x in (np.array([reference]), fed)]
        fields = (["j1"], *points, *rest, [], *[multi] * 4, 1.0)
        raw = made(CONTROLLER_STATE, header(stamp_ns), *fields)
        log.append((topic, stamp_ns + 300_000, raw))
    return log


def pid_reports(topic, references, feedback):
    """Return what a pid_controller reports of j1 at all times."""
    dof, log = STORE.types[DOF], []
    for time, r, y in zip(T, references, feedback, strict=True):
        stamp_ns = T0 + round(time * S)
        raw = made(DOFS, header(stamp_ns), [dof("j1", r, y, 0.0, r - y, 0.0, 0.01, 0.0)])
        log.append((topic, stamp_ns + 300_000, raw))
    return log


def measured(path, log, kind=None, how=None, **selection):
    """Return the numbers of a recording of j1, with a URDF in which it is of some kind or none."""
    kinds = {"/joint_states": JOINT_STATE, "/robot_description": STRING}
    for topic in {each[0] for each in log} - {*kinds}:
        kinds[topic] = next(
            kind
            for end, kind in (
                ("pid_controller/controller_state", DOFS),
                ("controller_state", CONTROLLER_STATE),
                ("joint_trajectory", JOINT_TRAJECTORY),
                ("", FLOAT64),
            )
            if topic.endswith(end)
        )
    if kind is not None:
        log = [*log, ("/robot_description", T0, serialised(STRING, URDF.format(kind)))]
    log = sorted(log, key=lambda each: each[1])
    bag = write(path / "bag", kinds, log, STORE)
    return measure(bag, how=how or Measuring(BagSelection(**selection)))


def one_turn(x):
    return (x + math.pi) % math.tau - math.pi


def integral(t, y):
    return float(np.sum(np.diff(t) * (y[1:] + y[:-1])) / 2.0)


def itae(t, e):
    return integral(t, t * np.abs(e))


def lines(found, text):
    return [each for each in found.defects if text in each]


# Turns -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["continuous", None])
@pytest.mark.parametrize(
    "spans",
    [
        {A: [(500, 1000)]},
        {A: [(0, 500)], B: [(500, 1000)]},
        {A: [(0, 300), (600, 1000)]},
        {A: [(0, 300)], B: [(300, 600)], "/c/controller_state": [(700, 1000)]},
    ],
)
def test_each_stretch_of_a_wheels_reference_is_in_its_own_turn(tmp_path, kind, spans):
    log, known, ends = states(one_turn(BEHIND)), np.zeros(len(T), dtype=bool), []
    for topic, parts in spans.items():
        for begin, end in parts:
            log += reports(topic, T[begin:end], one_turn(WHEEL[begin:end]))
            known[begin:end] = True
    found = measured(tmp_path, log, kind).run.joints["j1"]
    ends = np.flatnonzero(np.diff(known.astype(int), prepend=0, append=0)).reshape(-1, 2)
    error = WHEEL - BEHIND
    expected = sum(itae(T[begin:end], error[begin:end]) for begin, end in ends)
    assert found["itae"] == pytest.approx(expected, rel=1e-9)
    assert found["error_max"] == pytest.approx(np.abs(error[known]).max(), rel=1e-9)


def test_a_wheel_that_falls_behind_after_a_late_begin_keeps_its_error(tmp_path):
    reference, position = 12.5 + 2.0 * (T[500:] - 5.0), np.minimum(WHEEL, 12.5)
    log = states(one_turn(position)) + reports(A, T[500:], one_turn(reference))
    found = measured(tmp_path, log, "continuous").run.joints["j1"]
    assert found["error_max"] == pytest.approx(reference[-1] - 12.5, rel=1e-9)


@pytest.mark.parametrize("first_at", [0, 1])
def test_a_trajectory_that_takes_over_a_wheel_begins_in_its_turn(tmp_path, first_at):
    begin = one_turn(12.5)
    goal = {f"t{first_at}": begin + 0.5 * first_at, "t2": begin + 1.0}
    _, _, raw = trajectory(0, ramp("j1", **goal))
    reference = 12.5 + 0.5 * np.clip(T[500:] - 5.0, 0.0, 2.0)
    position = np.concatenate((WHEEL[:500], reference - 0.01))
    log = [*states(one_turn(position)), ("/arm/joint_trajectory", T0 + 5 * S - 1_000_000, raw)]
    found = measured(tmp_path, log, "continuous").run.joints["j1"]
    assert found["error_max"] == pytest.approx(0.01, abs=0.011 * first_at + 1e-9)


def swerve(kind, reference, position):
    """Return the log of a steering joint that counts its turns, and the topic of its reference."""
    if kind == "setpoint":
        topic = "/j1_controller/setpoint"
        times = [T0 + round(time * S) - 1_000_000 for time in T]
        return topic, [
            (topic, at, float64(r)) for at, r in zip(times, one_turn(reference), strict=True)
        ]
    if kind == "pid":
        topic = "/pid_controller/controller_state"
        return topic, pid_reports(topic, one_turn(reference), position)
    step = 4 if kind == "slow" else 1
    return A, reports(A, T[::step], one_turn(reference)[::step], position[::step])


@pytest.mark.parametrize("kind", ["report", "slow", "pid", "setpoint"])
def test_a_reference_of_one_turn_is_unwrapped_where_the_encoder_counts_turns(tmp_path, kind):
    reference, position = 1.2 * T, 1.2 * T - 0.05
    topic, log = swerve(kind, reference, position)
    found = measured(tmp_path, states(position) + log)
    numbers = found.run.joints["j1"]
    assert numbers["itae"] == pytest.approx(itae(T, reference - position), rel=1e-9)
    assert numbers["error_max"] == pytest.approx(0.05, rel=1e-9)
    (line,) = lines(found, "jump by a turn")
    assert f"references on {topic} jump by a turn where the positions do not: j1 2 times" in line


def test_turns_that_one_controller_leaves_out_the_next_one_leaves_out_too(tmp_path):
    reference, position = 1.2 * T, 1.2 * T - 0.05
    wrapped = one_turn(reference)
    log = (
        states(position) + reports(A, T[:850], wrapped[:850]) + reports(B, T[850:], wrapped[850:])
    )
    found = measured(tmp_path, log).run.joints["j1"]
    assert found["error_max"] == pytest.approx(0.05, rel=1e-9)


@pytest.mark.parametrize("follows", [True, False])
def test_a_step_of_a_whole_turn_that_a_joint_makes_stays_one(tmp_path, follows):
    reference = np.where(T < 3.0, -3.1, -3.1 + math.tau)
    position = -3.1 + (np.clip(T - 3.0, 0.0, 2.0) / 2.0 * math.tau if follows else 0.0 * T)
    found = measured(tmp_path, states(position) + reports(A, T, reference))
    assert bool(lines(found, "jump by a turn")) is not follows
    expected = itae(T, reference - position) if follows else 0.0
    assert found.run.joints["j1"]["itae"] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_step_of_a_whole_turn_that_a_joint_makes_slowly_stays_one(tmp_path):
    reference = np.where(T < 3.0, -3.1, -3.1 + math.tau)[:600]
    position = -3.1 + np.clip(T - 3.0, 0.0, 10.0)[:600]  # it is not half there when it ends
    log = states(position, T[:600]) + reports(A, T[:600], reference)
    found = measured(tmp_path, log)
    assert not lines(found, "jump by a turn")
    assert found.run.joints["j1"]["error_max"] == pytest.approx(math.tau, rel=0.01)


def test_positions_of_a_slide_have_no_turns(tmp_path):
    reference = np.where(T % 4.0 < 2.0, 0.0, math.tau)
    log = states(0.0 * T) + reports(A, T, reference)
    found = measured(tmp_path, log, "prismatic")
    assert found.run.joints["j1"]["error_max"] == pytest.approx(math.tau)
    assert not lines(found, "jump by a turn")


# Ends ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topics", [(A, A), (A, B), (B, A)])
def test_a_motion_goes_on_before_the_first_report_and_after_the_last(tmp_path, topics):
    times = np.arange(0.025, 9.98, 0.05)
    log = states(LATE)
    for topic, which in zip(topics, (times < 3.0, times >= 3.0), strict=True):
        log += reports(topic, times[which], 0.8 * np.sin(times[which]))
    found = measured(tmp_path, log)
    numbers = found.run.joints["j1"]
    assert numbers["error_max"] == pytest.approx(np.abs(WAVE - LATE).max(), rel=0.15)
    assert numbers["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=5e-3)
    assert not lines(found, "is known from")


def test_a_step_does_not_go_on_and_the_reports_own_value_holds(tmp_path):
    times = np.arange(0.025, 9.98, 0.05)
    reference = np.where(np.arange(len(times)) < 1, 0.5, 1.0)
    reference[-1] = 2.0
    log = states(np.ones(len(T))) + reports(A, times, reference)
    found = measured(tmp_path, log).run.joints["j1"]
    assert found["error_max"] == 1.0  # of the last report, held; 0.5 of the first one
    whole = np.interp(T, times, reference) - 1.0
    assert found["itae"] == pytest.approx(itae(T, whole), rel=1e-12)


# The end effector ------------------------------------------------------------------------------


def tip(log, path):
    robot = TaskFrame(RobotDescription.load(URDF.format("revolute")), "tip")
    return measured(path, log, how=Measuring(robot=robot))


def test_an_end_effector_counts_while_all_references_are_known(tmp_path):
    known = np.r_[100:300, 500:1000]
    log = states(LATE) + reports(A, T[known], WAVE[known])
    found = tip(log, tmp_path)
    away = 2.0 * np.abs(np.sin((WAVE - LATE)[known] / 2.0))
    tracking = found.end_effector.tracking
    assert tracking.rms_position == pytest.approx(math.sqrt(np.mean(away**2)), rel=1e-9)
    assert tracking.largest_position == pytest.approx(away.max(), rel=1e-9)
    path = found.end_effector_path
    assert np.linalg.norm(path.reference - path.position, axis=1).max() <= away.max() + 1e-12


def joint_series(joint, position, reference, known=None):
    stamps, none = np.arange(len(position), dtype=np.int64) * S // 100, np.empty(0)
    arrays = (stamps, position, reference, none.astype(np.int64), none)
    return JointSeries(joint, *arrays, known=known)


def test_an_end_effector_without_a_time_in_which_all_is_known_is_told():
    robot = RobotDescription.load(URDF.format("revolute"))
    frame, never = TaskFrame(robot, "tip"), np.zeros(5, dtype=bool)
    run = RunSeries("run", (joint_series("j1", np.zeros(5), np.ones(5), never),))
    with pytest.raises(BagError, match="the references of j1 are never known at one time"):
        EndEffector(frame, run)


def test_a_base_is_wanted_to_go_as_it_goes_while_a_wheels_reference_is_unknown():
    robot = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
    wheels = ("wheel_left_joint", "wheel_right_joint")
    driven, known = np.linspace(0.0, 20.0, 1000), np.arange(1000) >= 500
    joints = [joint_series("arm_joint_1", np.zeros(1000), np.zeros(1000))]
    for wheel, ratio in zip(wheels, (0.5, 1.0), strict=True):
        unknown = np.where(known, ratio * driven, 99.0)
        joints.append(joint_series(wheel, ratio * driven, unknown, known))
    frame = TaskFrame(robot, "payload", DifferentialDrive.of(robot, *wheels))
    figures = EndEffector(frame, RunSeries("run", tuple(joints))).figures()
    assert figures.tracking.largest_position == pytest.approx(0.0, abs=1e-12)


# What controllers are fed ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shown", "largest"),
    [
        (LATE + 0.1, 0.1),
        (np.degrees(LATE), 45.0),
        (1.5 * LATE, 0.4),
        (0.8 * np.sin(T - 0.5), 0.39),  # another clock
    ],
)
def test_a_controller_that_is_fed_other_positions_than_the_states_is_told(
    tmp_path, shown, largest
):
    found = measured(tmp_path, states(shown) + reports(A, T, WAVE, LATE))
    (line,) = lines(found, "other positions")
    begin, _, rest = line.partition("(by up to ")
    assert begin.endswith(f"{A} reports other positions of j1 than /joint_states has ")
    assert float(rest.split()[0]) == pytest.approx(largest, rel=0.2)
    assert rest.endswith(" rad): the error is against the states")


def test_a_pid_controller_that_is_fed_other_positions_is_told_and_counts(tmp_path):
    topic = "/pid_controller/controller_state"
    found = measured(tmp_path, states(LATE + 0.1) + pid_reports(topic, WAVE, LATE))
    assert lines(found, f"{topic} reports other positions of j1")
    assert not lines(found, "reports no positions")
    error = WAVE - LATE - 0.1
    assert found.run.joints["j1"]["itae"] == pytest.approx(itae(T, error), rel=1e-9)


@pytest.mark.parametrize(
    "case", ["equal", "later", "slow", "noise", "zero", "wheel", "counts", "a gap"]
)
def test_a_controller_that_is_fed_the_states_is_not_told(tmp_path, case):
    fed, shown, times, later = LATE, LATE, T, 0.0
    if case in ("wheel", "counts", "a gap"):
        fed, shown = BEHIND, one_turn(BEHIND)
    if case == "wheel":
        fed = one_turn(fed)
    if case == "noise":
        shown = LATE + np.random.default_rng(1).normal(0.0, 0.003, len(T))
    if case == "zero":  # the field is there, and nobody fills it
        fed = np.zeros(len(T))
    if case == "later":
        fed = shown = 0.5 * np.sin(6.0 * T)
        later = 0.02
    step = slice(0, None, 7) if case == "slow" else slice(None)
    kept = (T < 3.0) | (T > 6.0) if case == "a gap" else T >= 0.0
    log = states(shown[kept], T[kept])
    log += reports(A, times[step], fed[step], fed[step], later)
    assert not lines(measured(tmp_path, log, "continuous"), "other positions")


def test_the_feedback_is_found_in_all_forms_of_a_controllers_state():
    none, zero = np.zeros(0), STORE.types["builtin_interfaces/msg/Duration"](0, 0)
    forms = {  # numbers of the points, of which that of the feedback comes second
        "rolling": ("reference", "feedback", "error", "output"),
        "humble": ("reference", "feedback", "error", "output", "desired", "actual"),
        "foxy": ("desired", "actual", "error"),
    }
    for names in forms.values():
        types = get_typestore(Stores.ROS2_JAZZY)
        text = "std_msgs/Header header\nstring[] joint_names\n"
        text += "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in names)
        text += "string[] multi_dof_joint_names\n"
        multi = "trajectory_msgs/MultiDOFJointTrajectoryPoint"
        text += "".join(f"{multi} multi_dof_{name}\n" for name in names)
        types.register(get_types_from_msg(text, CONTROLLER_STATE))
        point = types.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        rest = [types.types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], zero)]
        for is_old in (False, True) if "actual" in names and len(names) == 6 else (False,):
            filled = names[4:] if is_old else names[:2]
            points = [
                point(np.array([k + 1.0]) if name in filled else none, none, none, none, zero)
                for k, name in enumerate(names)
            ]
            fields = (header(T0), ["j1"], *points, [], *rest * len(names))
            message = types.types[CONTROLLER_STATE](*fields)
            raw = bytes(types.serialize_cdr(message, CONTROLLER_STATE))
            layout = controller_state_layout(raw)
            found = [
                struct.unpack_from("<d", raw, layout.fields[name].offset)[0]
                for name in ("reference", "feedback")
            ]
            assert found == ([5.0, 6.0] if is_old else [1.0, 2.0])


# Speed -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("has_reports", [False, True])
def test_a_trajectory_beside_a_speed_scaling_may_have_been_slower(tmp_path, has_reports):
    topic = "/speed_scaling_state_broadcaster/speed_scaling"
    _, _, raw = trajectory(0, ramp("j1", t0=0.0, t4=1.0))
    position = np.clip((T - 1.0) / 8.0, 0.0, 1.0)
    log = [*states(position), ("/arm/joint_trajectory", T0 + S - 1_000_000, raw)]
    log += [(topic, T0 + k * S // 50, float64(50.0)) for k in range(500)]
    if has_reports:
        log += reports(A, T, position)
    found = lines(measured(tmp_path, log), "speed")
    assert len(found) == (0 if has_reports else 1)
    if found:
        assert "the trajectory of j1 may have been followed at another speed" in found[0]
        assert f"{topic} is not read" in found[0]
