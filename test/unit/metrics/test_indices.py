import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hpid_ros.messages.series import JointSeries, Losses, RunSeries, SeriesError
from hpid_ros.metrics.indices import integral_of_absolute, itae, l2_norm, total_variation
from hpid_ros.metrics.quantities import EFFORT_L2, INDICES, ITAE, IVC, QUANTITIES, Data
from hpid_ros.metrics.results import joint_indices, run_indices

samples = hnp.arrays(
    np.float64, st.integers(2, 40), elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=False)
)


def series(joint, effort, error, start_ns=0, period_ns=1_000_000):
    stamps = start_ns + period_ns * np.arange(len(effort), dtype=np.int64)
    error = np.asarray(error, dtype=np.float64)
    return JointSeries(joint, stamps, -error, np.zeros_like(error), stamps, np.asarray(effort))


# Closed forms ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measure", "signal", "exact"),
    [
        (lambda t, x: total_variation(x), np.sin, 6.0 - math.sin(9.0)),
        (integral_of_absolute, np.sin, 5.0 - math.cos(9.0)),
        (itae, lambda t: np.exp(-t), 1.0 - 10.0 * math.exp(-9.0)),
        (lambda t, x: l2_norm(t, x) ** 2, np.sin, 4.5 - math.sin(18.0) / 4.0),
    ],
)
def test_numbers_of_a_signal_are_those_of_the_integrals(measure, signal, exact):
    """Of so many samples that they are worked on in several blocks."""
    t = np.linspace(0.0, 9.0, 150_001)
    assert measure(t, signal(t)) == pytest.approx(exact, abs=1e-8)


def test_uneven_stamps_weigh_each_interval_by_its_own_length():
    assert integral_of_absolute([0.0, 1.0, 4.0], [2.0, 2.0, -2.0]) == 8.0
    assert itae([0.0, 1.0, 4.0], [1.0, 1.0, 1.0]) == 8.0
    assert l2_norm([0.0, 1.0, 5.0], [3.0, 3.0, 3.0]) == pytest.approx(math.sqrt(45.0))


# Properties ------------------------------------------------------------------------------------


@given(samples, st.integers(-(10**18), 10**18))
def test_nothing_of_a_run_depends_on_when_it_was_made(values, start_ns):
    early, late = (series("a", values, values, start) for start in (0, start_ns))
    assert joint_indices(early) == joint_indices(late)


@given(st.lists(samples, min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_the_order_of_joints_changes_no_bit(efforts, random):
    joints = [series(f"joint{k}", values, values / 3.0) for k, values in enumerate(efforts)]
    shuffled = random.sample(joints, len(joints))
    before, after = (run_indices(RunSeries("a", tuple(order))) for order in (joints, shuffled))
    assert before == dataclasses.replace(after, joints=before.joints)
    assert dict(before.joints) == dict(after.joints)


def test_itae_counts_from_the_first_state_and_iavc_uses_the_commands_stamps():
    states = np.array([5, 6, 7], dtype=np.int64) * 10**9
    commands = np.array([6, 7], dtype=np.int64) * 10**9
    joint = JointSeries("a", states, [0.0, 0.0, 0.0], [1.0, 1.0, 1.0], commands, [3.0, 3.0])
    indices = joint_indices(joint)
    assert joint.error.tolist() == [1.0, 1.0, 1.0]  # the reference minus the position
    assert indices["itae"] == 2.0
    assert indices["iavc"] == 3.0
    assert joint.command_time.tolist() == [1.0, 2.0]


def test_a_joint_that_was_never_answered_has_no_effort_and_no_index_of_it():
    joint = JointSeries("a", [0, 10**9], [0.0, 0.0], [1.0, 1.0], [], [])
    run = run_indices(RunSeries("x", (joint,)))
    assert not {"ivc", "iavc", "effort_l2"} & set(run.totals)
    assert run.why_undefined(IVC, "a") == run.why_undefined(IVC) == {"a": "no effort was recorded"}
    assert run.totals["itae"] == 0.5


def test_a_joint_without_a_reference_has_efforts_and_no_error_and_no_sum_goes_over_the_others():
    stamps = np.arange(3) * 10**9
    known = JointSeries("a", stamps, np.zeros(3), np.ones(3), stamps, [1.0, 2.0, 3.0])
    unknown = JointSeries("b", stamps, np.zeros(3), [], stamps, [1.0, 2.0, 3.0])
    run = run_indices(RunSeries("x", (known, unknown)))
    assert (run.totals["ivc"], run.value(IVC, "b")) == (4.0, 2.0)
    assert run.value(ITAE, "a") == 2.0
    of_error = [each for each in QUANTITIES.values() if each.needs is Data.REFERENCE]
    assert {"itae", "error_l2", "rmse", "rise_time"} <= {each.key for each in of_error}
    for quantity in of_error:
        assert math.isnan(run.value(quantity, "b"))
        assert math.isnan(run.value(quantity)), quantity.key
        assert run.why_undefined(quantity)["b"] == "no reference was recorded"
    with pytest.raises(SeriesError, match="joint 'b': no reference was recorded"):
        _ = unknown.error
    with pytest.raises(SeriesError, match="reference has shape"):
        JointSeries("b", stamps, np.zeros(3), [1.0], stamps, np.zeros(3))


# Refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("t", "x", "words"),
    [
        ([0.0, 1.0], [1.0], "one length, got 2 and 1"),
        ([0.0, -1.0], [1.0, 1.0], "must not fall"),
        ([0.0, 1.0], [1.0, math.nan], r"\[1\] = nan"),
        ([[0.0], [1.0]], [1.0, 1.0], "one-dimensional"),
    ],
)
@pytest.mark.parametrize("measure", [integral_of_absolute, itae, l2_norm])
def test_arrays_that_are_no_signal_are_refused(measure, t, x, words):
    with pytest.raises(SeriesError, match=words):
        measure(t, x)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joint": ""}, "name"),
        ({"position": [0.0]}, r"position has shape \(1,\), but its stamps have \(2,\)"),
        ({"reference": [0.0, math.inf]}, r"reference must be finite, but \[1\] = inf"),
        ({"effort": [math.nan, 0.0]}, "effort must be finite"),
        ({"state_stamps_ns": [1, 1]}, "increase strictly"),
        ({"command_stamps_ns": [2, 1]}, "increase strictly"),
        ({"state_stamps_ns": [0.0, 1.0]}, "line of integers, got float64"),
        ({"state_stamps_ns": [], "position": [], "reference": []}, "no state"),
    ],
)
def test_a_series_that_cannot_be_is_refused_with_the_joint_and_the_reason(change, words):
    good = {
        "joint": "elbow",
        "state_stamps_ns": [0, 1],
        "position": [0.0, 0.0],
        "reference": [0.0, 0.0],
        "command_stamps_ns": [0, 1],
        "effort": [0.0, 0.0],
    }
    JointSeries(**good)
    with pytest.raises(SeriesError, match=words):
        JointSeries(**{**good, **change})


def test_a_series_cannot_be_changed_from_outside():
    effort = np.array([1.0, 2.0])
    joint = series("a", effort, [0.0, 0.0])
    effort[0] = 9.0
    assert joint.effort[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        joint.effort[0] = 9.0


def test_a_run_refuses_doubled_joints_and_foreign_losses_and_fills_in_the_rest():
    joint = series("a", [0.0, 1.0], [0.0, 0.0])
    with pytest.raises(SeriesError, match="twice"):
        RunSeries("x", (joint, joint))
    with pytest.raises(SeriesError, match="unknown joints b; known: a"):
        RunSeries("x", (joint,), {"b": Losses(1, 0)})
    with pytest.raises(SeriesError, match="at least one joint"):
        RunSeries("x", ())
    with pytest.raises(SeriesError, match="negative"):
        Losses(-1, 0)
    assert RunSeries("x", (joint,)).losses == {"a": Losses(0, 0)}


def test_a_value_is_asked_by_quantity_and_joint():
    run = run_indices(RunSeries("x", (series("elbow", [1.0, 2.0], [0.1, 0.2]),)))
    assert run.value(ITAE, "elbow") == run.joints["elbow"]["itae"]
    with pytest.raises(SeriesError, match="did you mean 'elbow'"):
        run.value(ITAE, "elbo")
    assert run.value(EFFORT_L2, "elbow") == run.value(EFFORT_L2)
    bare = dataclasses.replace(run, quantities=INDICES)
    with pytest.raises(SeriesError, match=r"run 'x': unknown index 'effort_l2'.*iavc, itae, ivc"):
        bare.value(EFFORT_L2)
