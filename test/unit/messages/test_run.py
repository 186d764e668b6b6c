"""A run comes out of a bag as it went in; what a bag lacks, repeats and confuses is reported."""

import math
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness.bags import (
    FLOATS,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MS,
    TYPES,
    S,
    bits,
    command,
    floats,
    ramp,
    read_one,
    small_log,
    state,
    trajectory,
    write_bag,
)
from harness.foreign_bags import FLOAT64, LATENCY, commands, float64, in_order, read, states, write
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.cli.main import main
from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.messages import columns
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.reading.topic_choice import choose_topics
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection, parse_command_topics
from hpid_ros.messages.series import JointSeries, Losses, RunSeries
from hpid_ros.metrics import run_indices
from hpid_ros.metrics.quantities import find_quantities

NAN = float("nan")
TWO = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
finite = st.floats(-9e49, 9e49)  # beyond 1e50 no joint is
stamps = st.lists(st.integers(-(2**31) * S, 2**31 * S - 1), min_size=1, max_size=12, unique=True)


def refused(path: Path, word: str, **options: object) -> None:
    with pytest.raises(BagError, match=word) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def measured(k: float, *efforts: float) -> tuple[str, int, bytes]:
    """Return a state of a, b and so on with measured efforts."""
    template = JointStateTemplate("ab"[: len(efforts)], position=True, effort=True)
    raw = template.encode(int(k) * S, position=[k] * len(efforts), effort=efforts)
    return "/joint_states", int(k) * S, raw


@given(stamps.flatmap(lambda t: st.tuples(*[st.tuples(st.just(s), finite, finite) for s in t])))
def test_values_come_back_to_the_bit_ordered_by_stamp(samples):
    with tempfile.TemporaryDirectory() as folder:
        log = []
        for k, (stamp_ns, position, effort) in enumerate(samples):
            for topic, _, raw in (
                state(stamp_ns, b=0.0, a=position),
                command(stamp_ns, a=effort),
                command(stamp_ns, b=1.0),
            ):
                log.append((topic, k, raw))
        series, losses = read_one(Path(folder) / "bag", log)
    stamps_ns, positions, efforts = zip(*sorted(samples), strict=True)
    assert tuple(series.state_stamps_ns) == tuple(series.command_stamps_ns) == stamps_ns
    assert bits(series.position) == bits(positions)
    assert bits(series.effort) == bits(efforts)
    assert losses == Losses(0, 0)


def test_losses_are_counted_and_of_a_repeated_stamp_the_last_stands(tmp_path):
    log = [
        state(1, a=1.0, b=0.0),
        command(1, a=-1.0),
        state(2, a=9.0, b=0.0),
        state(2, a=2.0, b=0.0),
        command(2, b=0.5),
        state(4, a=4.0, b=0.0),
        ("joint_commands", 5, command(4, a=-4.0)[2]),
        ("joint_commands", 6, command(1, a=-1.5)[2]),
        ("joint_commands", 7, command(1, a=-1.25)[2]),
        ("joint_states", 8, state(3, a=3.0, b=0.0)[2]),
    ]
    run = read_run(write_bag(tmp_path / "bag", log), "run")
    a, b = run.joints
    assert (run.label, a.joint, b.joint) == ("run", "a", "b")
    assert a.state_stamps_ns.tolist() == [1, 2, 3, 4]
    assert a.position.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert a.command_stamps_ns.tolist() == [1, 4]
    assert a.effort.tolist() == [-1.25, -4.0]
    assert run.losses == {"a": Losses(2, 2), "b": Losses(3, 0)}


def test_joints_that_nobody_controls_are_left_out_unless_asked_for(tmp_path):
    reference = trajectory(0, ramp("c", t0=1.0))
    log = [reference, state(1, a=1.0, caster=0.0, b=2.0, c=3.0), command(1, a=0.0, b=0.0, zz=1.0)]
    path = write_bag(tmp_path / "bag", log)
    assert read(path).joint_names == ("a", "b", "c")
    run = read_run(path, "run", joints=["caster", "a"])
    assert run.joint_names == ("caster", "a")
    assert run.joints[0].effort.size == 0
    assert run.losses["caster"] == Losses(1, 0)


def test_layouts_may_change_and_mix(tmp_path):
    big_endian = TYPES.serialize_cdr(
        TYPES.deserialize_cdr(state(3, a=3.0, b=-3.0)[2], JOINT_STATE),
        JOINT_STATE,
        little_endian=False,
    )
    odd_padding = bytearray(state(4, a=4.0, b=-4.0)[2])
    end_of_frame_id = 4 + 8 + 4 + 1
    odd_padding[end_of_frame_id : end_of_frame_id + 3] = b"\x07\x07\x07"
    framed = JointStateTemplate(["a"], "base", position=True, velocity=True, effort=True)
    no_position = JointStateTemplate(["a"], velocity=True)
    log = [
        state(1, a=1.0),
        ("joint_states", 2, framed.encode(2, position=[2.0], velocity=[0.0], effort=[0.0])),
        ("joint_states", 3, bytes(big_endian)),
        ("joint_states", 4, bytes(odd_padding)),
        state(5, b=-5.0, a=7.0),
        state(5, a=5.0),  # in another layout, and still the last
        ("joint_states", 6, no_position.encode(6, velocity=[1.0])),
        state(7, other=1.0),
        state(8, a=8.0),
        ("joint_commands", 9, framed.encode(8, position=[0.0], velocity=[0.0], effort=[0.5])),
        command(9, b=0.1, a=0.9),
        ("joint_commands", 10, no_position.encode(10, velocity=[1.0])),
    ]
    series, losses = read_one(tmp_path / "bag", log)
    assert series.state_stamps_ns.tolist() == [1, 2, 3, 4, 5, 8]
    assert series.position.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 8.0]
    assert series.command_stamps_ns.tolist() == [8, 9]
    assert series.effort.tolist() == [0.5, 0.9]
    assert losses == Losses(5, 0)


def test_a_thousand_joints_with_messages_of_their_own_are_read_in_one_go(tmp_path, monkeypatch):
    names = [f"joint_{k:04d}" for k in range(1000)]
    log = []
    for k in range(4):
        log.append(state(k * MS, **dict.fromkeys(names, 0.1 * k)))
        log += [command(k * MS, **{name: k + j / 1000}) for j, name in enumerate(names)]
    bag = write_bag(tmp_path / "bag", log)
    counts = Counter()

    def counted(name, function):
        def count(argument):
            counts[name] += 1
            return function(argument)

        return count

    learn = counted("learned", columns.LAYOUTS[JOINT_STATE])
    monkeypatch.setattr(columns, "LAYOUTS", {**columns.LAYOUTS, JOINT_STATE: learn})
    monkeypatch.setattr(columns, "_equal_rows", counted("compared", columns._equal_rows))
    run = read(bag)
    assert len(run.joints) == 1000
    for j, series in enumerate(run.joints):
        np.testing.assert_array_equal(series.effort, np.arange(4) + j / 1000)
    # Each is learned once in a batch; all messages are compared once, not for each of them.
    assert counts["learned"] < 3 * len(names)
    assert counts["compared"] < 20


def test_what_is_no_bag_is_one_line(tmp_path):
    refused(tmp_path / "missing", "no such file or folder")
    refused(tmp_path, "the folder has no .mcap, .db3 or .bag file")
    for name, content in (("b.txt", "x"), ("e.mcap", ""), ("e.db3", ""), ("x.mcap", "x" * 99)):
        (tmp_path / name).write_text(content)
        refused(tmp_path / name, "cannot read bag")
    (tmp_path / "head.mcap").write_bytes(b"\x89MCAP0\r\n")
    refused(tmp_path / "head.mcap", "no topic of states .*the end is missing")
    folder = tmp_path / "folder"
    folder.mkdir()
    for text in ("", "a: [", "[]", "rosbag2_bagfile_information: {version: 9}"):
        (folder / "metadata.yaml").write_text(text)
        refused(folder, "no .mcap, .db3 or .bag file")
    named = {"rosbag2_bagfile_information": {"relative_file_paths": ["gone.mcap"]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(named))
    refused(folder, "gone.mcap: the file is missing")


def test_a_missing_topic_joint_or_message_is_named_with_what_there_is(tmp_path):
    path = write_bag(tmp_path / "bag", small_log())
    near = "did you mean '/joint_states'.*known: /joint_commands, /joint_states, /joint_traj"
    refused(path, near, states="joint_state")
    refused(path, "known: a, b", joints=["a", "elbow"])
    for what in ("states", "commands"):
        refused(path, "is trajectory_msgs/msg/J.*, but must be", **{what: "joint_trajectory"})
    refused(path, "unknown topic 'nowhere'", reference="nowhere")
    refused(write_bag(tmp_path / "empty", []), "no message on /joint_states")
    silent = write_bag(tmp_path / "silent", [state(1, a=1.0)])
    counted = "no message on /joint_commands; messages: /joint_commands 0, /joint_states 1"
    refused(silent, counted, commands="joint_commands")
    (series,) = read(silent).joints
    assert not series.has_effort
    assert not series.has_reference
    both = dict.fromkeys(("/robot/measured", "/robot/wanted"), JOINT_STATE)
    with pytest.raises(BagError, match="the states could be any of /robot/measured, /robot/w"):
        choose_topics("bag", both, BagSelection())
    foreign = write_bag(tmp_path / "foreign", [state(1, a=1.0), command(1, b=1.0)])
    refused(foreign, "no joint of /joint_states is commanded")


@pytest.mark.parametrize(
    ("log", "word"),
    [
        ([state(1, a=NAN), command(1, a=0.0)], "joint 'a': position must be finite"),
        ([("joint_states", 1, b"\x00\x01\x00\x00"), command(1, a=0.0)], "of 4 bytes ends"),
        (
            [*small_log(), ("joint_trajectory", 5, b"\x00\x01")],
            "/joint_trajectory at 5 ns: a JointTrajectory must start with",
        ),
    ],
)
def test_values_that_no_analysis_can_use_are_named(tmp_path, log, word):
    refused(write_bag(tmp_path / "bag", log), word)


def test_of_two_robots_one_is_chosen_by_its_namespace_or_both_are_named(tmp_path):
    types, log = {}, []
    for number, name in enumerate(("/left", "/right")):
        types |= {f"{name}{topic}": kind for topic, kind in TWO.items()}
        types[f"{name}/joint_trajectory"] = JOINT_TRAJECTORY
        log += states(topic=f"{name}/joint_states", offset=100.0 * number)
        log += commands(topic=f"{name}/joint_commands")
        reference = trajectory(0, ramp("a", t0=float(number)))
        log += [(f"{name}/joint_trajectory", 0, reference[2])]
    path = write(tmp_path / "bag", types, in_order(log))
    refused(path, r"of /left/joint_states, /right/joint_states; choose")
    for number, choice in (
        (0, {"namespace": "left"}),
        (1, {"namespace": "/right/"}),
        (1, {"states": "right/joint_states"}),
    ):
        run = read(path, **choice)
        assert run.joints[0].position[0] == 1.0 + 100.0 * number
        assert run.joints[0].reference.tolist() == [float(number)] * 5
        assert run.losses["a"] == Losses(0, 0)
    refused(path, "no topic is below namespace /middle", namespace="middle")


@pytest.mark.parametrize(
    ("topics", "states", "expected"),
    [
        ("/joint_states /terms /a_controller/estimate", None, ""),
        ("/joint_states /gripper/joint_states", "/joint_states", ""),
        ("/left/joint_states /right/joint_states /right/joint_commands", "/left/joint_states", ""),
        (
            "/left/joint_states /right/joint_states /right/joint_commands",
            "/right/joint_states",
            "/right/joint_commands",
        ),
        ("/joint_states /sim/joint_states /sim/joint_commands", "/joint_states", ""),
        ("/joint_states /arm/joint_commands", None, "/arm/joint_commands"),
        ("/robot/measured /robot/wanted /terms", "measured", "/robot/wanted"),
        ("/joint_states /joint_commands /arm/joint_command", None, "/joint_commands"),
    ],
)
def test_commands_are_found_by_name_then_type_and_are_never_another_robots(
    topics, states, expected
):
    types = dict.fromkeys(topics.split(), JOINT_STATE)
    choice = choose_topics("bag", types, BagSelection(states=states))
    assert choice.is_measured == (not expected)
    assert choice.commands == ((expected,) if expected else choice.states)
    named = () if expected else tuple(each for each in types if each.endswith("joint_commands"))
    assert choice.others == named


def test_commands_that_are_left_to_another_robot_are_named(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/arm/joint_states": JOINT_STATE}
    types["/arm/joint_commands"] = JOINT_STATE
    log = states() + states(topic="/arm/joint_states") + commands(topic="/arm/joint_commands")
    path = write(tmp_path / "bag", types, in_order(log))
    note = read(path, states="/joint_states").quality.notes[0]
    assert note.startswith("/arm/joint_commands: not read, as another robot's")
    notes = read(path, states="/joint_states", commands="/arm/joint_commands").quality.notes
    assert not any("another robot" in each for each in notes)


def test_a_simulation_that_was_reset_is_not_laid_over_itself(tmp_path):
    """A few states that come late are put in order."""
    for count in (3, 300):
        log = [
            ("/joint_states", run * S + k * MS, state(k * MS + 5 * S * (run == 0), a=float(k))[2])
            for run, length in ((0, 400), (1, count))
            for k in range(length)
        ]
        path = write(tmp_path / f"bag_{count}", {"/joint_states": JOINT_STATE}, log)
        if count == 3:
            assert len(read(path).joints[0].position) == 403
            continue
        refused(path, "the clock of its states went back by 5.* s, or two senders")
        assert len(read(path, clock="receive").joints[0].position) == 700


def test_commands_without_stamps_are_placed_by_when_they_were_received(tmp_path):
    """Not taken for one command that is repeated."""
    log = states() + [
        ("/joint_commands", k * S + 2 * LATENCY, command(0, a=10.0 * k)[2]) for k in range(1, 6)
    ]
    path = write(tmp_path / "bag", TWO, in_order(log))
    run = read(path)
    assert run.joints[0].effort.tolist() == [10.0, 20.0, 30.0, 40.0, 50.0]
    assert run.quality.joints["a"].command_clock == "receive"


@pytest.mark.parametrize("offset", [-S, 0, 10**18])
def test_a_sampled_reference_of_another_clock_is_placed_by_when_it_was_received(tmp_path, offset):
    """Without stamps, or with those of the wall beside a simulation's."""
    types = {"/joint_states": JOINT_STATE, "/a_controller/reference": JOINT_STATE}
    log = states() + [
        (
            "/a_controller/reference",
            k * S + 2 * LATENCY,
            state(0 if offset < 0 else offset + k * S, a=float(k))[2],
        )
        for k in range(2, 6)
    ]
    run = read(write(tmp_path / "bag", types, in_order(log)))
    (series, *_) = run.joints
    assert series.known is not None
    assert not series.known[0]  # nobody knows what it was before the first one
    assert series.known[1:].all()
    assert series.reference[1:] == pytest.approx([2.0, 3.0, 4.0, 5.0], abs=1e-5)
    is_odd = "received" in run.quality.joints["a"].reference
    assert is_odd is (offset != 0)


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
    refused(path, "could be any of /arm/joint_states, /gripper/joint_states")
    run = read(path, states=list(topics.values()), reference="hold")
    assert run.joint_names == ("a", "f")
    for at, series in enumerate(run.joints):
        assert series.position.tolist() == [k + 100.0 * at for k in range(5)]
        assert series.effort.tolist() == [10.0 * k + at for k in range(5)]
        assert run.losses[series.joint] == Losses(0, 0)
    both = [*log, ("/gripper/joint_states", 70 * MS, state(70 * MS, a=1.0)[2])]
    path = write(tmp_path / "doubled", types, in_order(both))
    refused(path, "'a': its states are on /arm/j.* and on /gripper", states=list(topics.values()))


def test_measured_efforts_of_the_states_can_be_the_commands(tmp_path):
    log = [measured(k, -k) for k in (1.0, 2.0)]
    path = write(tmp_path / "bag", {"/joint_states": JOINT_STATE}, log)
    for choice in ({}, {"commands": "joint_states"}):
        run = read(path, **choice)
        assert run.joints[0].effort.tolist() == [-1.0, -2.0]
        assert run.quality.joints["a"].effort == "measured, of /joint_states"
        assert run.losses["a"] == Losses(0, 0)
    run = read(path, commands="none", joints=["a"])
    assert run.joints[0].effort.size == 0
    assert run.losses["a"] == Losses(0, 0)


@pytest.mark.parametrize(("value", "word"), [(0.0, "zero"), (NAN, "not a number")])
def test_efforts_that_a_driver_fills_in_without_measuring_are_none(tmp_path, value, word):
    log = [measured(k, value, k) for k in (1.0, 2.0)]
    run = read(write(tmp_path / "bag", {"/joint_states": JOINT_STATE}, log))
    assert [series.has_effort for series in run.joints] == [False, True]
    reason = f"the efforts that /joint_states measured are {word} throughout"
    assert run.quality.joints["a"].no_effort == reason


def test_a_window_without_efforts_and_flaws_outside_of_it_are_said_to_be(tmp_path):
    log = [*states(), *commands(2), *commands(1)]
    quality = read(write(tmp_path / "bag", TWO, in_order(log)), start=3.0).quality
    assert "no effort lies within the time" in quality.joints["a"].no_effort
    assert "is counted in the whole recording" in quality.notes[-1]


def test_commands_without_efforts_leave_the_measured_ones(tmp_path):
    """A position controller sends no efforts, and the joints it moves are those that count."""
    log = [measured(k, k, -k) for k in (1.0, 2.0, 3.0, 4.0, 5.0)]
    log += [("/joint_commands", k * S + 9, state(k * S, a=1.0)[2]) for k in range(1, 6)]
    log += [("/joint_trajectory", 0, trajectory(0, ramp("a", t0=9.0))[2])]
    types = {**TWO, "/joint_trajectory": JOINT_TRAJECTORY}
    run = read(write(tmp_path / "bag", types, in_order(log)))
    assert run.joint_names == ("a",)
    assert run.joints[0].effort.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert run.quality.joints["a"].effort == "measured, of /joint_states"


@pytest.mark.parametrize(
    ("kind", "name", "encode"), [(FLOAT64, "command", float64), (FLOATS, "commands", floats)]
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
    carried = [0, S + S // 2 + 500, 4 * S + S // 2, 5 * S + 500]
    assert run.joints[0].command_stamps_ns.tolist() == carried


def test_a_joint_is_mapped_to_a_topic_and_to_a_place_in_it(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/group/data": FLOATS, "/drive": FLOAT64}
    log = [*states(2), ("/group/data", S + 9, floats(1.0, 2.0)), ("/drive", S + 9, float64(3.0))]
    path = write(tmp_path / "bag", types, in_order(log))
    topics = parse_command_topics(["a=/group/data[1]", "b=drive"])
    run = read(path, command_topics=topics)
    assert [joint.effort.tolist() for joint in run.joints] == [[2.0], [3.0]]
    refused(path, r"/group/data is .*MultiArray, but must be s", commands="/group/data")
    for bad in (["a"], ["a=/x", "a=/y"]):
        with pytest.raises(SettingError):
            parse_command_topics(bad)


@pytest.mark.parametrize(
    "bad", [{"start": -1.0}, {"start": 2.0, "end": 1.0}, {"clock": "wall"}, {"joints": []}]
)
def test_a_selection_that_is_none_is_refused(bad):
    with pytest.raises(SettingError):
        BagSelection(**bad)


def test_a_joint_that_is_there_for_a_while_says_so(tmp_path):
    log = []
    for k in range(100):
        joints = {"a": 0.0, "late": 1.0} if 40 <= k < 60 else {"a": 0.0}
        log += [state(k * MS, **joints), command(k * MS, **joints)]
    path = write_bag(tmp_path / "bag", log)
    late = read(path).quality.joints["late"].states
    assert (late.count, late.begin, late.end, late.lost) == (20, 0.04, 0.059, 0)
    run = read(path, start=0.07)
    assert run.joint_names == ("a",)
    assert "'late' is left out: it has no state in the window" in run.quality.notes[0]


@given(st.sets(st.integers(1, 298), min_size=1, max_size=30))
def test_every_message_that_was_removed_is_counted_as_lost(removed):
    kept = [k for k in range(300) if k not in removed]
    log = [("/joint_states", k * MS, state(k * MS, a=0.0)[2]) for k in kept]
    log += [("/joint_commands", k * MS + 1, command(k * MS, a=1.0)[2]) for k in range(300)]
    with tempfile.TemporaryDirectory() as folder:
        run = read(write(Path(folder) / "bag", TWO, in_order(log)))
    quality, gaps = run.quality.joints["a"], np.diff(kept)
    assert quality.states.lost == len(removed)
    assert quality.states.gaps == int(np.count_nonzero(gaps > 1))
    assert quality.states.longest_gap == pytest.approx(float(gaps.max()) * 1e-3)
    longest = kept[int(np.argmax(gaps))]
    assert quality.states.longest_gap_at == pytest.approx((longest - kept[0]) * 1e-3)
    assert quality.commands.lost == 0


def test_repeats_disorder_and_numbers_that_are_none_are_counted(tmp_path):
    positions = [(1, 0.5), (3, 0.5), (2, 0.5), (3, 0.5), (4, NAN), (5, math.inf), (6, 0.5)]
    positions += [(7, -1e50)]
    log = [("/joint_states", k, state(t, a=x)[2]) for k, (t, x) in enumerate(positions)]
    log += [("/joint_commands", 9, command(t, a=x)[2]) for t, x in ((1, 1.0), (2, NAN))]
    run = read(write(tmp_path / "bag", TWO, log))
    assert run.joints[0].state_stamps_ns.tolist() == [1, 2, 3, 6]
    found = run.quality.joints["a"].states
    assert (found.count, found.repeated, found.out_of_order, found.not_finite) == (4, 1, 1, 3)
    assert run.quality.joints["a"].commands.not_finite == 1


def test_messages_that_were_logged_out_of_order_are_put_in_order(tmp_path):
    first = ("/joint_states", 1, state(1, a=0.0)[2])
    log = [first] + [("/joint_commands", t, command(1, a=float(t))[2]) for t in (5, 9, 7)]
    run = read(write(tmp_path / "bag", TWO, log))
    assert run.joints[0].effort.tolist() == [9.0]
    framed = JointStateTemplate(["a"], "a frame of its own", effort=True)
    log = [first]
    for t in range(10):
        raw = framed.encode(1, effort=[t]) if t % 3 else command(1, a=float(t))[2]
        log += [("/joint_commands", t, raw)]
    run = read(write(tmp_path / "turns", TWO, log))
    assert run.joints[0].effort.tolist() == [9.0]
    assert run.losses["a"].repeated_commands == 9


def test_states_without_stamps_need_the_receive_time(tmp_path):
    log = [("joint_states", k * MS, state(0, a=1.0 * k)[2]) for k in (1, 2, 3)]
    log += [("joint_commands", 4 * MS, command(0, a=1.0)[2])]
    path = write_bag(tmp_path / "bag", log)
    refused(path, "carry no stamps; read them with clock 'receive'")
    run = read(path, clock="receive")
    assert run.joints[0].position.tolist() == [1.0, 2.0, 3.0]
    assert run.joints[0].command_stamps_ns.tolist() == [4 * MS]


def test_messages_that_are_not_of_their_type_are_left_out_and_reported(tmp_path):
    log = [*states(), ("/joint_states", 9 * S, b"\x00\x01\x00\x00junk"), *commands()]
    run = read(write(tmp_path / "bag", TWO, in_order(log)))
    assert len(run.joints[0].position) == 5
    (line,) = run.quality.unreadable
    assert line.startswith("1 messages on /joint_states are left out: a JointState of 8 bytes")


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
    numbers = run_indices(run)
    energy = find_quantities(["energy"])[0]
    assert all(math.isnan(numbers.value(energy, joint)) for joint in (None, "a", "b"))
    assert numbers.joints["a"]["ivc"] == 99.0
    assert run_indices(read(bag, clock="receive")).value(energy) > 0.0
    assert main(["metrics", str(bag), "--reference", "hold"]) == 0
    assert capsys.readouterr().err.count("clocks that do not overlap") == 1


def test_one_joint_without_energy_leaves_no_sum():
    def series(start_ns):
        return start_ns + MS * np.arange(10), np.arange(10.0), np.arange(10.0)

    shared = JointSeries("a", *series(0), *series(0)[:2])
    foreign = JointSeries("b", *series(0), *series(S)[:2])
    energy = find_quantities(["energy"])[0]
    numbers = run_indices(RunSeries("run", (shared, foreign)))
    assert numbers.value(energy, "a") > 0.0
    assert math.isnan(numbers.value(energy))


# Velocities ------------------------------------------------------------------------------------


def test_velocities_are_those_of_the_states_where_they_are_asked_for(tmp_path):
    """Some states report none; one comes late, and one is repeated with another velocity."""
    full = JointStateTemplate(["a", "b"], position=True, velocity=True)
    bare = JointStateTemplate(["a", "b"], position=True)
    stamps = [0, 10, 30, 20, 40, 40, 50]
    log = []
    for k, stamp in enumerate(stamps):
        positions = [0.1 * k, 0.0]
        if stamp == 10:
            raw = bare.encode(stamp * MS, position=positions)
        else:
            raw = full.encode(stamp * MS, position=positions, velocity=[float(k), -1.0])
        log.append(("joint_states", (k + 1) * MS, raw))
        log.append(command(stamp * MS, a=1.0))
    bag = write_bag(tmp_path / "bag", log)
    (series,) = read_run(bag, "x", selection=BagSelection(velocities=True)).joints
    assert series.position.tolist() == [0.0, 0.1, 0.1 * 3, 0.1 * 2, 0.1 * 5, 0.1 * 6]
    assert repr(series.velocity.tolist()) == repr([0.0, math.nan, 3.0, 2.0, 5.0, 6.0])
    window = BagSelection(velocities=True, start=0.02, end=0.04)
    assert read_run(bag, "x", selection=window).joints[0].velocity.tolist() == [3.0, 2.0, 5.0]
    assert read_run(bag, "x").joints[0].velocity is None


def test_states_without_velocities_have_none_where_they_are_asked_for(tmp_path):
    log = [each for k in range(4) for each in (state(k * MS, a=0.1), command(k * MS, a=1.0))]
    bag = write_bag(tmp_path / "bag", log)
    (series,) = read_run(bag, "x", selection=BagSelection(velocities=True)).joints
    assert np.isnan(series.velocity).all()
    assert len(series.velocity) == 4
