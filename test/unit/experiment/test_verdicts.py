"""Claims of the paper and the verdicts on them, from evidence alone."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.experiment.study import CLAIMS, NUMERIC_CLAIMS, Evidence, claim_verdict


def evidence(ivc=0.5, iavc=0.7, effort=0.7, itae=0.9, error=1.0, better=6, of=6, **more):
    ratios = {"ivc": ivc, "iavc": iavc, "effort_l2": effort, "itae": itae, "error_l2": error}
    joints = {f"j{k}": 0.9 if k < better else 1.1 for k in range(of)}
    return Evidence({**ratios, **more}, joints)


def claim(key):
    return next(each for each in CLAIMS if each.key == key)


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("ivc", {"ivc": 0.576}),
        ("iavc", {"iavc": 0.791}),
        ("effort_l2", {"effort": 0.778}),
        ("itae", {"itae": 0.948}),
        ("error_l2", {"error": 1.051}),
        ("joints", {"better": 3}),
    ],
)
def test_each_number_of_the_paper_is_a_claim_of_its_own(key, changes):
    limits = evidence(0.575, 0.79, 0.777, 0.947, 1.05, 4)
    assert all(each.holds(limits) for each in NUMERIC_CLAIMS)
    assert claim("together").holds(limits)
    missed = evidence(**changes)
    assert [each.key for each in NUMERIC_CLAIMS if not each.holds(missed)] == [key]
    assert not claim("together").holds(missed)
    assert claim("together").figure(missed) == "5 of 6"


def test_words_are_held_to_what_they_are_taken_to_mean():
    assert not claim("smoother").holds(evidence(ivc=1.0))
    assert not claim("less_effort").holds(evidence(effort=1.01))
    assert claim("accuracy").holds(evidence(itae=1.04))
    assert not claim("accuracy").holds(evidence(itae=1.06))
    assert claim("overshoot").holds(evidence()) is None
    assert claim("overshoot").holds(evidence(overshoot=0.9))
    assert not claim("overshoot").holds(evidence(overshoot=1.1))


@given(st.integers(1, 60))
def test_enough_joints_are_as_many_as_four_of_six(joints):
    wanted = evidence(of=joints).joints_wanted
    assert 6 * wanted >= 4 * joints > 6 * (wanted - 1)


def test_a_verdict_names_where_a_claim_holds():
    good, bad = evidence(), evidence(ivc=0.9)
    each = claim("ivc")
    assert claim_verdict(each, {"a": good, "b": good}) == ("holds", ("a", "b"))
    assert claim_verdict(each, {"a": good, "b": bad}) == ("holds only when", ("a",))
    assert claim_verdict(each, {"b": bad}) == ("does not hold", ())
    assert claim_verdict(claim("overshoot"), {"a": good}) == ("not measured", ())
    with_steps = {"a": good, "b": evidence(overshoot=0.5)}
    assert claim_verdict(claim("overshoot"), with_steps) == ("holds", ("b",))
