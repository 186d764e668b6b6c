"""The band of frozen loops: what is in it, what is worst, what is refused."""

import pytest
from harness.examples import examples
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import Gains
from hpid_ros.stability.margins import family_margins, loop_family

GAINS = Gains(21.0, 52.5, 2.1)
FILTERED = {"velocity_source": "filtered", "velocity_filter_time_constant": 0.01}
EFFORTS = {"norm__effort_scale": 3.0, "norm__type": "canonical"}


def family(law="hpid", mu=-0.3, inertia=(0.105, 0.105), largest_norm=None, delay=0.0, **others):
    given_by_test = {**FILTERED, **EFFORTS, "norm__floor": 0.1, **others}
    settings = loop_settings(gains=GAINS, law=law, mu=mu, **given_by_test)
    return loop_family(settings, inertia, 0.5, delay, largest_norm)


def test_without_a_degree_the_band_is_the_line_of_the_pid():
    pid, homogeneous = family("pid"), family(mu=0.0)
    assert pid.multipliers == homogeneous.multipliers == (1.0,)
    assert family_margins(pid).cases == family_margins(homogeneous).cases
    model = {"gains": Gains(200.0, 500.0, 20.0), "compensation": "decoupling", "inertia": 0.1}
    decoupled = loop_family(loop_settings(law="pid", **model), (1.0, 1.0), friction=0.5)
    assert decoupled.friction == 0.0


@examples(0.2)
@given(st.floats(-0.45, 0.45).filter(lambda mu: abs(mu) > 0.02))
def test_the_band_contains_the_line(degree):
    found = family(mu=degree)
    assert 1.0 in found.multipliers
    margins = family_margins(found)
    line = margins.of((1.0,)).worst
    worst = margins.worst
    assert worst.disk <= line.disk
    assert worst.sensitivity >= line.sensitivity
    assert worst.gain_reduction >= line.gain_reduction
    ends = sorted(norm**degree for norm in found.norms)
    assert (found.multipliers[0], found.multipliers[-1]) == pytest.approx(tuple(ends))
    assert found.norm_of(found.multipliers[0]) == pytest.approx(
        found.norms[0 if degree > 0 else 1]
    )


def test_each_worst_margin_is_that_of_the_case_it_names():
    margins = family_margins(family(inertia=(0.05, 0.3), delay=0.004))
    for name, case in margins.where.items():
        values = [getattr(each.margins, name) for each in margins.cases]
        assert getattr(case.margins, name) in (min(values), max(values))
    where = margins.where
    assert where["gain"].inertia == 0.05  # the lightest joint has the largest loop gain
    assert where["gain_reduction"].inertia == 0.3
    assert margins.worst.sensitivity_at == where["sensitivity"].margins.sensitivity_at


def test_an_unstable_loop_of_the_band_takes_all_margins():
    margins = family_margins(family(inertia=(0.01, 0.105), delay=0.012))
    assert not margins.is_stable
    assert margins.worst is None
    assert margins.where == {}
    assert 0 < len(margins.unstable) < len(margins.cases)
    assert all(each.margins is None for each in margins.unstable)


@pytest.mark.parametrize(
    ("others", "norms"),
    [
        ({}, (0.1, 2.0)),
        ({"norm__cap": 5.0}, (0.1, 5.0)),
        ({"largest_norm": 9.0}, (0.1, 9.0)),
        ({"largest_norm": 9.0, "norm__cap": 5.0}, (0.1, 5.0)),
        ({"norm__floor": 0.0}, (1e-6, 2.0)),
    ],
)
def test_the_norm_reaches_from_its_floor_to_its_cap(others, norms):
    assert family(**others).norms == pytest.approx(norms)


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"delay": 0.3}, r"lie in \[0, 0.2\] s, 200 control periods, not 0.3 s"),
        ({"delay": -1.0}, r"not -1 s"),
        ({"largest_norm": 0.0}, "largest norm must be positive"),
    ],
)
def test_what_is_out_of_range_is_refused(others, words):
    with pytest.raises(SettingError, match=words):
        family(**others)
