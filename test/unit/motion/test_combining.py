"""Trajectories of different joints as one: each joint's reference stays what it was."""

import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.motion import JointTrajectory, TrajectoryPoint, combined, minimum_jerk, step
from hpid_ros.motion.references import reference_from

NUMBERS = st.floats(-10.0, 10.0)
AROUND = (-2, -1, 0, 1, 2)  # [ns], of a point


@st.composite
def trajectories(draw, joint, begin=0):
    """Return a trajectory of one joint, whose points give derivatives or not, as they like."""
    gaps = draw(st.lists(st.integers(1_000_000, 900_000_000), min_size=0, max_size=5))
    points, time_ns = [], begin
    for gap in [0, *gaps]:
        time_ns += gap
        order = draw(st.integers(0, 2))
        values = [(draw(NUMBERS),) for _ in range(order + 1)]
        points.append(TrajectoryPoint(time_ns, *values))
    return JointTrajectory((joint,), tuple(points))


def instants(parts):
    """Return whole nanoseconds: around each point, between them, and beyond."""
    points = {point.time_from_start_ns for part in parts for point in part.points}
    end = max(points)
    close = {point + shift for point in points for shift in AROUND}
    return sorted(time for time in {*close, *range(0, end, end // 40 + 1), 2 * end} if time >= 0)


def test_a_step_of_any_size_is_combined_with_smooth_motions():
    smooth = minimum_jerk([0.0, 1.0], {"a": [0.0, 1.0]})
    whole = combined([smooth, step([0.0, 0.5], {"b": [0.0, 2.5]})])
    assert max(abs(each.velocities[1]) for each in whole.points) == 0.0
    follower = whole.column("b").start(0, 0.0)
    found = [follower.sample(500_000_000 + shift)[0] for shift in (-1, 0, 1)]
    assert found == [0.0, 2.5, 2.5]


@examples(2)
@given(st.tuples(trajectories("a"), trajectories("b"), trajectories("c")))
def test_every_reference_is_what_it_was_at_every_nanosecond(parts):
    whole = combined(parts)
    for part in parts:
        (joint,) = part.joint_names
        alone = part.column(joint).start(0, 0.0)
        merged = whole.column(joint).start(0, 0.0)
        for time_ns in instants(parts):
            before, now = alone.sample(time_ns), merged.sample(time_ns)
            # A spline of a millisecond has large derivatives, and as large a rounding.
            scale = max(1.0, *(abs(value) for value in before))
            assert now.position == pytest.approx(before.position, abs=1e-9)
            assert now.velocity == pytest.approx(before.velocity, abs=1e-6 * scale)


def test_points_in_common_keep_their_numbers_to_the_last_bit():
    first = minimum_jerk([0.0, 1.0, 2.5], {"a": [0.1, 1.0, -1.0]})
    other = minimum_jerk([0.0, 1.0, 2.5], {"b": [0.3, 1.7, 2.0]})
    whole = combined([first, other])
    assert whole == minimum_jerk([0.0, 1.0, 2.5], {"a": [0.1, 1.0, -1.0], "b": [0.3, 1.7, 2.0]})


def test_steps_stay_steps_without_derivatives():
    parts = [step([0.0, 1.0], {"a": [0.0, 1.0]}), step([0.0, 0.5, 2.0], {"b": [1.0, 2.0, 3.0]})]
    whole = combined(parts)
    assert all(not point.velocities for point in whole.points)
    reference = whole.column("a").start(0, 0.0)
    assert [reference.sample(t).position for t in (0, 999_999_998, 1_000_000_000)] == [0, 0, 1]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([], "at least one part"),
        (["a", "a"], "'a' is in two"),
        (["a", "late"], "part 1 begins at 1 s and part 0 at 0 s"),
        (["a", "stamped"], "part 1 has 5 ns and part 0 0 ns"),
    ],
)
def test_what_cannot_be_merged_is_refused(parts, message):
    known = {
        "a": minimum_jerk([0.0, 1.0], {"a": [0.0, 1.0]}),
        "late": minimum_jerk([1.0, 2.0], {"late": [0.0, 1.0]}),
        "stamped": JointTrajectory(("b",), (TrajectoryPoint(0, (1.0,)),), 5),
    }
    with pytest.raises(TrajectoryError, match=message):
        combined([known[part] for part in parts])


PART = {"kind": "minimum_jerk", "times": [0.0, 1.0], "positions": {"a": [0.0, 1.0]}}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([], "reference.parts must be a list of references"),
        ({}, "reference.parts must be a list of references"),
        ([PART, PART], "reference: each joint must be in one part only"),
        ([PART, {"kind": "combined", "parts": [PART]}], "must not hold a combined reference"),
        ([PART, {"kind": "stepp"}], r"reference.parts\[1\].kind: unknown kind 'stepp'"),
    ],
)
def test_bad_parts_are_refused_with_their_place(parts, message):
    with pytest.raises(TrajectoryError, match=message):
        reference_from({"kind": "combined", "parts": parts})
