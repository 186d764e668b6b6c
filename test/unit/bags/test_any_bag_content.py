"""Bags of other people's robots: their topics, clocks, references, and what is missing."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MS,
    TYPES,
    S,
    command,
    ramp,
    state,
    write_bag,
)
from harness.bags import trajectory as trajectory_message
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.analysis import run_indices
from hpid_ros.analysis.quantities import find_quantities
from hpid_ros.bags import BagSelection, parse_command_topics, read_run
from hpid_ros.bags.columns import layouts, streams
from hpid_ros.bags.columns.samples import JointSamples
from hpid_ros.bags.run.references import (
    LoggedStates,
    ReferenceEvent,
    sample_events,
    sample_setpoints,
    setpoint_events,
)
from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.cli.main import main
from hpid_ros.recordings.series import JointSeries, Losses, RunSeries
from hpid_ros.trajectory import Column, JointTrajectory, Knot, TrajectoryPoint
from hpid_ros.wire.joint_state import JointStateTemplate

FLOAT64 = "std_msgs/msg/Float64"
FLOATS = "std_msgs/msg/Float64MultiArray"
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


def float64(value: float) -> bytes:
    return bytes(TYPES.serialize_cdr(TYPES.types[FLOAT64](value), FLOAT64))


def floats(*values: float) -> bytes:
    dimension = TYPES.types["std_msgs/msg/MultiArrayDimension"]("joint", len(values), 1)
    layout = TYPES.types["std_msgs/msg/MultiArrayLayout"]([dimension], 0)
    return bytes(TYPES.serialize_cdr(TYPES.types[FLOATS](layout, np.array(values)), FLOATS))


def write(path: Path, types, log, store=TYPES) -> Path:
    """Write ``(topic, log time, raw)``."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=store)
            for name, kind in types.items()
        }
        for name, log_time_ns, raw in log:
            writer.write(connections[name], log_time_ns, raw)
    return path


LATENCY = 2000


def states(count: int = 5, topic: str = "/joint_states", offset: float = 0.0):
    """Return states of a and b, one a second from 1 s on, received 2 us after their stamps."""
    return [
        (topic, k * S + LATENCY, state(k * S, a=k + offset, b=-k - offset)[2])
        for k in range(1, count + 1)
    ]


def commands(count: int = 5, topic: str = "/joint_commands"):
    return [
        (topic, k * S + 2 * LATENCY, command(k * S, **{j: 10.0 * k})[2])
        for k in range(1, count + 1)
        for j in "ab"
    ]


def read(path: Path, **selection):
    return read_run(path, "run", selection=BagSelection(**selection))


def in_order(log):
    return sorted(log, key=lambda message: message[1])


def two_robots(path: Path) -> Path:
    types, log = {}, []
    for number, name in enumerate(("/left", "/right")):
        types |= {f"{name}/joint_states": JOINT_STATE, f"{name}/joint_commands": JOINT_STATE}
        types[f"{name}/joint_trajectory"] = JOINT_TRAJECTORY
        log += states(topic=f"{name}/joint_states", offset=100.0 * number)
        log += commands(topic=f"{name}/joint_commands")
        reference = trajectory_message(0, ramp("a", t0=float(number)))
        log += [(f"{name}/joint_trajectory", 0, reference[2])]
    return write(path, types, in_order(log))


def test_of_two_robots_one_is_chosen_by_its_namespace_or_both_are_named(tmp_path):
    path = two_robots(tmp_path / "bag")
    with pytest.raises(BagError, match=r"of /left/joint_states, /right/joint_states; choose"):
        read_run(path, "run")
    for number, namespace in enumerate(("left", "/right/")):
        run = read(path, namespace=namespace)
        assert run.joints[0].position[0] == 1.0 + 100.0 * number
        assert run.joints[0].reference.tolist() == [float(number)] * 5
        assert run.losses["a"] == Losses(0, 0)
    by_topic = read(path, states="right/joint_states")
    assert by_topic.joints[0].position[0] == 101.0
    assert by_topic.joints[0].reference.tolist() == [1.0] * 5
    with pytest.raises(BagError, match="no topic is below namespace /middle"):
        read(path, namespace="middle")


@pytest.mark.parametrize("commands", ["/joint_commands", "/arm/joint_commands"])
def test_joints_whose_states_are_on_two_topics_make_one_run(tmp_path, commands):
    """The arm's states and the gripper's have their own stamps, and so have their commands."""
    topics = {"a": "/arm/joint_states", "f": "/gripper/joint_states"}
    answers = {"a": commands, "f": commands.replace("arm", "gripper")}
    log = []
    for at, joint in enumerate(topics):
        for k in range(5):
            stamp_ns = (k + 1) * 10 * MS + at * 3 * MS
            _, _, place = state(stamp_ns, **{joint: k + 100.0 * at})
            _, _, effort = command(stamp_ns, **{joint: 10.0 * k + at})
            log += [(topics[joint], stamp_ns, place), (answers[joint], stamp_ns + 1, effort)]
    types = dict.fromkeys((*topics.values(), *answers.values()), JOINT_STATE)
    path = write(tmp_path / "bag", types, in_order(log))
    with pytest.raises(BagError, match="could be any of /arm/joint_states, /gripper/joint_states"):
        read_run(path, "run")
    run = read(path, states=list(topics.values()), reference="hold")
    assert run.joint_names == ("a", "f")
    for at, series in enumerate(run.joints):
        assert series.position.tolist() == [k + 100.0 * at for k in range(5)]
        assert series.effort.tolist() == [10.0 * k + at for k in range(5)]
        assert run.losses[series.joint] == Losses(0, 0)
    both = [*log, ("/gripper/joint_states", 70 * MS, state(70 * MS, a=1.0)[2])]
    path = write(tmp_path / "doubled", types, in_order(both))
    with pytest.raises(BagError, match="'a': its states are on /arm/joint_states and on /gripper"):
        read(path, states=list(topics.values()))


def test_topics_are_found_by_type_when_nobody_has_the_usual_name(tmp_path):
    types = {"/robot/measured": JOINT_STATE, "/robot/wanted": JOINT_STATE, "/terms": JOINT_STATE}
    log = in_order(states(topic="/robot/measured") + commands(topic="/robot/wanted"))
    path = write(tmp_path / "bag", types, log)
    with pytest.raises(BagError, match="the states could be any of /robot/measured, /robot/w"):
        read_run(path, "run")
    run = read(path, states="measured")
    assert run.joints[0].effort.tolist() == [10.0, 20.0, 30.0, 40.0, 50.0]


def test_measured_efforts_of_the_states_can_be_the_commands(tmp_path):
    template = JointStateTemplate(["a"], position=True, effort=True)
    log = [
        ("/joint_states", k * S, template.encode(k * S, position=[k], effort=[-k])) for k in (1, 2)
    ]
    path = write(tmp_path / "bag", {"/joint_states": JOINT_STATE}, log)
    for choice in ({}, {"commands": "joint_states"}):
        run = read(path, **choice)
        assert run.joints[0].effort.tolist() == [-1.0, -2.0]
        assert run.quality.joints["a"].effort == "measured, of /joint_states"
        assert run.losses["a"] == Losses(0, 0)
    run = read(path, commands="none", joints=["a"])
    assert run.joints[0].effort.size == 0
    assert run.losses["a"] == Losses(0, 0)


@pytest.mark.parametrize(
    ("kind", "name", "encode"),
    [(FLOAT64, "command", float64), (FLOATS, "commands", floats)],
)
def test_commands_without_stamps_have_their_receive_time(tmp_path, kind, name, encode):
    types = {"/joint_states": JOINT_STATE} | {f"/{j}_controller/{name}": kind for j in "abc"}
    log = states() + [
        (f"/{joint}_controller/{name}", k * S + S // 4 + LATENCY, encode(k * sign))
        for joint, sign in (("a", 1.0), ("b", -1.0), ("c", 0.0))
        for k in range(1, 6)
    ]
    path = write(tmp_path / "bag", types, in_order(log))
    unasked = read(path)  # positions and velocities look the same
    assert not any(series.has_effort for series in unasked.joints)
    assert f"/a_controller/{name}" in unasked.quality.joints["a"].no_effort
    assert "--commands effort takes them for efforts" in unasked.quality.notes[0]
    for clock, shift in (("header", 0), ("receive", LATENCY)):
        run = read(path, clock=clock, commands="effort")
        assert run.joint_names == ("a", "b")
        a = run.joints[0]
        assert a.effort.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
        assert a.state_stamps_ns.tolist() == [k * S + shift for k in range(1, 6)]
        assert a.command_stamps_ns.tolist() == [k * S + S // 4 + shift for k in range(1, 6)]
        assert run.losses["a"] == Losses(0, 0)
        quality = run.quality.joints["a"]
        assert (quality.state_clock, quality.command_clock) == (clock, "receive")
        assert not quality.answers_states


def test_receive_times_are_carried_to_a_simulated_clock(tmp_path):
    """The simulation runs at half speed, and began long ago."""
    wall = 1_700_000_000 * S
    log = [("/joint_states", wall + 2 * k * S, state(k * S, a=0.0)[2]) for k in range(1, 6)]
    log += [
        ("/a_controller/command", wall + time, float64(1.0))
        for time in (S, 3 * S + 1000, 9 * S, 10 * S + 500)
    ]
    types = {"/joint_states": JOINT_STATE, "/a_controller/command": FLOAT64}
    run = read(write(tmp_path / "bag", types, in_order(log)), commands="effort")
    assert run.joints[0].command_stamps_ns.tolist() == [
        0,
        S + S // 2 + 500,
        4 * S + S // 2,
        5 * S + 500,
    ]


def test_a_joint_is_mapped_to_a_topic_and_to_a_place_in_it(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/group/data": FLOATS, "/drive": FLOAT64}
    log = [*states(2), ("/group/data", S + 9, floats(1.0, 2.0)), ("/drive", S + 9, float64(3.0))]
    path = write(tmp_path / "bag", types, in_order(log))
    topics = parse_command_topics(["a=/group/data[1]", "b=drive"])
    run = read(path, command_topics=topics)
    assert [joint.effort.tolist() for joint in run.joints] == [[2.0], [3.0]]
    with pytest.raises(BagError, match=r"/group/data is .*MultiArray, but must be sensor_msgs"):
        read(path, commands="/group/data")
    with pytest.raises(SettingError, match=r"JOINT=TOPIC or JOINT=TOPIC\[ELEMENT\], got 'a'"):
        parse_command_topics(["a"])


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


def test_efforts_that_a_driver_fills_in_without_measuring_are_none(tmp_path):
    template = JointStateTemplate(["a", "b"], position=True, effort=True)
    for value, word in ((0.0, "zero"), (float("nan"), "not a number")):
        log = [
            ("/joint_states", k * S, template.encode(k * S, position=[k, k], effort=[value, k]))
            for k in (1, 2)
        ]
        path = write(tmp_path / word, {"/joint_states": JOINT_STATE}, log)
        run = read_run(path, "run")
        assert [series.has_effort for series in run.joints] == [False, True]
        reason = f"the efforts that /joint_states measured are {word} throughout"
        assert run.quality.joints["a"].no_effort == reason
    other = {"/joint_states": JOINT_STATE, "/gripper/joint_states": JOINT_STATE}
    log = [*states(), *states(topic="/gripper/joint_states")]
    run = read(write(tmp_path / "two", other, in_order(log)), states="/joint_states")
    assert not run.joints[0].has_effort  # the states of another robot are no commands


def test_commands_without_efforts_leave_the_measured_ones(tmp_path):
    """A position controller says no efforts, and the joints it moves are those that count."""
    template = JointStateTemplate(["a", "b"], position=True, effort=True)
    log = [
        ("/joint_states", k * S, template.encode(k * S, position=[k, k], effort=[k, -k]))
        for k in range(1, 6)
    ]
    log += [("/joint_commands", k * S + 9, state(k * S, a=1.0)[2]) for k in range(1, 6)]
    log += [("/joint_trajectory", 0, trajectory_message(0, ramp("a", t0=9.0))[2])]
    types = {
        "/joint_states": JOINT_STATE,
        "/joint_commands": JOINT_STATE,
        "/joint_trajectory": JOINT_TRAJECTORY,
    }
    run = read_run(write(tmp_path / "bag", types, in_order(log)), "run")
    assert run.joint_names == ("a",)
    assert run.joints[0].effort.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert run.quality.joints["a"].effort == "measured, of /joint_states"


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


def test_a_joint_that_is_there_for_a_while_says_so(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = []
    for k in range(100):
        joints = {"a": 0.0, "late": 1.0} if 40 <= k < 60 else {"a": 0.0}
        log += [("/joint_states", k * MS, state(k * MS, **joints)[2])]
        log += [("/joint_commands", k * MS, command(k * MS, **joints)[2])]
    path = write(tmp_path / "bag", types, log)
    late = read_run(path, "run").quality.joints["late"].states
    assert (late.count, late.begin, late.end, late.lost) == (20, 0.04, 0.059, 0)
    run = read(path, start=0.07)
    assert run.joint_names == ("a",)
    assert "'late' is left out: it has no state in the window" in run.quality.notes[0]


@given(st.sets(st.integers(1, 998), min_size=1, max_size=60))
def test_every_message_that_was_removed_is_counted_as_lost(removed):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    kept = [k for k in range(1000) if k not in removed]
    log = [("/joint_states", k * MS, state(k * MS, a=0.0)[2]) for k in kept]
    log += [("/joint_commands", k * MS + 1, command(k * MS, a=1.0)[2]) for k in range(1000)]
    with tempfile.TemporaryDirectory() as folder:
        run = read_run(write(Path(folder) / "bag", types, in_order(log)), "run")
    quality = run.quality.joints["a"]
    assert quality.states.lost == len(removed)
    assert quality.states.gaps == int(np.count_nonzero(np.diff(kept) > 1))
    assert quality.states.longest_gap == pytest.approx(float(np.diff(kept).max()) * 1e-3)
    longest = kept[int(np.argmax(np.diff(kept)))]
    assert quality.states.longest_gap_at == pytest.approx((longest - kept[0]) * 1e-3)
    assert quality.commands.is_complete
    assert not run.quality.is_complete


def test_repeats_disorder_and_numbers_that_are_none_are_counted(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    nan, infinite = float("nan"), float("inf")
    stamps = [(1, 0.5), (3, 0.5), (2, 0.5), (3, 0.5), (4, nan), (5, infinite), (6, 0.5)]
    log = [("/joint_states", k, state(t, a=x)[2]) for k, (t, x) in enumerate(stamps)]
    log += [("/joint_commands", 9, command(t, a=x)[2]) for t, x in ((1, 1.0), (2, nan))]
    run = read_run(write(tmp_path / "bag", types, log), "run")
    assert run.joints[0].state_stamps_ns.tolist() == [1, 2, 3, 6]
    found = run.quality.joints["a"].states
    assert (found.count, found.repeated, found.out_of_order, found.not_finite) == (4, 1, 1, 2)
    assert run.quality.joints["a"].commands.not_finite == 1


def test_messages_that_were_logged_out_of_order_are_put_in_order(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [("/joint_states", 1, state(1, a=0.0)[2])]
    log += [("/joint_commands", t, command(1, a=float(t))[2]) for t in (5, 9, 7)]
    run = read_run(write(tmp_path / "bag", types, log), "run")
    assert run.joints[0].effort.tolist() == [9.0]
    log = [("/joint_states", 1, state(1, a=0.0)[2])]
    framed = JointStateTemplate(["a"], "a frame of its own", effort=True)
    for t in range(10):
        raw = framed.encode(1, effort=[t]) if t % 3 else command(1, a=float(t))[2]
        log += [("/joint_commands", t, raw)]
    run = read_run(write(tmp_path / "turns", types, log), "run")
    assert run.joints[0].effort.tolist() == [9.0]
    assert run.losses["a"].repeated_commands == 9


def test_states_without_stamps_need_the_receive_time(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [("/joint_states", k * MS, state(0, a=1.0 * k)[2]) for k in (1, 2, 3)]
    log += [("/joint_commands", 4 * MS, command(0, a=1.0)[2])]
    path = write(tmp_path / "bag", types, log)
    with pytest.raises(BagError, match="carry no stamps; read them with clock 'receive'"):
        read_run(path, "run")
    run = read(path, clock="receive")
    assert run.joints[0].position.tolist() == [1.0, 2.0, 3.0]
    assert run.joints[0].command_stamps_ns.tolist() == [4 * MS]


def test_messages_that_are_not_of_their_type_are_left_out_and_reported(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [*states(), ("/joint_states", 9 * S, b"\x00\x01\x00\x00junk"), *commands()]
    run = read_run(write(tmp_path / "bag", types, in_order(log)), "run")
    assert len(run.joints[0].position) == 5
    (line,) = run.quality.unreadable
    assert line.startswith("1 messages on /joint_states are left out: a JointState of 8 bytes")


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


def test_states_and_commands_without_common_time_give_one_warning_and_no_energy(tmp_path, capsys):
    log = []
    for k in range(100):
        log += [state(k * MS, a=0.01 * k, b=0.0)]
        log += [("joint_commands", k * MS + 5, command(S * 10**9 + k * MS, a=1.0 + k, b=1.0)[2])]
    bag = write_bag(tmp_path / "bag", log)
    run = read(bag)
    (line,) = run.quality.notes
    assert "states and commands of a, b are on clocks that do not overlap" in line
    assert "0.000 s to 0.099 s and 1000000000.000 s to 1000000000.099 s" in line
    assert main(["metrics", str(bag), "--indices", "energy"]) == 0
    numbers = run_indices(run)
    energy = find_quantities(["energy"])[0]
    assert all(math.isnan(numbers.value(energy, joint)) for joint in (None, "a", "b"))
    assert numbers.joints["a"].ivc == 99.0
    assert "are on clocks that do not overlap" in capsys.readouterr().err
    both = run_indices(read(bag, clock="receive"))
    assert both.value(energy) > 0.0


def test_one_joint_without_energy_leaves_no_sum(tmp_path):
    shared = JointSeries("a", *_series(0), *_series(0)[:2])
    foreign = JointSeries("b", *_series(0), *_series(S)[:2])
    energy = find_quantities(["energy"])[0]
    numbers = run_indices(RunSeries("run", (shared, foreign)))
    assert numbers.value(energy, "a") > 0.0
    assert math.isnan(numbers.value(energy))


def _series(start_ns):
    numbers = np.arange(10.0)
    return start_ns + MS * np.arange(10), numbers, numbers


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


def test_a_thousand_joints_with_messages_of_their_own_are_read_in_one_go(tmp_path, monkeypatch):
    names = [f"joint_{k:04d}" for k in range(1000)]
    log = []
    for k in range(4):
        log.append(state(k * MS, **dict.fromkeys(names, 0.1 * k)))
        log += [command(k * MS, **{name: k + j / 1000}) for j, name in enumerate(names)]
    bag = write_bag(tmp_path / "bag", log)
    counts = Counter()
    learn, equal_rows = layouts.LAYOUTS[JOINT_STATE], streams._equal_rows

    def learned(raw: bytes):
        counts["learned"] += 1
        return learn(raw)

    def compared(rows):
        counts["compared"] += 1
        return equal_rows(rows)

    monkeypatch.setattr(streams, "_equal_rows", compared)
    monkeypatch.setattr(streams, "LAYOUTS", {**layouts.LAYOUTS, JOINT_STATE: learned})
    run = read(bag)
    assert len(run.joints) == 1000
    for j, series in enumerate(run.joints):
        np.testing.assert_array_equal(series.effort, np.arange(4) + j / 1000)
    # Each is learned once in a batch; all messages are compared once, not for each of them.
    assert counts["learned"] < 3 * len(names)
    assert counts["compared"] < 20


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
