"""Bags of other people's robots: their topics, clocks, references, and what is missing."""

from __future__ import annotations

from collections import Counter
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
    FLOATS,
    LATENCY,
    commands,
    float64,
    floats,
    in_order,
    read,
    states,
    write,
)

from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.messages import columns
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import parse_command_topics
from hpid_ros.messages.series import Losses


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


def test_a_thousand_joints_with_messages_of_their_own_are_read_in_one_go(tmp_path, monkeypatch):
    names = [f"joint_{k:04d}" for k in range(1000)]
    log = []
    for k in range(4):
        log.append(state(k * MS, **dict.fromkeys(names, 0.1 * k)))
        log += [command(k * MS, **{name: k + j / 1000}) for j, name in enumerate(names)]
    bag = write_bag(tmp_path / "bag", log)
    counts = Counter()
    learn, equal_rows = columns.LAYOUTS[JOINT_STATE], columns._equal_rows

    def learned(raw: bytes):
        counts["learned"] += 1
        return learn(raw)

    def compared(rows):
        counts["compared"] += 1
        return equal_rows(rows)

    monkeypatch.setattr(columns, "_equal_rows", compared)
    monkeypatch.setattr(columns, "LAYOUTS", {**columns.LAYOUTS, JOINT_STATE: learned})
    run = read(bag)
    assert len(run.joints) == 1000
    for j, series in enumerate(run.joints):
        np.testing.assert_array_equal(series.effort, np.arange(4) + j / 1000)
    # Each is learned once in a batch; all messages are compared once, not for each of them.
    assert counts["learned"] < 3 * len(names)
    assert counts["compared"] < 20
