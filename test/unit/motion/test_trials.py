"""Motions on which joints are tried: of the wished size, within limits, from rest to rest."""

import math

import numpy as np
import pytest
from harness.examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from hpid_ros.base.errors import SettingError
from hpid_ros.motion.excitation import (
    Design,
    JointBounds,
    Peaks,
    Wish,
    move_time,
    plan,
    sine,
    there_and_back,
)

LIMITS = st.builds(Peaks, st.floats(1e-3, 2.0), st.floats(0.05, 10.0), st.floats(0.1, 100.0))


def dense(course):
    spline = BPoly.from_derivatives(course.times, np.stack(course[1:], axis=1))
    times = np.linspace(0.0, course.times[-1], 4001)
    return times, [spline(times), spline.derivative()(times), spline.derivative(2)(times)]


def require_within(course, limits):
    assert np.all(np.diff(course.times) > 0.0)
    for numbers in course[1:]:
        assert numbers[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-9)
    for numbers, limit in zip(dense(course)[1], limits, strict=True):
        assert np.max(np.abs(numbers)) <= 1.02 * limit


@examples(0.5)
@given(LIMITS, st.floats(0.5, 60.0), st.booleans())
def test_there_and_back_is_within_limits_and_rests_at_both_ends(limits, duration, is_fast):
    assume(not is_fast or duration > 2.1 * (move_time(1.0, limits) + 0.2))
    course = there_and_back(duration, limits, is_fast=is_fast)
    require_within(course, limits)
    assert course.times[-1] == pytest.approx(duration)
    times, (position, velocity, _) = dense(course)
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


@examples(0.5)
@given(LIMITS, st.floats(0.5, 8.0), st.floats(0.1, 4.0), st.floats(0.05, 5.0))
def test_a_sine_has_whole_periods_of_its_frequency_and_begins_softly(
    limits, duration, frequency, fade
):
    course = sine(duration, frequency, fade, limits)
    require_within(course, limits)
    periods = course.times[-1] * frequency
    assert periods == pytest.approx(max(1, round(duration * frequency)))
    assert course.factor_within(limits) == pytest.approx(1.0)  # one of the limits is reached
    times, (position, _, _) = dense(course)
    early = times < 0.1 * min(fade, 0.4 * course.times[-1])
    assert np.max(np.abs(position[early])) < 0.02 * np.max(np.abs(position))


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: there_and_back(0.3, Peaks(1.0, 1.0, 1.0), is_fast=True), "at least, not 0.3"),
        (lambda: there_and_back(math.nan, Peaks(1.0, 1.0, 1.0), is_fast=False), "not nan"),
        (lambda: sine(5.0, 0.0, 1.0, Peaks(1.0, 1.0, 1.0)), "frequency of a sine must be"),
        (lambda: sine(math.inf, 1.0, 1.0, Peaks(1.0, 1.0, 1.0)), "duration of a sine must be"),
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
