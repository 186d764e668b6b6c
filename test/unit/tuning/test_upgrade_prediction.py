"""A prediction is of the joints of which something was recorded."""

import math

import pytest

from hpid_ros.tuning.upgrade_prediction import Expected, Prediction

MOVING = {key: Expected(4.0, 0.5, 1.1, 0.2) for key in ("ivc", "iavc", "itae")}


def prediction(**joints):
    return Prediction("bag", "smooth", joints)


@pytest.mark.parametrize("fidelity", [math.nan, math.inf])
def test_a_joint_that_rested_without_an_effort_is_no_reason_to_doubt_the_others(fidelity):
    resting = dict.fromkeys(MOVING, Expected(0.0, math.nan, fidelity))
    found = prediction(arm=MOVING, turn=resting)
    assert found.is_credible
    assert found.total("ivc") == pytest.approx((4.0, 0.5, 1.1, 0.2))


def test_a_joint_whose_model_is_wrong_is():
    wrong = dict.fromkeys(MOVING, Expected(4.0, 0.5, 3.0))
    assert not prediction(arm=MOVING, turn=wrong).is_credible
    assert not prediction(turn=dict.fromkeys(MOVING, Expected(0.0, 1.0, 1.0))).is_credible


def test_the_interval_of_all_joints_is_between_those_of_the_joints():
    sure = dict.fromkeys(MOVING, Expected(4.0, 0.5, 1.0, 0.05))
    total = prediction(arm=MOVING, turn=sure).total("ivc")
    assert 0.05 < total.doubt < 0.2
    assert total.low < total.ratio < total.high < 1.0
    assert total.is_certain
    assert not total._replace(doubt=1.0).is_certain
