"""Units of joints that turn, and of those that slide."""

import re

import pytest

from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.control.settings import PARAMETERS


@pytest.mark.parametrize(
    ("turning", "sliding"),
    [
        ("N m", "N"),
        ("N m/rad", "N/m"),
        ("N m/(rad s)", "N/(m s)"),
        ("N m s/rad", "N s/m"),
        ("rad s^2", "m s^2"),
        ("rad/s", "m/s"),
        ("kg m^2", "kg"),
        ("gradient of a radius", "gradient of a radius"),
        ("[0, 2 pi); 1/s", "[0, 2 pi); 1/s"),
    ],
)
def test_a_unit_of_a_joint_that_slides(turning, sliding):
    assert of_slide(turning) == sliding
    assert of_slide(sliding) == sliding


def test_a_unit_over_joints_of_both_kinds_is_both_in_one_order():
    assert unit_over("N m", [True, False]) == unit_over("N m", [False, True]) == "N m, N"
    assert unit_over("N m", [True]) == "N"
    assert unit_over("N m", [False, False]) == unit_over("N m", []) == "N m"
    assert unit_over("J", [True, False]) == "J"


def test_no_parameter_of_a_joint_that_slides_is_in_rad():
    for spec in PARAMETERS.values():
        assert not re.search(r"\brad\b|\bN m\b", of_slide(spec.description))
