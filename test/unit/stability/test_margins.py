"""Margins are margins: just within one the sampled loop is stable, just beyond it is not."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from harness.examples import examples
from harness.loops import loop_settings
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.stability.frequency import FrozenLoop, SampledJoint
from hpid_ros.stability.margins import family_margins, frequency_grid, loop_family, margins_of

NEAR = 1e-3


@st.composite
def frozen_loops(draw, sources=("measured", "filtered", "observer"), slowest=-2.0):
    """Draw stable loops of any size, from calm to close to what sampling bears."""
    inertia = 10.0 ** draw(st.floats(-3.0, 0.0))
    rate = 10.0 ** draw(st.floats(0.5, 1.8))
    period = 10.0 ** draw(st.floats(slowest, -0.7)) / rate
    p, d = draw(st.floats(0.1, 1.0)), draw(st.floats(0.7, 3.0))
    i = draw(st.sampled_from([0.0, 0.05, 0.3])) * p * d
    settings = LoopSettings.from_parameters(
        {
            "joint": "elbow",
            "law": "pid",
            "gains.p": p * rate**2 * inertia,
            "gains.i": i * rate**3 * inertia,
            "gains.d": d * rate * inertia,
            "inertia": inertia,
            "control_period": period,
            "state_timeout": 1.0,
            "velocity_source": draw(st.sampled_from(sources)),
            "velocity_filter_time_constant": draw(st.floats(0.0, 0.2)) / rate,
            "discretization": draw(st.sampled_from(["explicit", "semi_implicit"])),
        }
    )
    friction = draw(st.sampled_from([0.0, 0.1, 1.0])) * rate * inertia
    delay = draw(st.floats(0.0, 4.0)) * period
    loop = FrozenLoop(
        settings,
        SampledJoint(inertia, period, friction, delay),
        multiplier=draw(st.sampled_from([0.5, 1.0, 2.0])),
    )
    assume(loop.spectral_radius < 1.0 - 1e-5)
    return loop


def with_gain(loop, factor):
    """Return the loop with a joint that answers by a factor more."""
    joint = loop.joint
    return replace(
        loop,
        joint=replace(joint, inertia=joint.inertia / factor, friction=joint.friction / factor),
    )


@examples(1)
@given(frozen_loops(slowest=-1.0))
def test_the_gain_may_vary_between_its_margins_and_no_further(loop):
    found = margins_of(loop)
    within = np.geomspace(max(found.gain_reduction, 0.02), min(found.gain, 50.0), 7)
    within[[0, -1]] *= 1.0 + NEAR, 1.0 - NEAR
    assert all(with_gain(loop, factor).is_stable for factor in within)
    if found.gain < math.inf:
        assert not with_gain(loop, found.gain * (1.0 + NEAR)).is_stable
    if found.gain_reduction > 0.0:
        assert not with_gain(loop, found.gain_reduction * (1.0 - NEAR)).is_stable
    # The disk margin bounds the others, and the peaks: S - T = 2 S - 1 = 1 - 2 T.
    low, high = found.disk_gain
    assert found.gain_reduction <= low * (1.0 + 1e-6)
    assert found.gain >= high * (1.0 - 1e-6)
    assert found.phase >= found.disk_phase * (1.0 - 1e-6)
    peak = 0.5 * (2.0 / found.disk + 1.0) * (1.0 + 1e-6)
    assert max(found.sensitivity, found.complementary) <= peak


@examples(1)
@given(frozen_loops(slowest=-1.0))
def test_dead_time_may_grow_by_the_delay_margin_and_no_further(loop):
    found = margins_of(loop)
    own = loop.joint.delay
    for share in (0.3, 0.7, 1.0 - NEAR):
        assert loop.with_delay(own + share * found.delay).is_stable
    assert not loop.with_delay(own + found.delay * (1.0 + NEAR)).is_stable


def test_a_dead_time_that_costs_stability_at_the_nyquist_frequency_counts():
    """No crossover is there without it: a fraction of the period changes the gain, too."""
    period = 0.0191
    gains = {"gains.p": 100.0, "gains.i": 0.0, "gains.d": 30.0, "inertia": 1.0}
    settings = LoopSettings.from_parameters(
        {"joint": "elbow", "law": "pid", "control_period": period, "state_timeout": 1.0, **gains}
        | {"velocity_source": "measured"}
    )
    joint = SampledJoint(1.0, period, 10.0, 0.5 * period)
    loop = FrozenLoop(settings, joint, multiplier=2.0)
    found = margins_of(loop)
    assert found.delay < 0.8 * found.phase / found.crossover
    late = [loop.with_delay(joint.delay + share * found.delay) for share in (1 - NEAR, 1 + NEAR)]
    assert [each.is_stable for each in late] == [True, False]


def python_control_loop(loop):
    """Return the open loop of an explicit PID with a filtered velocity, by python-control."""
    gains, joint, tau = (
        loop.gains,
        loop.joint,
        loop.settings.velocity.velocity_filter_time_constant,
    )
    period = joint.period
    a = joint.friction / joint.inertia
    plant = control.ss([[0.0, 1.0], [0.0, -a]], [[0.0], [1.0 / joint.inertia]], [[1.0, 0.0]], 0)
    parts = [
        ([gains.i * period], [1.0, -1.0]),
        ([gains.d, -gains.d], [tau + period, -tau]),
        ([1.0], [1.0, *[0.0] * round(joint.delay / period)]),
    ]
    integral, rate, late = (control.ss(control.tf(*each, period)) for each in parts)
    return (gains.p + integral + rate) * late * control.c2d(plant, period, "zoh")


def around_peaks(frequency, response):
    """Return the frequencies and more of them around the peaks that margins are read at."""
    sensitivity = 1.0 / (1.0 + response)
    peaks = [sensitivity, 1.0 - sensitivity, sensitivity - 0.5]
    places = [int(np.abs(each).argmax()) for each in peaks]
    ends = [(frequency[max(0, k - 1)], frequency[min(k + 1, len(frequency) - 1)]) for k in places]
    return np.unique(np.concatenate([frequency, *(np.geomspace(*each, 60) for each in ends)]))


@examples(0.4)
@given(frozen_loops(sources=("filtered",), slowest=-1.5), st.integers(0, 4))
def test_margins_and_peaks_are_those_of_python_control(loop, late):
    settings = loop.settings.with_parameters({"discretization": "explicit"})
    loop = replace(loop, settings=settings).with_delay(late * loop.joint.period)
    assume(loop.spectral_radius < 1.0 - 1e-4)
    found = margins_of(loop)
    frequency = frequency_grid(loop, 600)[:-1]
    other = python_control_loop(loop)
    response = other(np.exp(1j * frequency * loop.joint.period)).ravel()
    for _ in range(2):  # a loop that is nearly unstable has narrow peaks
        frequency = around_peaks(frequency, response)
        response = other(np.exp(1j * frequency * loop.joint.period)).ravel()
    assert loop.response(frequency)[::50] == pytest.approx(response[::50], rel=1e-5)
    data = control.frd(response, frequency, dt=loop.joint.period)
    gains, phases, _, _, crossovers, _ = control.stability_margins(data, returnall=True)
    above = [each for each in gains if each > 1.0]
    if above and found.gain < 1e3:
        # python-control does not look at the Nyquist frequency itself.
        at_nyquist = -1.0 / loop.response(np.array([loop.joint.nyquist])).real[0]
        least = min([*above, *([at_nyquist] if at_nyquist > 1.0 else [])])
        assert found.gain == pytest.approx(least, rel=5e-3)
    assert math.degrees(found.phase) == pytest.approx(np.abs(phases).min(), rel=5e-3)
    assert found.crossover == pytest.approx(crossovers.max(), rel=5e-3)
    alpha, _, _ = control.disk_margins(other, frequency)
    assert found.disk == pytest.approx(min(float(alpha), 2.0), rel=2e-3)
    peak = np.abs(1.0 / (1.0 + response)).max()
    assert found.sensitivity == pytest.approx(max(1.0, peak), rel=2e-3)
    peak = np.abs(response / (1.0 + response)).max()
    assert found.complementary == pytest.approx(max(1.0, peak), rel=2e-3)


def damped(gain, moved, **others):
    values = {"joint": "elbow", "law": "pid", "control_period": 1e-3, "gains.d": gain, **others}
    return FrozenLoop(LoopSettings.from_parameters(values), SampledJoint(moved, 1e-3))


def test_a_loop_that_sampling_breaks_has_no_margins():
    """Hurwitz says stable, the sampled loop is not: T d / m = 4."""
    loop = damped(400.0, 0.1, **{"gains.p": 1.0, "gains.i": 0.1, "inertia": 0.1})
    assert not loop.is_stable
    with pytest.raises(GainError, match=r"is unstable: spectral radius 3$"):
        margins_of(loop)


@pytest.mark.parametrize("times", [1.9, 2.1])
def test_a_pure_damper_breaks_where_theory_says(times):
    """T d / m = 2 with a measured velocity, at the Nyquist frequency, where L is real."""
    loop = damped(times, 1e-3, **{"gains.p": 1e-6, "velocity_source": "measured"})
    assert loop.is_stable == (times < 2.0)
    if times < 2.0:
        assert margins_of(loop).gain == pytest.approx(2.0 / times, rel=1e-3)


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


def test_a_multiplier_may_scale_gains_beyond_the_range_of_their_parameters():
    gains = Gains(400.0, 1000.0, 40.0)
    heavy = loop_settings(law="hpid", mu=-0.3, gains=gains, inertia=2.0)  # i lam^3 is 1.95e6
    assert family_margins(loop_family(heavy, (2.0, 2.0))).is_stable


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
