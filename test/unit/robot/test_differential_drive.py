"""Two wheels and the twist of their base; what a URDF says of them; dead reckoning by arcs."""

import math
import re

import numpy as np
import pytest
from harness.places import URDF
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import (
    WHEEL_ERROR,
    DifferentialDrive,
    Odometry,
    chord_share,
    integrated,
)

WHEELS = ("wheel_left_joint", "wheel_right_joint")
RATES = st.floats(-100.0, 100.0)
LENGTHS = st.floats(0.01, 10.0)

# Wheels as TurtleBot 3 has them: cylinders along z, laid down by a quarter of a turn about x.
CART = """<robot name="cart">
  <link name="base"/><link name="body"/>
  <joint name="lift" type="fixed"><parent link="base"/><child link="body"/>
    <origin xyz="0 0 0.03"/></joint>
  <link name="l"><collision><geometry><cylinder radius="0.033" length="0.018"/></geometry>
  </collision></link>
  <link name="r"><collision><geometry><cylinder radius="0.033" length="0.018"/></geometry>
  </collision></link>
  <joint name="left" type="continuous"><parent link="body"/><child link="l"/>
    <origin xyz="0 0.08 0.003" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="right" type="continuous"><parent link="body"/><child link="r"/>
    <origin xyz="0 -0.08 0.003" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
</robot>"""


@given(LENGTHS, LENGTHS, RATES, RATES)
def test_each_wheel_rolls_as_its_end_of_the_axle_moves(radius, separation, left, right):
    linear, angular = DifferentialDrive("l", "r", radius, separation).twist(left, right)
    assert linear - 0.5 * separation * angular == pytest.approx(radius * left, abs=1e-9)
    assert linear + 0.5 * separation * angular == pytest.approx(radius * right, abs=1e-9)


def test_the_urdf_tells_radius_and_separation():
    drive = DifferentialDrive.of(RobotDescription.load(URDF), *WHEELS)
    assert drive == DifferentialDrive(*WHEELS, 0.075, 0.5)


def test_what_is_given_is_not_read():
    drive = DifferentialDrive.of(RobotDescription.load(URDF), *WHEELS, 0.08, 0.52)
    assert (drive.radius, drive.separation) == (0.08, 0.52)
    without_shapes = re.sub("<collision>.*?</collision>", "", CART, flags=re.DOTALL)
    drive = DifferentialDrive.of(RobotDescription.load(without_shapes), "left", "right", 0.04)
    assert (drive.radius, drive.separation) == (0.04, pytest.approx(0.16))


def test_wheels_may_be_laid_down_by_their_joints():
    drive = DifferentialDrive.of(RobotDescription.load(CART), "left", "right")
    assert (drive.radius, drive.separation) == (0.033, pytest.approx(0.16))


@pytest.mark.parametrize(
    ("change", "joints", "message"),
    [
        (("", ""), ("right", "left"), "must lie left and right of 'base'"),
        (("", ""), ("left", "left"), "must be two joints"),
        (("", ""), ("left", "wheel"), "unknown joint 'wheel'"),
        (('xyz="0 0 1"', 'xyz="0 0 -1"'), ("left", "right"), r"must turn about the \+y axis"),
        (('xyz="0 0 1"', 'xyz="1 0 0"'), ("left", "right"), r"must turn about the \+y axis"),
        (("0 0.08 0.003", "0.1 0.08 0.003"), ("left", "right"), "on one axle through it"),
        (("0 0 0.03", "0.1 0 0.03"), ("left", "right"), "on one axle through it"),
        (("0 0.08", "0 0.09"), ("left", "right"), "on one axle through it"),
        (('radius="0.033"', 'radius="0.034"'), ("left", "right"), "one radius, or wheel_radius"),
        (("cylinder radius", "box radius"), ("left", "right"), "one radius, or wheel_radius"),
        (('rpy="-1.57 0 0"', 'rpy="-1.57 0"'), ("left", "right"), "rpy='-1.57 0' must be 3"),
        (('radius="0.033"', 'radius="wide"'), ("left", "right"), "radius='wide' must be 1"),
    ],
)
def test_what_is_no_pair_of_wheels_is_refused_in_one_line(change, joints, message):
    description = RobotDescription.load(CART.replace(*change, 1) if change[0] else CART)
    with pytest.raises((RobotDescriptionError, SettingError), match=message) as refusal:
        DifferentialDrive.of(description, *joints)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["radius", "separation"])
def test_lengths_are_positive_and_finite(name, value):
    lengths = {"radius": 0.1, "separation": 0.5, name: value}
    with pytest.raises(HpidError, match=f"wheel_{name} must lie in"):
        DifferentialDrive("l", "r", **lengths)


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


def test_only_differences_count_and_wheels_that_stand_change_nothing():
    odometry = Odometry(DRIVE, 100.0, -3.0)
    for _ in range(2):
        odometry.update(104.0, 1.0)
        assert odometry.pose == (pytest.approx(0.3), 0.0, 0.0)
        assert (odometry.distance, odometry.turn) == (pytest.approx(0.3), 0.0)
    before = odometry.covariance
    odometry.update(104.0, 1.0)
    assert odometry.covariance == before


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
