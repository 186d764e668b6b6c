"""What a message costs is in proportion to its bytes, whatever it claims to hold."""

import struct
import tracemalloc

import pytest
from harness.poison import head, states, trajectories, without_numbers
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, MessageError, TrajectoryError
from hpid_ros.base.resources import share_folder
from hpid_ros.messages.bounds import (
    GOALS_KEPT,
    LENGTH,
    LIVE,
    MOST_DIMENSIONS,
    MOST_NUMBERS,
    RECORDED,
    require_count,
    require_size,
)
from hpid_ros.messages.joint_state import (
    EffortReader,
    GroupReader,
    JointReader,
    Writer,
    decode_joint_state,
)
from hpid_ros.messages.joint_trajectory import decode_trajectory, named_joints
from hpid_ros.messages.reports import (
    decode_activity,
    decode_numbers,
    decode_parameter_event,
    decode_text,
)
from hpid_ros.nodes.parts.goals import GoalRequest

FACTOR, REST = 60, 300_000  # bytes for each byte of a message, and for what every call takes

READERS = {
    "trajectory": decode_trajectory,
    "recorded trajectory": lambda raw: decode_trajectory(raw, RECORDED).require(),
    "names": named_joints,
    "goal": lambda raw: GoalRequest.of(raw, (), (), 0.0),
    "state": decode_joint_state,
    "joint's state": lambda raw: JointReader("elbow").read(raw),
    "group's state": lambda raw: GroupReader(["elbow", "wrist"]).read(raw),
    "command": lambda raw: EffortReader().read(raw),
    "numbers": decode_numbers,
    "activity": decode_activity,
    "parameters": decode_parameter_event,
    "text": decode_text,
}


def peak_of(read, raw):
    """Return the most memory that a reader takes, and what it raises."""
    tracemalloc.start()
    try:
        read(raw)
    except HpidError as error:
        return tracemalloc.get_traced_memory()[1], error
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak, None


@pytest.mark.parametrize("kind", READERS)
@given(points=st.integers(0, 3000), names=st.integers(0, 3000), claimed=st.data())
def test_memory_is_in_proportion_to_the_bytes(kind, points, names, claimed):
    raw = bytearray(without_numbers(points, names))
    for at in claimed.draw(st.sets(st.integers(1, len(raw) // 4 - 1), max_size=3)):
        count = claimed.draw(st.integers(0, 2**32 - 1) | st.integers(0, 3000))
        raw[4 * at : 4 * at + 4] = count.to_bytes(4, "little")
    peak, _ = peak_of(READERS[kind], bytes(raw))
    assert peak < FACTOR * len(raw) + REST


@pytest.mark.parametrize("kind", [*trajectories("elbow"), *states("elbow")])
def test_what_once_ended_a_node_is_refused_in_a_line(kind):
    raw = (trajectories("elbow") | states("elbow"))[kind]
    for read in READERS.values():
        peak, error = peak_of(read, raw)
        assert peak < FACTOR * len(raw) + REST
        assert len(str(error)) < 1200


@pytest.mark.parametrize("points", [100, 1000, 10_000])
def test_points_times_joints_that_have_no_positions_are_refused(points):
    raw = without_numbers(points, points)
    peak, error = peak_of(decode_trajectory, raw)
    assert isinstance(error, TrajectoryError)
    assert f"point 0 must have {points} positions, not 0" in str(error)
    assert peak < FACTOR * len(raw) + REST


def test_arrays_that_no_point_has_cost_nothing():
    writer, points, names = Writer(), 300, [f"joint_{k}" for k in range(200)]
    writer = Writer()
    writer.time(0)
    writer.string("")
    writer.scalar("I", len(names))
    for name in names:
        writer.string(name)
    writer.scalar("I", points)
    for k in range(points):
        writer.scalar("I", len(names))
        writer.doubles([0.1] * len(names))
        for _ in range(3):
            writer.scalar("I", 0)
        writer.time(k + 1)
    decoded = decode_trajectory(writer.raw)
    decoded.require()
    assert [each.base is None or each.base.size > 1 for each in decoded.arrays] == [
        True,
        *[False] * 3,
    ]
    knot = decoded.column("joint_7").knots[5]
    assert knot == (6, 0.1, None, None, None)


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("at", range(4, 40, 4))
def test_a_count_that_the_message_cannot_hold_is_refused(kind, at):
    raw = bytearray(without_numbers(3, 3))
    raw[at : at + 4] = b"\xff" * 4
    _, error = peak_of(READERS[kind], bytes(raw))
    assert error is None or "\n" not in str(error)


@pytest.mark.parametrize("count", [1000, 2**20, 2**32 - 1])
def test_a_recording_holds_what_its_bytes_have_room_for(count):
    """Where no bound but the bytes holds: eight points, or names, that say they are more."""
    claimed = struct.pack("<I", count)
    points, names = without_numbers(8, 0), without_numbers(0, 8)
    for raw, what in (
        (points[: -8 * 24 - 4] + claimed + points[-8 * 24 :], "points"),
        (names[: -9 * 4 - 4] + claimed + names[-9 * 4 :], "names"),
    ):
        peak, error = peak_of(lambda each: decode_trajectory(each, RECORDED), raw)
        assert f"cannot hold {count} {what}" in str(error)
        assert peak < REST


def test_what_a_node_takes_is_bounded_and_a_recording_is_not():
    names = [f"j{k}" for k in range(LIVE.names + 1)]
    state = head(names) + bytes(12)
    with pytest.raises(MessageError, match=f"may have {LIVE.names} names, not {len(names)}"):
        decode_joint_state(state)
    large = head([]) + bytes(LIVE.size)
    for read in (decode_joint_state, decode_trajectory, decode_activity):
        with pytest.raises(MessageError, match=f"may have {LIVE.size} bytes, not {len(large)}"):
            read(large)
    points = without_numbers(LIVE.points + 1, 0)
    with pytest.raises(MessageError, match=f"may have {LIVE.points} points, not"):
        decode_trajectory(points)
    assert len(decode_trajectory(points, RECORDED).times_ns) == LIVE.points + 1


def test_as_many_as_allowed_are_taken():
    raw = head([f"j{k}" for k in range(LIVE.names)])
    raw += bytes(-len(raw) % 4 + 12)
    assert len(decode_joint_state(raw).names) == LIVE.names
    assert len(decode_trajectory(without_numbers(LIVE.points, 0)).times_ns) == LIVE.points
    require_size("JointState", LIVE.size)
    require_count("JointState", "names", 3, LENGTH, 12)
    for count, left, shown in ((4, 12, 12), (1, 0, 0), (1, -3, 0)):
        with pytest.raises(MessageError, match=f"hold {count} names in its last {shown} bytes"):
            require_count("JointState", "names", count, LENGTH, left)


def test_the_bounds_are_those_of_the_documentation():
    text = (share_folder() / "docs" / "security.md").read_text()
    for shown in (
        f"{LIVE.size >> 20} MiB, {_spaced(LIVE.names)} names",
        f"{_spaced(LIVE.points)} points, {_spaced(LIVE.mixed_points)} if",
        f"1000, {GOALS_KEPT >> 20} MiB in",
        f"{MOST_NUMBERS} numbers, {MOST_DIMENSIONS} dimensions of",
    ):
        assert shown in text


def _spaced(number):
    return f"{number:,}".replace(",", " ")


def test_a_long_name_is_cut_in_a_line():
    name = "x" * 100_000
    fields = decode_joint_state(head([name, name]) + bytes(16))
    with pytest.raises(MessageError) as refusal:
        fields.place_of(name)
    assert len(str(refusal.value)) < 300
    with pytest.raises(MessageError) as refusal:
        decode_text(b"\0\1\0\0" + struct.pack("<I", 9000) + b"\xff" * 9000)
    assert len(str(refusal.value)) < 700


def test_an_activity_says_who_is_active():
    writer = Writer()
    writer.time(5)
    writer.string("")
    for names in (["arm", "hand"], ["motor"]):
        writer.scalar("I", len(names))
        for number, name in enumerate(names):
            writer.string(name)
            writer.scalar("B", 3 - number)
            writer.string("active" if number == 0 else "inactive")
    assert decode_activity(writer.raw) == {"arm": "active", "hand": "inactive"}
