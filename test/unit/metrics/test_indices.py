"""The indices against closed forms, whatever the stamps, and of what is not there."""

import dataclasses
import math

import numpy as np
import pytest
from harness.runs import response
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import signal

from hpid_ros.messages.series import JointSeries, Losses, RunSeries, SeriesError
from hpid_ros.metrics.indices import (
    PLATEAU,
    amplitude_density,
    chatter,
    energy,
    find_steps,
    integral_of_absolute,
    itae,
    l2_norm,
    saturation_share,
    spectrum,
    step_response,
    total_variation,
)
from hpid_ros.metrics.quantities import (
    CHATTER,
    EFFORT_L2,
    ERROR_MAX,
    INDICES,
    ITAE,
    IVC,
    L2_NORMS,
    OVERSHOOT,
    QUANTITIES,
    RISE_TIME,
    RMSE,
    SATURATION,
    SETTLING_TIME,
    STEP_QUANTITIES,
    Data,
    find_quantities,
)
from hpid_ros.metrics.run_numbers import joint_indices, run_indices
from hpid_ros.metrics.summation import exact_sum

MS = 1_000_000

samples = hnp.arrays(
    np.float64, st.integers(2, 40), elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=False)
)


def joint(position=None, reference=None, effort=None, name="a", period_ns=MS, start_ns=0):
    count = len(next(each for each in (position, reference, effort) if each is not None))
    zeros = np.zeros(count)
    stamps = start_ns + period_ns * np.arange(count, dtype=np.int64)
    columns = [zeros if each is None else np.asarray(each) for each in (position, reference)]
    return JointSeries(name, stamps, *columns, stamps, zeros if effort is None else effort)


def seconds(duration, period=1e-3):
    return np.arange(round(duration / period) + 1) * period


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
    early, late = (
        joint(reference=values, effort=values, start_ns=start) for start in (0, start_ns)
    )
    assert joint_indices(early) == joint_indices(late)


@given(st.lists(samples, min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_the_order_of_joints_changes_no_bit(efforts, random):
    joints = [
        joint(reference=values / 3.0, effort=values, name=f"joint{k}")
        for k, values in enumerate(efforts)
    ]
    shuffled = random.sample(joints, len(joints))
    before, after = (run_indices(RunSeries("a", tuple(order))) for order in (joints, shuffled))
    assert before == dataclasses.replace(after, joints=before.joints)
    assert dict(before.joints) == dict(after.joints)


def test_itae_counts_from_the_first_state_and_iavc_uses_the_commands_stamps():
    states = np.array([5, 6, 7], dtype=np.int64) * 10**9
    commands = np.array([6, 7], dtype=np.int64) * 10**9
    one = JointSeries("a", states, [0.0, 0.0, 0.0], [1.0, 1.0, 1.0], commands, [3.0, 3.0])
    indices = joint_indices(one)
    assert one.error.tolist() == [1.0, 1.0, 1.0]  # the reference minus the position
    assert indices["itae"] == 2.0
    assert indices["iavc"] == 3.0
    assert one.command_time.tolist() == [1.0, 2.0]


def test_a_joint_that_was_never_answered_has_no_effort_and_no_index_of_it():
    one = JointSeries("a", [0, 10**9], [0.0, 0.0], [1.0, 1.0], [], [])
    run = run_indices(RunSeries("x", (one,)))
    assert not {"ivc", "iavc", "effort_l2"} & set(run.totals)
    assert run.why_undefined(IVC, "a") == run.why_undefined(IVC) == {"a": "no effort was recorded"}
    assert run.totals["itae"] == 0.5


def test_a_joint_without_a_reference_has_efforts_and_no_error_and_totals_are_those_of_the_others():
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
        alone = run_indices(RunSeries("x", (known,)))
        assert run.value(quantity) == pytest.approx(alone.value(quantity), nan_ok=True)
        assert run.why_undefined(quantity, "b") == {"b": "no reference was recorded"}
    assert run.notes == ("reference: totals without b",)
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
    one = joint(effort=effort)
    effort[0] = 9.0
    assert one.effort[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        one.effort[0] = 9.0


def test_a_run_refuses_doubled_joints_and_foreign_losses_and_fills_in_the_rest():
    one = joint(effort=[0.0, 1.0])
    with pytest.raises(SeriesError, match="twice"):
        RunSeries("x", (one, one))
    with pytest.raises(SeriesError, match="unknown joints b; known: a"):
        RunSeries("x", (one,), {"b": Losses(1, 0)})
    with pytest.raises(SeriesError, match="at least one joint"):
        RunSeries("x", ())
    with pytest.raises(SeriesError, match="negative"):
        Losses(-1, 0)
    assert RunSeries("x", (one,)).losses == {"a": Losses(0, 0)}


def test_a_value_is_asked_by_quantity_and_joint():
    run = run_indices(
        RunSeries("x", (joint(reference=[0.1, 0.2], effort=[1.0, 2.0], name="elbow"),))
    )
    assert run.value(ITAE, "elbow") == run.joints["elbow"]["itae"]
    with pytest.raises(SeriesError, match="did you mean 'elbow'"):
        run.value(ITAE, "elbo")
    assert run.value(EFFORT_L2, "elbow") == run.value(EFFORT_L2)
    bare = dataclasses.replace(run, quantities=INDICES)
    with pytest.raises(
        SeriesError, match="run 'x' was measured without effort_l2, its numbers are ivc, ia"
    ):
        bare.value(EFFORT_L2)


# Sums ------------------------------------------------------------------------------------------


@given(
    hnp.arrays(
        np.float64, st.integers(0, 700), elements=st.floats(-1e300, 1e300, allow_subnormal=True)
    )
)
def test_a_sum_is_correctly_rounded_whatever_its_terms(values):
    assert exact_sum(values) == math.fsum(values.tolist())


def test_a_long_sum_that_cancels_is_correctly_rounded():
    random = np.random.default_rng(1)
    values = random.normal(size=50_000) * 10.0 ** random.integers(-200, 200, size=50_000)
    values = random.permutation(np.concatenate([values, -values, [1e-9, 3e-30]]))
    assert exact_sum(values) == math.fsum([1e-9, 3e-30])


# Error -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 300, 20_000])
@pytest.mark.parametrize("number", [math.inf, math.nan, 1.7e308])
def test_a_sum_that_is_no_number_is_refused(count, number):
    with pytest.raises(SeriesError, match=r"beyond 1\.8e308"):
        exact_sum(np.full(count, number))


def test_error_indices_of_a_decay_are_those_of_the_integrals():
    t = seconds(9.0)
    indices = joint_indices(joint(reference=np.exp(-t)))
    exact = {
        "iae": 1.0 - math.exp(-9.0),
        "ise": (1.0 - math.exp(-18.0)) / 2.0,
        "rmse": math.sqrt((1.0 - math.exp(-18.0)) / 18.0),
        "error_l2": math.sqrt((1.0 - math.exp(-18.0)) / 2.0),
    }
    for key, value in exact.items():
        assert indices[key] == pytest.approx(value, rel=1e-6)
    assert indices["error_max"] == 1.0


def test_the_largest_error_counts_in_either_direction():
    assert joint_indices(joint(reference=[0.5, -2.0, 1.0]))[ERROR_MAX.key] == 2.0
    assert joint_indices(joint(reference=[0.5, 2.5, -1.0]))[ERROR_MAX.key] == 2.5


# Steps -----------------------------------------------------------------------------------------


def first_order(time_constant, at=1.0, height=1.0, until=4.0):
    t = seconds(until)
    after = np.maximum(t - at, 0.0)
    reference = np.where(t >= at, height, 0.0)
    return joint(height * (1.0 - np.exp(-after / time_constant)) * (t >= at), reference)


@pytest.mark.parametrize(("last", "share"), [(1.0, 0.8), (1.01, 8 / 11), (0.99, 8 / 9)])
def test_settling_is_on_the_straight_line_between_samples_also_past_the_goal(last, share):
    progress = np.array([0.0] * 10 + [0.9] + [last] * 990)
    series = joint(progress, np.array([0.0] * 5 + [1.0] * 996), period_ns=10 * MS)
    (step,) = find_steps(series)
    assert step_response(series, step).settling_time == pytest.approx(0.01 * (5 + share))


@pytest.mark.parametrize("height", [1.0, -0.4])
@pytest.mark.parametrize("time_constant", [0.05, 0.2])
def test_a_first_order_lag_rises_in_ln_nine_time_constants_and_settles_in_ln_fifty(
    time_constant, height
):
    (step,) = find_steps(series := first_order(time_constant, height=height))
    response = step_response(series, step)
    assert (step.start, step.goal) == (0.0, height)
    assert response.rise_time == pytest.approx(time_constant * math.log(9.0), abs=2e-5)
    assert response.settling_time == pytest.approx(time_constant * math.log(50.0), abs=2e-5)
    assert response.overshoot == 0.0
    assert response.steady_state_error < 1e-4 * abs(height)


@pytest.mark.parametrize("damping", [0.2, 0.5, 0.8])
def test_a_second_order_response_overshoots_by_the_closed_form(damping):
    t, frequency = seconds(6.0), 10.0
    damped = frequency * math.sqrt(1.0 - damping**2)
    decay = np.exp(-damping * frequency * t)
    sine = damping / math.sqrt(1.0 - damping**2) * np.sin(damped * t)
    series = joint(1.0 - decay * (np.cos(damped * t) + sine), np.ones(t.size))
    exact = 100.0 * math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert joint_indices(series)[OVERSHOOT.key] == pytest.approx(exact, rel=1e-3)


def test_an_offset_that_stays_is_the_steady_state_error_and_never_settles():
    t = seconds(2.0)
    position = 0.95 * (1.0 - np.exp(-t / 0.02))
    indices = joint_indices(joint(position, np.ones(t.size)))
    assert indices["steady_state_error"] == pytest.approx(0.05, abs=1e-9)
    assert indices[SETTLING_TIME.key] == math.inf
    stuck = joint_indices(joint(0.5 * (t > 0.01), np.ones(t.size)))
    assert stuck[RISE_TIME.key] == math.inf


def test_the_worst_of_several_steps_counts():
    quick, slow = first_order(0.02), first_order(0.1)
    both = joint(
        np.concatenate([quick.position, 1.0 + slow.position]),
        np.concatenate([quick.reference, 1.0 + slow.reference]),
    )
    assert len(find_steps(both)) == 2
    slowest = joint_indices(slow)[RISE_TIME.key]
    assert joint_indices(both)[RISE_TIME.key] == pytest.approx(slowest, rel=1e-12)


def test_smooth_motions_their_ends_and_sensor_noise_are_no_steps():
    t = seconds(3.0)
    s = np.clip(t - 1.0, 0.0, 1.0)
    smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
    assert not find_steps(joint(smooth, smooth))
    ramp = np.clip(t - 1.0, 0.0, 1.0)
    assert not find_steps(joint(ramp, ramp))
    assert not find_steps(joint(np.full(t.size, 4e-4), np.zeros(t.size)))
    indices = joint_indices(joint(smooth, smooth))
    assert not {quantity.key for quantity in STEP_QUANTITIES} & set(indices)


def test_a_reference_that_starts_away_from_the_joint_is_a_step_from_where_it_stands():
    t = seconds(2.0)
    (step,) = find_steps(joint(0.3 * np.exp(-t / 0.1), np.zeros(t.size)))
    assert (step.first, step.start, step.goal) == (0, 0.3, 0.0)


# Effort ----------------------------------------------------------------------------------------


def test_a_clipped_sine_is_saturated_for_the_closed_share_of_time():
    t = seconds(2.0)
    effort = np.clip(np.sin(2 * math.pi * t), -0.5, 0.5)
    exact = 100.0 * 2.0 / 3.0  # |sin| exceeds one half for two thirds of a period
    series = joint(effort=effort)
    assert saturation_share(series) == pytest.approx(exact, abs=0.2)
    assert saturation_share(series, limit=0.5) == pytest.approx(exact, abs=0.2)
    assert saturation_share(series, limit=0.6) == 0.0


def test_a_moving_a_constant_and_a_silent_effort_are_not_saturated():
    t = seconds(1.0)
    assert saturation_share(joint(effort=np.sin(7.0 * t))) == 0.0
    assert saturation_share(joint(effort=np.full(t.size, 2.0))) == 0.0
    short = np.sin(7.0 * t)
    short[10 : 10 + PLATEAU - 1] = 9.0  # too short for a clamp
    assert saturation_share(joint(effort=short)) == 0.0
    late = np.where(t < 0.3, 0.0, 2.0 + np.sin(7.0 * t))  # nobody drives it at first
    assert saturation_share(joint(effort=late)) == 0.0
    silent = JointSeries("a", [0, MS], [0.0, 0.0], [0.0, 0.0], [], [])
    assert saturation_share(silent) == 0.0


def test_energy_of_a_command_between_states_uses_the_position_on_the_straight_line():
    states, commands = np.array([0, 10, 20]) * MS, np.array([5, 15]) * MS
    series = JointSeries("a", states, [0.0, 1.0, -1.0], [0.0] * 3, commands, [-2.0, 4.0])
    assert energy(series) == pytest.approx(2.0 * 0.5 + 4.0 * 1.0)  # there and back both count


@pytest.mark.parametrize("frequency", [50.0, 123.4])
def test_chatter_is_the_rms_of_what_lies_above_the_cutoff_and_nothing_below(frequency):
    t = seconds(5.0)
    slow = 30.0 * np.sin(2 * math.pi * 2.0 * t)
    fast = 0.8 * np.sin(2 * math.pi * frequency * t)
    both = chatter(joint(effort=slow + fast), 20.0)
    assert both == pytest.approx(0.8 / math.sqrt(2.0), rel=0.01)
    assert chatter(joint(effort=slow), 20.0) < 1e-3


@pytest.mark.parametrize("rate", [100.0, 101.0])
@pytest.mark.parametrize("size", [16, 99, 101, 250, 60_000])
def test_the_spectrum_is_that_of_scipy(rate, size):
    """An even and an odd window, less than one, and more than are transformed at once."""
    x = np.random.default_rng(size).normal(1.0, 2.0, size)
    found = spectrum(np.arange(size) / rate, x)
    frequency, density = signal.welch(x, rate, nperseg=min(size, int(rate)))
    np.testing.assert_allclose(found.frequency, frequency, rtol=1e-12)
    np.testing.assert_allclose(found.density, density, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("spoil", ["even", "late", "lost"])
def test_white_noise_is_as_strong_at_half_the_rate_as_below_whatever_the_clock(spoil):
    random = np.random.default_rng(1)
    count = 20_001
    stamps = np.arange(count) * MS
    noise = random.normal(size=count)
    if spoil == "late":
        stamps = stamps + np.round(random.normal(size=count) * 0.05 * MS).astype(np.int64)
    kept = np.flatnonzero(random.uniform(size=count) > (0.01 if spoil == "lost" else -1.0))
    stamps, noise = stamps[kept], noise[kept]
    series = JointSeries("a", stamps, noise, noise, stamps, noise)
    frequency, density, _ = amplitude_density(series)
    level = float(np.median(density[(frequency > 50.0) & (frequency < 300.0)]))
    high = density[frequency > 450.0]
    assert float(np.median(high)) == pytest.approx(level, rel=0.06)
    assert density[-1] > 0.85 * level  # not half the power, which is its own mirror image
    assert 498.0 < frequency[-1] < 500.0


def test_chatter_has_no_number_where_it_cannot_be_seen():
    assert chatter(joint(effort=np.ones(10)), 20.0) is None  # too few commands
    slow = joint(effort=np.sin(np.arange(100.0)), period_ns=50 * MS)  # 20 Hz
    assert chatter(slow, 20.0) is None
    assert CHATTER.key not in joint_indices(slow)
    t = np.repeat(np.arange(40) * 0.1, 4) + np.tile(np.arange(4) * 1e-3, 40)  # 4 of 100 commands
    assert spectrum(t, np.sin(300.0 * t)) is None


# All joints ------------------------------------------------------------------------------------


def test_each_quantity_folds_over_joints_as_it_says():
    run = run_indices(response("x", damping=2.0, samples=9001))
    by = {
        "sum": math.fsum,
        "largest": max,
        "mean": lambda values: sum(values) / 2,
        "root of the sum of squares": lambda values: math.hypot(*values),
        "root of the mean of squares": lambda values: math.hypot(*values) / math.sqrt(2),
    }
    for quantity in QUANTITIES.values():
        values = [run.value(quantity, name) for name in run.joints]
        expected = by[quantity.fold.value](values)
        assert run.value(quantity) == pytest.approx(expected, rel=1e-12), quantity.key


def test_a_total_that_lacks_a_joint_is_not_given_as_that_of_all():
    t = seconds(2.0)
    lively = joint(0.1 * t, np.sin(t), np.sin(300.0 * t), "a")
    stamps = lively.command_stamps_ns
    slow = dataclasses.replace(
        lively, joint="b", command_stamps_ns=stamps[::50], effort=lively.effort[::50]
    )
    run = run_indices(RunSeries("x", (lively, slow)))
    assert run.value(QUANTITIES["chatter"], "a") > 0.0
    assert math.isnan(run.value(QUANTITIES["chatter"], "b"))
    assert math.isnan(run.value(QUANTITIES["chatter"]))


def test_a_joint_without_a_step_does_not_hide_the_one_that_has():
    stepping = first_order(0.1)
    still = JointSeries(
        "b",
        stepping.state_stamps_ns,
        stepping.reference * 0.0,
        stepping.reference * 0.0,
        stepping.command_stamps_ns,
        stepping.effort,
    )
    run = run_indices(RunSeries("x", (stepping, still)))
    assert run.value(RISE_TIME) == run.value(RISE_TIME, "a")
    assert math.isnan(run.value(RISE_TIME, "b"))


# Choices ---------------------------------------------------------------------------------------


def test_limits_and_cutoff_are_used_and_checked():
    series = joint(effort=np.tile([1.0, -1.0], 500))
    run = RunSeries("x", (series,))
    limited = run_indices(run, effort_limits={"a": 1.0})
    assert (limited.value(SATURATION), run_indices(run).value(SATURATION)) == (100.0, 0.0)
    assert run_indices(run, cutoff=30.0).conditions.cutoff == 30.0
    with pytest.raises(SeriesError, match="unknown joint 'b'; known: a"):
        run_indices(run, effort_limits={"b": 1.0})
    for wrong in ({"cutoff": 0.0}, {"cutoff": math.nan}, {"effort_limits": {"a": -1.0}}):
        with pytest.raises(SeriesError, match="must be positive and finite"):
            run_indices(run, **wrong)


def test_quantities_are_found_by_key_symbol_or_group_once_each():
    assert find_quantities(["paper"]) == (*INDICES, *L2_NORMS)
    assert find_quantities(["all"]) == tuple(QUANTITIES.values())
    assert find_quantities([" RMSE", "rmse", "max|e|"]) == (RMSE, ERROR_MAX)
    assert find_quantities(["step", "rise_time"]) == STEP_QUANTITIES
    with pytest.raises(SeriesError, match="unknown index 'rmsee'; did you mean 'rmse'"):
        find_quantities(["rmsee"])
