"""Courses stay within limits, use them up, and begin and end at rest."""

import math

import numpy as np
import pytest
from scipy.interpolate import BPoly

from hpid_ros.base.errors import SettingError
from hpid_ros.motion.excitation import Peaks, multisine, steps

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


@pytest.mark.parametrize("make", COURSES.values(), ids=COURSES)
@pytest.mark.parametrize(
    "limits", [LIMITS, Peaks(0.01, 1.5, 12.0), Peaks(3.0, 0.2, 12.0), Peaks(3.0, 9.0, 2.0)]
)
def test_a_course_uses_its_limits_up_and_nowhere_passes_them(make, limits):
    _, *motion = dense(make(limits))
    shares = [np.max(np.abs(each)) / limit for each, limit in zip(motion, limits, strict=True)]
    assert max(shares) <= 1.02  # of the quintics between the knots, too
    assert max(shares) >= 0.97


@pytest.mark.parametrize("make", COURSES.values(), ids=COURSES)
def test_a_course_begins_and_ends_at_rest_where_the_joint_stood(make):
    course = make(LIMITS)
    assert np.all(np.diff(course.times) > 0.0)
    for numbers in course[1:]:
        assert numbers[0] == pytest.approx(0.0, abs=1e-12)
        assert numbers[-1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("make", COURSES.values(), ids=COURSES)
def test_its_derivatives_are_those_of_its_position(make):
    times, position, velocity, acceleration = dense(make(LIMITS))
    assert np.gradient(position, times) == pytest.approx(velocity, abs=2e-2)
    assert np.gradient(velocity, times)[2:-2] == pytest.approx(acceleration[2:-2], abs=1.0)


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


@pytest.mark.parametrize(
    ("duration", "band", "line"),
    [
        (1.0, (0.2, 2.5), "from 0.2 Hz on must last 5 s at least, not 1"),
        (10.0, (2.5, 0.2), "the lower first, not 2.5 and 0.2"),
        (10.0, (0.0, 0.2), "two positive numbers"),
        (float("nan"), (0.2, 2.5), "not nan"),
    ],
)
def test_what_is_no_multisine_is_refused(duration, band, line):
    with pytest.raises(SettingError, match=line):
        multisine(duration, band, 1.5, LIMITS)


def test_steps_that_do_not_fit_are_refused():
    with pytest.raises(SettingError, match=r"must last .* s at least, not 2"):
        steps(2.0, LIMITS)
