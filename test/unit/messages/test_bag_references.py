"""What a joint was told to follow, as a bag has it: trajectories, setpoints, samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MS,
    S,
    command,
    ramp,
    state,
    write_bag,
)
from harness.bags import trajectory as trajectory_message
from harness.foreign_bags import (
    FLOAT64,
    commands,
    float64,
    in_order,
    read,
    states,
    write,
)
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.messages.columns import JointSamples
from hpid_ros.messages.joint_run import (
    LoggedStates,
    ReferenceEvent,
    sample_events,
    sample_setpoints,
    setpoint_events,
)
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import Losses
from hpid_ros.motion import Column, JointTrajectory, Knot, TrajectoryPoint

CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
HEAD = "std_msgs/Header header\nstring[] joint_names\n"
POINT, MULTI = (
    "trajectory_msgs/JointTrajectoryPoint",
    "trajectory_msgs/MultiDOFJointTrajectoryPoint",
)
FORMS = {
    "foxy": ("desired", "actual", "error"),
    "galactic": ("desired", "actual", "error"),
    "iron": ("reference", "feedback", "error", "output"),
    "jazzy": ("reference", "feedback", "error", "output"),
}


def state_types(form: str):
    """Return a typestore with one of the forms that the message had."""
    text = HEAD + "".join(f"{POINT} {name}\n" for name in FORMS[form])
    if form != "foxy":
        text += "string[] multi_dof_joint_names\n"
        text += "".join(f"{MULTI} multi_dof_{name}\n" for name in FORMS[form])
    if form == "jazzy":
        text += "float64 speed_scaling_factor\n"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, CONTROLLER_STATE))
    return store


def controller_state(form: str, stamp_ns: int, references, efforts) -> bytes:
    store = state_types(form)
    types = store.types
    duration = types["builtin_interfaces/msg/Duration"](0, 0)
    point, multi = (
        types[f"trajectory_msgs/msg/{name}"]
        for name in ("JointTrajectoryPoint", "MultiDOFJointTrajectoryPoint")
    )
    none = np.zeros(0)
    header = types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, S)), "x"
    )
    points = [point(np.array(references, float), none, none, none, duration)]
    points += [point(np.ones(2), none, none, none, duration)] * 2
    points += [point(none, none, none, np.array(efforts, float), duration)]
    fields = [header, ["a", "b"], *points[: len(FORMS[form])]]
    if form != "foxy":
        fields += [[], *[multi([], [], [], duration)] * len(FORMS[form])]
    if form == "jazzy":
        fields.append(1.0)
    return bytes(store.serialize_cdr(types[CONTROLLER_STATE](*fields), CONTROLLER_STATE))


@pytest.mark.parametrize("form", list(FORMS))
def test_states_of_a_trajectory_controller_give_reference_and_effort(tmp_path, form):
    types = {"/joint_states": JOINT_STATE, "/jtc/controller_state": CONTROLLER_STATE}
    log = states() + [
        ("/jtc/controller_state", k * S + 5, controller_state(form, k * S, (k, -k), (7 * k, 0.5)))
        for k in (1, 2, 3, 5)
    ]
    path = write(tmp_path / "bag", types, in_order(log), state_types(form))
    run = read_run(path, "run")
    a, b = run.joints
    assert a.reference.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert b.reference.tolist() == [-1.0, -2.0, -3.0, -4.0, -5.0]
    has_effort = "output" in FORMS[form]
    assert a.effort.tolist() == ([7.0, 14.0, 21.0, 35.0] if has_effort else [])
    quality = run.quality.joints["a"]
    assert quality.reference == "controller_state /jtc/controller_state"
    assert quality.references == 4
    assert run.losses["a"] == Losses(1 if has_effort else 0, 0)


def with_references(path: Path) -> Path:
    types = {
        "/joint_states": JOINT_STATE,
        "/joint_commands": JOINT_STATE,
        "/joint_trajectory": JOINT_TRAJECTORY,
        "/a_controller/setpoint": FLOAT64,
        "/b_controller/setpoint": FLOAT64,
        "/a_controller/reference": JOINT_STATE,
        "/a_controller/terms": JOINT_STATE,
    }
    log = states() + commands()
    log += [("/joint_trajectory", 2 * S, trajectory_message(0, ramp("a", t0=9.0))[2])]
    log += [("/a_controller/setpoint", 4 * S, float64(5.0))]
    log += [("/a_controller/reference", k * S, state(k * S, a=k / 2)[2]) for k in (2, 4)]
    return write(path, types, in_order(log))


def test_references_come_from_where_they_are_asked_from(tmp_path):
    path = with_references(tmp_path / "bag")
    expected = {
        "auto": [1.0, 9.0, 9.0, 5.0, 5.0],
        "trajectory": [1.0, 9.0, 9.0, 9.0, 9.0],
        "setpoint": [1.0, 1.0, 1.0, 5.0, 5.0],
        "sampled": [1.0, 1.0, 1.5, 2.0, 2.0],
        "hold": [1.0] * 5,
        "/joint_trajectory": [1.0, 9.0, 9.0, 9.0, 9.0],
        "a_controller/setpoint": [1.0, 1.0, 1.0, 5.0, 5.0],
        "a_controller/reference": [1.0, 1.0, 1.5, 2.0, 2.0],
    }
    for source, reference in expected.items():
        run = read(path, reference=source)
        assert run.joints[0].reference.tolist() == reference, source
        assert run.joints[1].reference.tolist() == ([-1.0] * 5 if source == "hold" else [])
    assert read(path).quality.joints["a"].reference == (
        "trajectory /joint_trajectory and setpoint /a_controller/setpoint"
    )
    assert read(path).quality.joints["b"].reference == "none"
    assert read(path, reference="hold").quality.joints["b"].reference == "hold"
    begins = [read(path).quality.joints[joint].reference_from for joint in "ab"]
    assert begins == [1.0, None]
    with pytest.raises(BagError, match="no controller_state as reference; topics: "):
        read(path, reference="controller_state")


def test_a_reference_that_is_given_is_followed_from_the_first_state_on(tmp_path):
    path = with_references(tmp_path / "bag")
    given = ramp("a", t0=1.0, t2=5.0)
    for clock in ("header", "receive"):
        run = read(path, reference=given, clock=clock)
        assert run.joints[0].reference.tolist() == [1.0, 3.0, 5.0, 5.0, 5.0]
        assert not run.joints[1].has_reference
        assert run.quality.joints["a"].reference == "given"
    assert read(path, reference=given, start=2.0).joints[0].reference.tolist() == [5.0] * 3


numbers = st.floats(-1e6, 1e6)


@st.composite
def columns(draw):
    times = sorted(draw(st.sets(st.integers(0, 3 * S), min_size=1, max_size=5)))
    rates = draw(st.integers(0, 2))
    knots = tuple(
        Knot(
            time,
            draw(numbers),
            draw(numbers) if rates > 0 else None,
            draw(numbers) if rates > 1 else None,
        )
        for time in times
    )
    return Column("a", knots, draw(st.sampled_from([0, S, 2 * S, 9 * S])))


@given(columns(), st.integers(1, 5 * S), st.lists(st.integers(1, 8 * S), max_size=30), numbers)
def test_arrays_of_references_are_those_of_the_spline_to_the_bit(column, first, later, hold):
    stamps = np.unique(np.array([first, *[first + each for each in later]], dtype=np.int64))
    logged = LoggedStates(stamps, stamps, stamps)
    sampled = sample_events([ReferenceEvent(0, 0, column)], logged, stamps, hold)
    spline = column.start(first, hold)
    expected = np.array([spline.sample(stamp).position for stamp in stamps.tolist()])
    assert sampled.tobytes() == expected.tobytes()


@given(
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 200)), max_size=30, unique=True),
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 60)), min_size=1, max_size=30),
)
def test_setpoints_taken_at_once_are_those_taken_one_by_one(told, heard):
    heard.sort(key=lambda state: state[0])
    columns = [np.array(column, dtype=np.int64) for column in zip(*heard, strict=True)]
    states = LoggedStates(columns[0], 2 * np.arange(len(heard)) + 1, columns[1])
    stamps_ns = np.unique(states.stamps_ns)
    log_times, places = (np.array([each[k] for each in told], dtype=np.int64) for k in (0, 1))
    setpoints = JointSamples(None, log_times, places, 1.0 + np.arange(len(told)))
    events = sorted(setpoint_events("a", setpoints), key=lambda event: event[:2])
    expected = sample_events(events, states, stamps_ns, 0.5)
    found = sample_setpoints(setpoints, states, stamps_ns, 0.5)
    if (np.diff(states.stamps_ns) >= 0).all():
        assert found is not None
    if found is not None:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_a_trajectory_of_a_hundred_thousand_points_is_sampled_exactly(tmp_path):
    points = 100_000
    times = np.arange(points) * 10_000
    positions = np.sin(1e-3 * np.arange(points))
    motion = JointTrajectory(
        ("a",),
        tuple(TrajectoryPoint(int(t), (float(q),)) for t, q in zip(times, positions, strict=True)),
    )
    log = [(name, 0, raw) for name, _, raw in [trajectory_message(0, motion)]]
    for k in range(1, 900):
        log += [state(k * MS, a=0.0), command(k * MS, a=0.0)]
    (series,) = read(write_bag(tmp_path / "bag", log)).joints
    # The trajectory begins with the first state.
    np.testing.assert_allclose(series.reference, positions[100 * np.arange(899)], atol=1e-12)


def test_a_window_cuts_states_and_commands_but_not_what_was_told_before(tmp_path):
    run = read(with_references(tmp_path / "bag"), start=2.0, end=3.0)
    a = run.joints[0]
    assert a.state_stamps_ns.tolist() == [3 * S, 4 * S]
    assert a.command_stamps_ns.tolist() == [3 * S, 4 * S]
    assert a.reference.tolist() == [9.0, 5.0]
    assert run.quality.joints["a"].states.begin == 2.0
    assert run.losses["a"] == Losses(0, 0)
    with pytest.raises(BagError, match=r"no joint has a state from 7.0 s to 9.0 s"):
        read(tmp_path / "bag", start=7.0, end=9.0)
    for bad in ({"start": -1.0}, {"start": 2.0, "end": 1.0}, {"clock": "wall"}, {"joints": []}):
        with pytest.raises(SettingError):
            BagSelection(**bad)
