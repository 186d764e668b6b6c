"""Excitations, trials and relays stay within a joint's limits; the watch sees what does not."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from harness.examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from hpid_bench.live.exciter import Watch, goal_of, group_settings
from hpid_ros.base.errors import SettingError
from hpid_ros.motion.excitation import (
    Design,
    ExcitationPlan,
    JointBounds,
    Peaks,
    RelayWish,
    Wish,
    inertia_from_gains,
    move_time,
    multisine,
    plan,
    plan_return,
    planned_relay,
    sine_excitation,
    steps,
    there_and_back,
)

LIMITS = Peaks(0.4, 1.5, 12.0)
COURSES = {
    "multisine": lambda limits: multisine(10.0, (0.2, 2.5), 1.5, limits),
    "steps": lambda limits: steps(180.0, limits),
}


def dense(course):
    """Return position, velocity and acceleration between the knots, too."""
    spline = BPoly.from_derivatives(course.times, np.stack(course[1:], axis=1))
    times = np.linspace(0.0, course.times[-1], 2_000 * math.ceil(course.times[-1] / 10.0) + 1)
    return times, spline(times), spline.derivative()(times), spline.derivative(2)(times)


def require_within(course, limits):
    """Return the shares of its limits that a course reaches, between the knots, too."""
    assert np.all(np.diff(course.times) > 0.0)
    for numbers in course[1:]:
        assert numbers[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-9)
    shares = [np.max(np.abs(a)) / b for a, b in zip(dense(course)[1:], limits, strict=True)]
    assert max(shares) <= 1.02
    return shares


@pytest.mark.parametrize("make", COURSES.values(), ids=COURSES)
@pytest.mark.parametrize(
    "limits", [LIMITS, Peaks(0.01, 1.5, 12.0), Peaks(3.0, 0.2, 12.0), Peaks(3.0, 9.0, 2.0)]
)
def test_a_course_uses_its_limits_up_and_nowhere_passes_them(make, limits):
    assert max(require_within(make(limits), limits)) >= 0.97


def test_a_multisine_moves_in_its_band_and_starts_softly():
    course = multisine(20.0, (0.5, 2.0), 2.0, LIMITS)
    times, _, velocity, _ = dense(course)
    power = np.abs(np.fft.rfft(velocity)) ** 2
    hertz = np.fft.rfftfreq(len(velocity), times[1])
    assert power[(hertz > 0.3) & (hertz < 2.3)].sum() > 0.98 * power.sum()
    assert np.max(np.abs(velocity[times < 0.4])) < 0.05 * np.max(np.abs(velocity))


def test_the_phases_that_are_taken_are_the_best_of_many():
    """Random phases alone give a crest factor of 3.6 in the median, here."""
    crests = [multisine(10.0, (0.2, 2.5), 1.5, LIMITS, seed).crest_factor for seed in range(3)]
    assert max(crests) < 3.2
    first, second = (multisine(10.0, (0.2, 2.5), 1.5, LIMITS, seed) for seed in (1, 2))
    assert not np.array_equal(first.position, second.position)


MS = 1_000_000
ELBOW = JointBounds("elbow", "/elbow_controller", 0.5, 2.0, -1.0, 1.0, 2.0, (-10.0, 8.0), 0.1)
WRIST = replace(ELBOW, joint="wrist", position=-0.2, load=0.0, inertia=0.01)
SHORT = Design(duration=5.0, band=(0.5, 2.5), fade=1.0)


def test_a_plan_takes_shares_of_what_is_left():
    (found,) = plan([ELBOW], Wish(share=0.5, amplitude=9.0), SHORT).joints
    assert found.peaks.position <= 0.25 + 1e-9  # half of the way to the nearer stop
    assert found.peaks.velocity <= 1.0 + 1e-9
    assert found.effort <= 3.0 + 1e-9  # half of what is left beside the load of 2 N m
    shares = found.peaks.position / 0.25, found.peaks.velocity, found.effort / 3.0
    assert max(shares) == pytest.approx(1.0)
    assert found.velocity_stop <= ELBOW.velocity


@pytest.mark.parametrize("are_together", [False, True])
def test_joints_move_one_by_one_or_together(are_together):
    made = plan([ELBOW, WRIST], Wish(), SHORT._replace(are_together=are_together))
    moving = np.abs(made.velocities) > 1e-9
    assert np.any(moving[:, 0] & moving[:, 1]) == are_together
    assert np.any(moving, axis=0).all()
    assert not made.positions[[0, -1]].any()
    assert not moving[made.times < 0.5].any()


def test_a_plan_comes_back_from_json():
    made = plan([ELBOW, replace(WRIST, upper=math.inf)], Wish(), SHORT)
    again = ExcitationPlan.from_mapping(json.loads(json.dumps(made.as_mapping())))
    assert again.joints == made.joints
    for name in ("times", "positions", "velocities", "accelerations"):
        assert np.array_equal(getattr(again, name), getattr(made, name))
    with pytest.raises(SettingError, match="no plan"):
        ExcitationPlan.from_mapping({"joints": [{}]})


@pytest.mark.parametrize(
    ("change", "wish", "line"),
    [
        ({"position": 1.2}, Wish(), "elbow is at 1.2 rad, beyond its limits of -1 and 1 rad"),
        ({"load": 8.5}, Wish(), "elbow is held by 8.5, its effort limits are -10 and 8"),
        ({}, Wish(share=1.5), "a share of the limits must be in"),
        ({}, Wish(amplitude=0.0), "the largest amplitude must be positive"),
        ({}, Wish(velocity=math.nan), "the largest velocity must be positive, not nan"),
    ],
)
def test_what_cannot_be_moved_is_refused(change, wish, line):
    with pytest.raises(SettingError, match=line):
        plan([replace(ELBOW, **change)], wish, SHORT)


def test_what_is_not_known_is_assumed_and_said():
    free = {"velocity": math.inf, "efforts": (-math.inf, math.inf)}
    (found,) = plan([replace(ELBOW, **free)], Wish(), SHORT).joints
    assert len(found.notes) == 2
    assert found.peaks.velocity <= 1.0 + 1e-9
    (found,) = plan([replace(ELBOW, is_inertia_guessed=True)], Wish(), SHORT).joints
    assert found.notes == ("its inertia is taken from its gains, 0.1 kg m^2",)


def test_the_inertia_of_gains_has_a_damping_ratio_of_one():
    inertia, p, d = inertia_from_gains(40.0, 4.0), 40.0, 4.0
    assert d / (2.0 * math.sqrt(p * inertia)) == pytest.approx(1.0)
    with pytest.raises(SettingError):
        inertia_from_gains(0.0, 4.0)


def test_a_plan_too_long_for_one_trajectory_is_refused():
    joints = [replace(ELBOW, joint=f"joint_{number}") for number in range(7)]
    with pytest.raises(SettingError, match="knots, 45000 are allowed"):
        plan(joints, Wish(), Design(duration=300.0, band=(0.1, 10.0)))


def test_the_watch_sees_positions_speeds_and_efforts_beyond_limits():
    made = plan([ELBOW, WRIST], Wish(), SHORT)
    rest = [(0.5, 0.0), (-0.2, 0.0)]
    watch = Watch(made)
    assert watch.see(0, rest, [2.0, None]) == ""
    assert "elbow is at 1.1 rad" in watch.see(1 * MS, [(1.1, 0.0), rest[1]], [2.0, 0.0])
    fast = made.joints[1].velocity_stop + 0.01
    assert "wrist moves at" in watch.see(2 * MS, [rest[0], (-0.2, -fast)], [2.0, 0.0])


def test_a_moment_at_the_effort_limit_is_no_reason_to_stop():
    watch = Watch(plan([ELBOW], Wish(), SHORT))
    seen = [watch.see(k * MS, [(0.5, 0.0)], [7.9]) for k in (0, 20, 40)]
    assert seen == ["", "", ""]
    assert watch.see(41 * MS, [(0.5, 0.0)], [1.0]) == ""
    assert watch.see(42 * MS, [(0.5, 0.0)], [-9.9]) == ""
    assert "elbow needs -9.9 N m, its limits are -10 and 8" in watch.see(
        100 * MS, [(0.5, 0.0)], [-9.9]
    )


def test_a_goal_begins_where_references_stand():
    made = plan([ELBOW, WRIST], Wish(), SHORT)
    goal = goal_of(made, [0.51, -0.19])
    assert goal.arrays.positions[0] == pytest.approx([0.51, -0.19])
    settings = group_settings(made, 0.5, 0.5, is_simulated=False)
    assert settings.joints == ("elbow", "wrist")
    for least, each in zip(settings.decelerations, made.joints, strict=True):
        assert least >= each.peaks.acceleration
    assert settings.tolerances.path["elbow"].position == made.joints[0].tolerance


@pytest.mark.parametrize("duration", [4.0, 30.0])
def test_a_slow_motion_stops_as_soon_as_a_fast_one(duration):
    """The button's release is a stop, however long the motion was to last."""
    wish = Wish(amplitude=1.0)
    made = plan([ELBOW], wish, SHORT._replace(duration=duration))
    (joint,) = made.joints
    (deceleration,) = group_settings(made, 0.5, 0.5, is_simulated=False).decelerations
    spare = min(ELBOW.efforts[1] - ELBOW.load, ELBOW.load - ELBOW.efforts[0])
    assert joint.peaks.velocity / deceleration <= 0.5 + 1e-9
    assert deceleration <= max(0.5 * spare / ELBOW.inertia, joint.peaks.acceleration)


FAST = replace(ELBOW, velocity=9.0)


def test_a_relay_takes_shares_of_what_is_left():
    planned = planned_relay(FAST, 0.1, 0.002, RelayWish(share=0.25))
    assert planned.request.amplitude == pytest.approx(0.25 * 6.0)
    assert planned.amplitude == pytest.approx(0.05)
    assert planned.request.deviation == pytest.approx(0.2)
    rate = 2.0 * math.pi / planned.period
    assert 4.0 * 1.5 / (math.pi * 0.1 * rate**2) == pytest.approx(planned.amplitude)
    # The harmonic balance: the lead's phase is what the hysteresis takes.
    leading = planned.amplitude * math.hypot(1.0, 0.1 * rate)
    assert math.asin(planned.request.hysteresis / leading) == pytest.approx(math.atan(0.1 * rate))


def test_a_slow_joint_moves_less_and_one_near_its_stop_too():
    slow = planned_relay(replace(FAST, velocity=1.0), 0.1, 0.002, RelayWish())
    assert slow.velocity == pytest.approx(0.3)
    assert slow.amplitude < 0.05
    near = planned_relay(replace(FAST, position=0.95), 0.1, 0.002, RelayWish())
    assert near.request.deviation == pytest.approx(0.8 * 0.05)
    assert near.amplitude == pytest.approx(0.2 * 0.05)


@pytest.mark.parametrize(
    ("changes", "wish", "line"),
    [
        ({"efforts": (-math.inf, math.inf)}, RelayWish(), "give --effort"),
        ({}, RelayWish(effort=7.0), "a relay of 7 does not fit between elbow's load of 2"),
        ({"position": 1.0}, RelayWish(), "elbow is at a limit"),
        ({"inertia": 1e-5}, RelayWish(), "fewer than 16 samples"),
        ({}, RelayWish(share=1.0), "the share of the effort"),
        ({}, RelayWish(effort=math.nan), "the effort must be positive"),
        ({}, RelayWish(amplitude=0.0), "the amplitude must be positive"),
        ({}, RelayWish(cycles=1), "5 to 50 cycles, not 1"),
    ],
)
def test_a_relay_without_room_is_refused(changes, wish, line):
    with pytest.raises(SettingError, match=line):
        planned_relay(replace(FAST, **changes), 0.1, 0.002, wish)


SIZES = st.builds(Peaks, st.floats(1e-3, 2.0), st.floats(0.05, 10.0), st.floats(0.1, 100.0))


@examples(0.25)
@given(SIZES, st.floats(0.5, 60.0), st.booleans())
def test_there_and_back_is_within_limits_and_rests_at_both_ends(limits, duration, is_fast):
    assume(not is_fast or duration > 2.1 * (move_time(1.0, limits) + 0.2))
    course = there_and_back(duration, limits, is_fast=is_fast)
    require_within(course, limits)
    assert course.times[-1] == pytest.approx(duration)
    times, position, velocity, _ = dense(course)
    assert np.min(position) >= -1e-9
    for end in (0.5 * duration, duration):  # it rests before the way back, and at the end
        at_rest = (times > end - 0.19) & (times <= end)
        assert velocity[at_rest] == pytest.approx(0.0, abs=1e-9)
    if is_fast:
        assert np.max(position) == pytest.approx(limits.position)
        assert there_and_back(2.0 * duration, limits, is_fast=True).peaks == pytest.approx(
            course.peaks
        )
    else:
        assert course.factor_within(limits) == pytest.approx(1.0, abs=0.03)  # at the knots


@examples(0.25)
@given(SIZES, st.floats(0.5, 8.0), st.floats(0.1, 4.0), st.floats(0.05, 5.0))
def test_a_sine_has_whole_periods_of_its_frequency_and_begins_softly(
    limits, duration, frequency, fade
):
    course = sine_excitation(duration, frequency, fade, limits)
    require_within(course, limits)
    periods = course.times[-1] * frequency
    assert periods == pytest.approx(max(1, round(duration * frequency)))
    assert course.factor_within(limits) == pytest.approx(1.0)  # one of the limits is reached
    times, position, _, _ = dense(course)
    early = times < 0.1 * min(fade, 0.4 * course.times[-1])
    assert np.max(np.abs(position[early])) < 0.02 * np.max(np.abs(position))


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (
            lambda: multisine(1.0, (0.2, 2.5), 1.5, LIMITS),
            "must last 5 s at least, not 1",
        ),
        (lambda: multisine(10.0, (2.5, 0.2), 1.5, LIMITS), "the lower first, not 2.5 and 0.2"),
        (lambda: multisine(10.0, (0.0, 0.2), 1.5, LIMITS), "two positive numbers"),
        (lambda: multisine(math.nan, (0.2, 2.5), 1.5, LIMITS), "not nan"),
        (lambda: steps(2.0, LIMITS), r"must last .* s at least, not 2"),
        (lambda: there_and_back(0.3, Peaks(1.0, 1.0, 1.0), is_fast=True), "at least, not 0.3"),
        (lambda: there_and_back(math.nan, Peaks(1.0, 1.0, 1.0), is_fast=False), "not nan"),
        (
            lambda: sine_excitation(5.0, 0.0, 1.0, Peaks(1.0, 1.0, 1.0)),
            "frequency of a sine must be",
        ),
        (
            lambda: sine_excitation(math.inf, 1.0, 1.0, Peaks(1.0, 1.0, 1.0)),
            "duration of a sine must be",
        ),
    ],
)
def test_what_is_no_motion_is_refused(make, line):
    with pytest.raises(SettingError, match=line):
        make()


@pytest.mark.parametrize("kind", ["step", "minimum_jerk", "sine"])
def test_a_plan_is_of_the_wished_size_and_no_larger_than_its_share_of_the_room(kind):
    bounds = JointBounds("a", "/a_controller", 0.1, 0.0, -1.0, 1.0, 4.0, (-10.0, 10.0), 0.1)
    for wished, reached in ((0.2, 0.2), (5.0, 0.45)):
        planned = plan([bounds], Wish(amplitude=wished), Design(kind=kind, duration=8.0))
        assert np.max(np.abs(planned.positions)) == pytest.approx(reached, rel=1e-3)
        assert np.max(np.abs(planned.velocities)) <= 2.0 + 1e-9
        assert planned.positions[-1] == pytest.approx(0.0)


def test_the_way_back_of_several_joints_is_one_straight_line_within_their_limits():
    wish = Wish(share=0.5, amplitude=0.1)  # which is of the motion that was interrupted
    planned = plan_return([ELBOW, WRIST], [-0.3, 0.0], wish)
    assert planned.positions[0] == pytest.approx([0.0, 0.0])
    assert planned.positions[-1] == pytest.approx([-0.3, 0.0])
    assert np.all(planned.positions[:, 1] == 0.0)
    assert np.max(np.abs(planned.velocities)) <= 1.0 + 1e-9
    assert np.max(np.abs(planned.accelerations)) <= 0.5 * 6.0 / 0.1 + 1e-9
    together = plan_return([ELBOW, WRIST], [-0.3, 0.1], wish)
    assert together.positions[:, 1] == pytest.approx(-together.positions[:, 0] / 3.0, abs=1e-9)
    there = goal_of(planned, [0.8, 0.2], ends=[0.5, 0.2])
    assert there.arrays.positions[-1] == pytest.approx([0.5, 0.2])


@pytest.mark.parametrize("kind", ["minimum_jerk", "step", "sine"])
def test_a_motion_is_told_from_what_is_before_and_after_it(kind):
    design = Design(kind=kind, duration=4.0, are_together=True)
    planned = plan([ELBOW, WRIST], Wish(amplitude=0.1), design)
    assert planned.end - planned.begin == pytest.approx(4.0, rel=0.02)
    before = planned.times <= planned.begin
    assert np.all(planned.positions[before] == 0.0)
    after = planned.times >= planned.rests_at
    assert planned.positions[after] == pytest.approx(0.0, abs=1e-9)
    assert np.max(np.abs(planned.positions[~after][-1])) > 0.0
    assert planned.begin < planned.rests_at <= planned.end
