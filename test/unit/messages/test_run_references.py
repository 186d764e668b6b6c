"""What a joint follows, as a bag has it: trajectories, setpoints, samples, controller states."""

from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MS,
    TYPES,
    S,
    bits,
    command,
    ramp,
    read_one,
    state,
    trajectory,
    write_bag,
)
from harness.foreign_bags import FLOAT64, commands, float64, in_order, read, states, write
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hpid_ros.base.errors import BagError
from hpid_ros.control import Gains, JointLoop
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.columns import JointSamples
from hpid_ros.messages.reading.references import (
    ReferenceEvent,
    sample_events,
    sample_setpoints,
    setpoint_events,
)
from hpid_ros.messages.reading.topic_choice import choose_topics
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import Losses
from hpid_ros.motion import Column, JointTrajectory, Knot, TrajectoryPoint

CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
HEAD = "std_msgs/Header header\nstring[] joint_names\n"
POINT, MULTI = "JointTrajectoryPoint", "MultiDOFJointTrajectoryPoint"
FORMS = {
    "foxy": ("desired", "actual", "error"),
    "galactic": ("desired", "actual", "error"),
    "humble": ("reference", "feedback", "error", "output", "desired", "actual"),
    "humble, old topic": ("reference", "feedback", "error", "output", "desired", "actual"),
    "iron": ("reference", "feedback", "error", "output"),
    "jazzy": ("reference", "feedback", "error", "output"),
}


def state_types(form: str):
    """Return a typestore with one of the forms that the message had."""
    text = HEAD + "".join(f"trajectory_msgs/{POINT} {name}\n" for name in FORMS[form])
    if form != "foxy":
        text += "string[] multi_dof_joint_names\n"
        text += "".join(f"trajectory_msgs/{MULTI} multi_dof_{name}\n" for name in FORMS[form])
    if form == "jazzy":
        text += "float64 speed_scaling_factor\n"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, CONTROLLER_STATE))
    return store


def controller_state(store, form: str, stamp_ns: int, references, efforts) -> bytes:
    types = store.types
    duration = types["builtin_interfaces/msg/Duration"](0, 0)
    point, multi = (types[f"trajectory_msgs/msg/{name}"] for name in (POINT, MULTI))
    none = np.zeros(0)
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, S))
    points = [point(np.array(references, float), none, none, none, duration)]
    points += [point(np.ones(2), none, none, none, duration)] * 2
    points += [point(none, none, none, np.array(efforts, float), duration)]
    names = FORMS[form]
    if form.startswith("humble"):
        empty = point(none, none, none, none, duration)
        points += [empty, empty]
        if "old" in form:
            points = [empty] * 4 + [points[0], points[1]]
    fields = [types["std_msgs/msg/Header"](stamp, "x"), ["a", "b"], *points[: len(names)]]
    if form != "foxy":
        fields += [[], *[multi([], [], [], duration)] * len(names)]
    if form == "jazzy":
        fields.append(1.0)
    return bytes(store.serialize_cdr(types[CONTROLLER_STATE](*fields), CONTROLLER_STATE))


@pytest.mark.parametrize("form", list(FORMS))
def test_states_of_a_trajectory_controller_give_reference_and_effort(tmp_path, form):
    topic, store = "/jtc/controller_state", state_types(form)
    log = states() + [
        (topic, k * S + 5, controller_state(store, form, k * S, (k, -k), (7 * k, 0.5)))
        for k in (1, 2, 3, 5)
    ]
    types = {"/joint_states": JOINT_STATE, topic: CONTROLLER_STATE}
    run = read(write(tmp_path / "bag", types, in_order(log), store))
    a, b = run.joints
    assert a.reference.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert b.reference.tolist() == [-1.0, -2.0, -3.0, -4.0, -5.0]
    has_effort = "output" in FORMS[form] and "old" not in form
    assert a.effort.tolist() == ([7.0, 14.0, 21.0, 35.0] if has_effort else [])
    quality = run.quality.joints["a"]
    assert quality.reference == f"controller_state {topic}"
    assert quality.references == 4
    assert run.losses["a"] == Losses(0, 0)  # it answers no states, but reports now and then


def test_of_two_robots_topics_the_nearest_are_taken():
    names = {"setpoint": FLOAT64, "cmd_force": FLOAT64, "controller_state": CONTROLLER_STATE}
    own = {f"/a_controller/{name}": kind for name, kind in names.items()}
    types = {"/joint_states": JOINT_STATE} | own
    types |= {f"/Sim{topic}": kind for topic, kind in types.items()}
    types |= {f"/sim{topic}": kind for topic, kind in types.items()}
    choice = choose_topics("bag", types, BagSelection(states="/joint_states"))
    found = choice.references.setpoint["a"], choice.command_topics["a"].topic
    assert (*found, choice.references.controller_state[0]) == tuple(own)


@pytest.fixture(scope="module")
def with_references(tmp_path_factory) -> Path:
    types = {
        **dict.fromkeys(("/joint_states", "/joint_commands"), JOINT_STATE),
        "/joint_trajectory": JOINT_TRAJECTORY,
        "/a_controller/setpoint": FLOAT64,
        "/b_controller/setpoint": FLOAT64,
        "/a_controller/reference": JOINT_STATE,
        "/a_controller/terms": JOINT_STATE,
    }
    log = states() + commands()
    log += [("/joint_trajectory", 2 * S, trajectory(2 * S, ramp("a", t0=9.0))[2])]
    log += [("/a_controller/setpoint", 4 * S, float64(5.0))]
    log += [("/a_controller/reference", k * S, state(k * S, a=k / 2)[2]) for k in (2, 4)]
    return write(tmp_path_factory.mktemp("references") / "bag", types, in_order(log))


@pytest.mark.parametrize(
    ("source", "reference"),
    [
        ("auto", [1.0, 1.0, 1.5, 2.0, 2.0]),
        ("trajectory", [1.0, 9.0, 9.0, 9.0, 9.0]),
        ("setpoint", [1.0, 1.0, 1.0, 5.0, 5.0]),
        ("sampled", [1.0, 1.0, 1.5, 2.0, 2.0]),
        ("hold", [1.0] * 5),
        ("/joint_trajectory", [1.0, 9.0, 9.0, 9.0, 9.0]),
        ("a_controller/setpoint", [1.0, 1.0, 1.0, 5.0, 5.0]),
        ("a_controller/reference", [1.0, 1.0, 1.5, 2.0, 2.0]),
    ],
)
def test_references_come_from_where_they_are_asked_from(with_references, source, reference):
    run = read(with_references, reference=source)
    assert run.joints[0].reference.tolist() == reference
    assert run.joints[1].reference.tolist() == ([-1.0] * 5 if source == "hold" else [])
    quality = run.quality.joints
    assert quality["b"].reference == ("hold" if source == "hold" else "none")
    if source == "auto":
        assert quality["a"].reference == "sampled /a_controller/reference"
        assert [quality[joint].reference_from for joint in "ab"] == [1.0, None]


def test_a_kind_of_reference_that_is_not_there_is_refused(with_references):
    with pytest.raises(BagError, match="no controller_state as reference; topics: "):
        read(with_references, reference="controller_state")


def test_a_reference_that_is_given_is_followed_from_the_first_state_on(with_references):
    given = ramp("a", t0=1.0, t2=5.0)
    for clock in ("header", "receive"):
        run = read(with_references, reference=given, clock=clock)
        assert run.joints[0].reference.tolist() == [1.0, 3.0, 5.0, 5.0, 5.0]
        assert not run.joints[1].has_reference
        assert run.quality.joints["a"].reference == "given"
    late = read(with_references, reference=given, start=2.0)
    assert late.joints[0].reference.tolist() == [5.0] * 3


def test_a_window_cuts_states_and_commands_but_not_the_reference_before(with_references):
    run = read(with_references, start=2.0, end=3.0)
    a = run.joints[0]
    assert a.state_stamps_ns.tolist() == a.command_stamps_ns.tolist() == [3 * S, 4 * S]
    assert a.reference.tolist() == [1.5, 2.0]
    assert run.quality.joints["a"].states.begin == 2.0
    assert run.losses["a"] == Losses(0, 0)
    with pytest.raises(BagError, match=r"no joint has a state from 7.0 s to 9.0 s"):
        read(with_references, start=7.0, end=9.0)


def references(path: Path, *log: tuple[str, int, bytes], last: int = 7) -> list[float]:
    """Return the reference of a joint that stands still, at 1 s to the last."""
    log += (*(state(k * S, a=0.25) for k in range(1, last)), command(S, a=0.0))
    series, _ = read_one(path, sorted(log, key=lambda message: message[1]))
    return series.reference.tolist()


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        pytest.param(
            [(2 * S + 1, ramp("a", t0=1.0, t2=5.0))],
            [0.25, 0.25, 1.0, 3.0, 5.0, 5.0],
            id="without a stamp it starts with the state that follows it",
        ),
        pytest.param(
            [(4 * S + 1, ramp("a", stamp_ns=2 * S, t0=1.0, t2=5.0))],
            [0.25, 1.0, 3.0, 5.0, 5.0, 5.0],
            id="whose stamp has passed it holds from its stamp on",
        ),
        pytest.param(
            [(2 * S + 1, ramp("a", stamp_ns=5 * S, t0=2.25, t1=4.0))],
            [0.25, 0.25, 0.25, 0.25, 2.25, 4.0],
            id="that starts later leaves the hold until then",
        ),
        pytest.param(
            [
                (0, ramp("a", t0=0.0, t4=4.0)),
                (2 * S + 1, ramp("a", t1=10.0)),
                (4 * S + 1, ramp("b", t0=77.0)),
            ],
            [0.0, 1.0, 2.0, 10.0, 10.0, 10.0],
            id="a new one supersedes from where the reference is then",
        ),
        pytest.param(
            [(2 * S + 1, ramp("a", t0=9.0, t1=8.0)), (2 * S + 2, ramp("a", t1=1.0))],
            [0.25, 0.25, 0.25, 1.0, 1.0, 1.0],
            id="of two before the same state only the last counts",
        ),
        pytest.param(
            [(9 * S, ramp("a", t0=9.0))], [0.25] * 6, id="after the last state it never begins"
        ),
        pytest.param([], [], id="none"),
    ],
)
def test_a_trajectory_takes_over_as_in_the_joint_loop(tmp_path, told, expected):
    log = (trajectory(*each) for each in told)
    assert references(tmp_path / "bag", *log) == expected


def test_a_trajectory_of_a_run_that_began_again_starts_in_that_run(tmp_path):
    one = [state(k * S, a=0.0) for k in range(1, 7)]
    log = [trajectory(S - 1, ramp("a", stamp_ns=2 * S, t0=0.0, t2=2.0)), *one]
    for name, stamp_ns, raw in [
        trajectory(S - 1, ramp("a", stamp_ns=3 * S, t0=2.0, t1=5.0)),
        *one,
        command(7 * S, a=0.0),
    ]:
        log.append((name, stamp_ns + 10 * S, raw))  # recorded later, with the same stamps
    bag, selection = write_bag(tmp_path / "bag", log), BagSelection(separates_runs=True)
    (series,) = read_run(bag, "run", selection=selection).joints
    assert series.reference.tolist() == [
        0.0,
        0.0,
        1.0,
        2.0,
        2.0,
        2.0,
        2.0,
        2.0,
        2.0,
        5.0,
        5.0,
        5.0,
    ]


def test_commands_of_the_second_run_alone_stay_there(tmp_path):
    log = [state(k * S, a=0.1 * k) for k in range(1, 7)]
    for name, stamp_ns, raw in [*log, *(command(k * S, a=float(k)) for k in range(1, 7))]:
        log.append((name, stamp_ns + 10 * S, raw))
    bag, selection = write_bag(tmp_path / "bag", log), BagSelection(separates_runs=True)
    (series,) = read_run(bag, "run", selection=selection).joints
    assert series.effort.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert series.command_stamps_ns.tolist() == series.state_stamps_ns[6:].tolist()


def test_a_trajectory_that_controllers_refuse_changes_nothing(tmp_path):
    good = trajectory(0, ramp("a", t0=1.0))
    message = TYPES.deserialize_cdr(good[2], JOINT_TRAJECTORY)
    message.points.append(message.points[0])
    refused = bytes(TYPES.serialize_cdr(message, JOINT_TRAJECTORY))
    log = good, ("joint_trajectory", 2 * S, refused)
    assert references(tmp_path / "bag", *log, last=4) == [1.0, 1.0, 1.0]
    lines = read(tmp_path / "bag").quality.lines
    assert any("a trajectory is left out" in line for line in lines)


def test_the_reference_is_the_one_that_the_joint_loop_follows(tmp_path):
    def cubic(**at_seconds: float) -> JointTrajectory:
        points = ramp("a", **at_seconds).points
        moving = [point._replace(velocities=(0.3,)) for point in points]
        return JointTrajectory(("a",), tuple(moving))

    loop = JointLoop(LoopSettings(joint="a", gains=Gains(10.0, 1.0, 3.0)))
    told = {0: cubic(t0=0.05, t1=0.7), 1100: cubic(t1=-0.2, t2=0.3)}  # nothing is left to fade
    log, followed = [], []
    for k in range(2000):
        stamp_ns, position = 5 * S + k * MS, 0.05 + 1e-4 * k
        if k in told:
            loop.follow(told[k].column("a"))
            log.append(trajectory(stamp_ns, told[k]))
        log.append(state(stamp_ns, a=position))
        log.append(command(stamp_ns, a=loop.step(stamp_ns, position, 0.1)))
        followed.append(loop.following.position)
    series, losses = read_one(tmp_path / "bag", log)
    assert bits(series.reference) == bits(followed)
    assert not losses


numbers = st.floats(-1e6, 1e6)


@st.composite
def columns(draw):
    times = sorted(draw(st.sets(st.integers(0, 3 * S), min_size=1, max_size=5)))
    rates = draw(st.integers(0, 2))
    derivatives = [numbers] * rates + [st.none()] * (2 - rates)
    knots = tuple(Knot(time, draw(numbers), *map(draw, derivatives)) for time in times)
    return Column("a", knots, draw(st.sampled_from([0, S, 2 * S, 9 * S])))


@given(columns(), st.integers(1, 5 * S), st.lists(st.integers(1, 8 * S), max_size=30), numbers)
def test_arrays_of_references_are_those_of_the_spline_to_the_bit(column, first, later, hold):
    stamps = np.unique(np.array([first, *[first + each for each in later]], dtype=np.int64))
    logged = JointSamples(stamps, stamps, stamps, np.zeros(len(stamps)))
    sampled = sample_events([ReferenceEvent(0, 0, column)], logged, stamps, hold)
    begin = max(first, column.begin_ns)  # what begins later leaves the hold until then
    spline = column.start(begin, hold)
    expected = np.array(
        [spline.sample(each).position if each >= begin else hold for each in stamps.tolist()]
    )
    assert sampled.tobytes() == expected.tobytes()


@given(
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 200)), max_size=30, unique=True),
    st.lists(st.tuples(st.integers(0, 40), st.integers(0, 60)), min_size=1, max_size=30),
)
def test_setpoints_taken_at_once_are_those_taken_one_by_one(told, logged):
    logged.sort(key=lambda state: state[0])
    columns = [np.array(column, dtype=np.int64) for column in zip(*logged, strict=True)]
    places = 2 * np.arange(len(logged)) + 1
    states = JointSamples(columns[1], columns[0], places, np.zeros(len(logged)))
    stamps_ns = np.unique(states.stamps_ns)
    log_times, places = (np.array([each[k] for each in told], dtype=np.int64) for k in (0, 1))
    setpoints = JointSamples(0 * places, log_times, places, 1.0 + np.arange(len(told)))
    events = sorted(setpoint_events("a", setpoints), key=lambda event: event[:2])
    expected = sample_events(events, states, stamps_ns, 0.5)
    found = sample_setpoints(setpoints, states, stamps_ns, 0.5)
    if (np.diff(states.stamps_ns) >= 0).all():
        assert found is not None
    if found is not None:
        np.testing.assert_array_equal(found, expected)


def test_a_long_trajectory_is_sampled_exactly(tmp_path):
    points = 20_000
    positions = np.sin(1e-3 * np.arange(points))
    knots = (TrajectoryPoint(k * 10_000, (q,)) for k, q in enumerate(positions.tolist()))
    log = [(name, 0, raw) for name, _, raw in [trajectory(0, JointTrajectory(("a",), (*knots,)))]]
    for k in range(1, 190):
        log += [state(k * MS, a=0.0), command(k * MS, a=0.0)]
    (series,) = read(write_bag(tmp_path / "bag", log)).joints
    # The trajectory begins with the first state.
    np.testing.assert_allclose(series.reference, positions[100 * np.arange(189)], atol=1e-12)
