"""Dead reckoning by arcs: exact for whatever the wheels did at constant rates."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.robot.differential_drive import (
    WHEEL_ERROR,
    DifferentialDrive,
    Odometry,
    chord_share,
    integrated,
)

DRIVE = DifferentialDrive("l", "r", 0.075, 0.5)
TURNS = st.floats(-20.0, 20.0)


def driven(*readings):
    """Return the odometry after readings of the two wheels, from 0 on."""
    odometry = Odometry(DRIVE, 0.0, 0.0)
    for left, right in readings:
        odometry.update(left, right)
    return odometry


@given(TURNS, TURNS, st.integers(2, 50))
def test_an_arc_in_pieces_is_the_arc(left, right, pieces):
    whole = driven((left, right)).pose
    parts = driven(*((left * k / pieces, right * k / pieces) for k in range(1, pieces + 1))).pose
    assert parts == pytest.approx(whole, abs=1e-12)


@given(TURNS, TURNS)
def test_an_arc_is_the_circle_about_its_centre(left, right):
    """The textbook's form, which needs a turn that is not small."""
    distance, turn = DRIVE.twist(left, right)
    if abs(turn) < 1e-3:
        return
    centre = distance / turn
    x, y, heading = driven((left, right)).pose
    assert heading == pytest.approx(turn, abs=1e-12)
    assert x == pytest.approx(centre * math.sin(turn), abs=1e-11)
    assert y == pytest.approx(centre * (1.0 - math.cos(turn)), abs=1e-11)


@given(st.floats(-18.0, -2.0))
def test_a_small_turn_loses_no_digits(exponent):
    """By the series, whose next term is below 1e-13."""
    turn = 10.0**exponent
    assert chord_share(turn) == pytest.approx(1.0 - turn**2 / 24.0 + turn**4 / 1920.0, rel=1e-15)
    half_turn = turn * DRIVE.separation / DRIVE.radius / 2.0
    _, y, heading = driven((10.0 - half_turn, 10.0 + half_turn)).pose
    assert heading == pytest.approx(turn, rel=1e-9 if turn < 1e-6 else 1e-12, abs=1e-14)
    assert y == pytest.approx(0.75 * heading / 2.0, rel=max(turn**2, 1e-12), abs=1e-18)


def test_no_turn_is_a_straight_line():
    assert driven((4.0, 4.0)).pose == (pytest.approx(0.3), 0.0, 0.0)
    assert chord_share(0.0) == 1.0


@given(st.lists(st.tuples(TURNS, TURNS), min_size=1, max_size=8))
def test_there_and_back_is_where_it_began(readings):
    back = [*readings[-2::-1], (0.0, 0.0)]
    odometry = driven(*readings, *back)
    assert odometry.pose == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert odometry.distance == pytest.approx(0.0, abs=1e-12)


def test_only_differences_count():
    odometry = Odometry(DRIVE, 100.0, -3.0)
    odometry.update(104.0, 1.0)
    assert odometry.pose == (pytest.approx(0.3), 0.0, 0.0)


def test_wheels_that_stand_change_nothing():
    odometry = driven((1.0, 2.0))
    before = odometry.pose, odometry.covariance, odometry.distance, odometry.turn
    odometry.update(1.0, 2.0)
    assert (odometry.pose, odometry.covariance, odometry.distance, odometry.turn) == before


@given(st.lists(st.tuples(TURNS, TURNS), min_size=1, max_size=30))
def test_a_recording_at_once_is_reading_by_reading(readings):
    left, right = np.array([(0.0, 0.0), *readings]).T
    odometry = Odometry(DRIVE, 0.0, 0.0)
    each = [odometry.pose, *(odometry.update(*reading) for reading in readings)]
    assert integrated(DRIVE, left, right) == pytest.approx(np.array(each), abs=1e-11)


def test_the_twist_is_the_mean_since_a_moment():
    odometry = driven((1.0, 1.0))
    distance, turn = odometry.distance, odometry.turn
    odometry.update(1.2, 1.4)
    odometry.update(1.4, 1.8)
    linear, angular = odometry.twist_between(distance, turn, 0.1)
    assert (linear, angular) == pytest.approx(DRIVE.twist(4.0, 8.0))


def test_the_covariance_is_that_of_noisy_wheels():
    """Against many drives whose wheels err as the model says."""
    steps, drives = 200, 4000
    generator = np.random.default_rng(3)
    travel = np.full((steps, 2), [5.0 / steps, 9.0 / steps])
    exact = driven(*np.cumsum(travel, axis=0).tolist())
    spread = np.sqrt(WHEEL_ERROR * np.abs(travel * DRIVE.radius)) / DRIVE.radius
    ends = np.empty((drives, 3))
    for k in range(drives):
        noisy = np.cumsum(travel + spread * generator.standard_normal((steps, 2)), axis=0)
        ends[k] = integrated(DRIVE, *np.vstack([np.zeros(2), noisy]).T)[-1]
    xx, xy, xh, yy, yh, hh = exact.covariance
    said = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    assert np.linalg.eigvalsh(said).min() > 0.0
    scale = np.sqrt(np.outer(np.diag(said), np.diag(said)))
    assert np.abs((np.cov(ends.T) - said) / scale).max() < 0.1


def midpoint(pose, travel):
    """Return the textbook's next pose, equation 5.7, of which 5.9 has the derivatives."""
    distance, turn = travel.mean(), (travel[1] - travel[0]) / DRIVE.separation
    middle = pose[2] + 0.5 * turn
    return pose + np.array([distance * np.cos(middle), distance * np.sin(middle), turn])


def slope(function, at):
    """Return the matrix of derivatives, by central differences."""
    steps = 1e-6 * np.eye(len(at))
    return np.column_stack([(function(at + h) - function(at - h)) / 2e-6 for h in steps])


@given(st.lists(st.tuples(TURNS, TURNS), min_size=1, max_size=4))
def test_the_covariance_is_carried_by_the_derivatives_of_the_pose(readings):
    odometry, covariance, before = Odometry(DRIVE, 0.0, 0.0), np.zeros((3, 3)), np.zeros(2)
    for reading in readings:
        pose, travel = np.array(odometry.pose), DRIVE.radius * (np.array(reading) - before)
        by_pose = slope(lambda at, travel=travel: midpoint(at, travel), pose)
        by_travel = slope(lambda at, pose=pose: midpoint(pose, at), travel)
        added = by_travel @ np.diag(WHEEL_ERROR * np.abs(travel)) @ by_travel.T
        covariance = by_pose @ covariance @ by_pose.T + added
        odometry.update(*reading)
        before = np.array(reading)
    places = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
    assert odometry.covariance == pytest.approx(covariance[places], rel=1e-6, abs=1e-12)


def test_the_covariance_grows_with_the_way_and_not_with_time():
    odometry = Odometry(DRIVE, 0.0, 0.0)
    before = odometry.covariance
    assert before == (0.0,) * 6
    for k in range(1, 10):
        odometry.update(float(k), float(k))
        now = odometry.covariance
        assert now.xx > before.xx
        assert now.hh > before.hh
        before = now
    # Straight ahead for s metres with two wheels: k s / 2 along, 2 k s / b^2 of heading.
    way = 9.0 * DRIVE.radius
    assert before.xx == pytest.approx(0.5 * WHEEL_ERROR * way)
    assert before.hh == pytest.approx(2.0 * WHEEL_ERROR * way / DRIVE.separation**2)
