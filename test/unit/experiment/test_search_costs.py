"""What a search minimises, and where it looks: costs, limits, shares of the way, fronts."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.experiment.batch import TOTAL, RunRecord
from hpid_bench.experiment.search import (
    EFFORT_PARAMETERS,
    HPID_PARAMETERS,
    PID_PARAMETERS,
    Cost,
    WorstExcess,
    mean_ratios,
)
from hpid_bench.report.plots import pareto_front
from hpid_ros.base.errors import SettingError
from hpid_ros.metrics.quantities import PAPER

PARAMETERS = st.sampled_from([*PID_PARAMETERS, *HPID_PARAMETERS, *EFFORT_PARAMETERS])


@given(PARAMETERS, st.floats(0.0, 1.0))
def test_a_share_of_the_way_is_a_value_within_the_bounds_and_back(parameter, share):
    value = parameter.value(share)
    assert parameter.low <= value <= parameter.high
    assert parameter.share(value) == pytest.approx(share, abs=1e-5)
    assert parameter.value(0.0) == parameter.low
    assert parameter.value(1.0) == parameter.high
    assert parameter.low <= parameter.start <= parameter.high


def records(*runs):
    """Return made-up runs by seed."""
    keys = [quantity.key for quantity in PAPER]
    numbers = [dict(zip(keys, values, strict=True)) for values in runs]
    return dict(enumerate(RunRecord({TOTAL: each}) for each in numbers))


def test_the_cost_is_the_geometric_mean_of_the_ratios():
    baseline = records((1.0, 2.0, 3.0, 4.0, 5.0), (2.0, 2.0, 2.0, 2.0, 2.0))
    runs = records((4.0, 2.0, 3.0, 4.0, 5.0), (2.0, 1.0, 2.0, 2.0, 2.0))
    ratios = mean_ratios(runs, baseline)
    assert ratios == pytest.approx(
        {"ivc": 2.0, "iavc": math.sqrt(0.5), "itae": 1.0, "effort_l2": 1.0, "error_l2": 1.0}
    )
    assert Cost.even().of(ratios) == pytest.approx(2.0**0.1)
    assert Cost({"ivc": 1.0, "iavc": 3.0}).of(ratios) == pytest.approx((2.0 * 0.5**1.5) ** 0.25)
    assert Cost.even().of(mean_ratios(baseline, baseline)) == 1.0


def test_a_zero_against_a_zero_is_one_and_anything_against_zero_costs_infinitely():
    zero, some = records((0.0, 1.0, 1.0, 1.0, 1.0)), records((1.0, 1.0, 1.0, 1.0, 1.0))
    assert Cost.even().of(mean_ratios(zero, zero)) == 1.0
    assert Cost.even().of(mean_ratios(some, zero)) == math.inf
    assert Cost({"itae": 1.0}).of(mean_ratios(some, zero)) == 1.0


def test_limits_make_the_worst_index_the_cost():
    ratios = {"ivc": 0.5, "iavc": 1.0, "itae": 2.0, "effort_l2": 1.0, "error_l2": 1.0}
    assert WorstExcess({"ivc": 0.5, "iavc": 0.8}).of(ratios) == 1.25
    assert WorstExcess({"ivc": 0.5}).of(ratios) == 1.0
    assert WorstExcess({"itae": 1.0}).of({**ratios, "itae": math.inf}) == math.inf


@pytest.mark.parametrize(
    ("kind", "values", "words"),
    [
        (Cost, {"ivcc": 1.0}, "did you mean 'ivc'"),
        (Cost, {"ivc": -1.0}, "must be finite and not negative"),
        (Cost, {"ivc": 0.0}, "at least one index"),
        (Cost, {}, "at least one index"),
        (WorstExcess, {"ivcc": 1.0}, "did you mean 'ivc'"),
        (WorstExcess, {"ivc": 0.0}, "must be finite and positive"),
        (WorstExcess, {}, "at least one index"),
    ],
)
def test_costs_and_limits_that_are_none_are_refused(kind, values, words):
    with pytest.raises(SettingError, match=words):
        kind(values)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=12))
def test_the_front_is_what_nothing_beats(points):
    front = pareto_front(points)
    for place in front:
        x, y = points[place]
        assert not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points)
    best = {points[place] for place in front}
    for x, y in points:
        assert any(a <= x and b <= y for a, b in best)
    assert pareto_front([(math.inf, 0.0), (math.nan, 1.0)]) == []
