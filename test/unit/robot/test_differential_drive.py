"""Two wheels and the twist of their base; what a URDF says of them."""

import math
import re

import pytest
from harness.places import URDF
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive

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


@given(LENGTHS, LENGTHS, RATES)
def test_equal_rates_drive_straight_and_opposite_ones_turn_on_the_spot(radius, separation, rate):
    drive = DifferentialDrive("l", "r", radius, separation)
    assert drive.twist(rate, rate) == (pytest.approx(radius * rate), 0.0)
    linear, angular = drive.twist(-rate, rate)
    assert linear == 0.0
    assert angular == pytest.approx(2.0 * radius * rate / separation)


@given(RATES, RATES)
def test_each_wheel_rolls_as_its_end_of_the_axle_moves(left, right):
    drive = DifferentialDrive("l", "r", 0.075, 0.5)
    linear, angular = drive.twist(left, right)
    assert linear - 0.25 * angular == pytest.approx(0.075 * left, abs=1e-9)
    assert linear + 0.25 * angular == pytest.approx(0.075 * right, abs=1e-9)


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
