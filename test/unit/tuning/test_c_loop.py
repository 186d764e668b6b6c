"""The loop in C is Python's: to the last bit in double precision, closely in single."""

import math
import random
import struct
from contextlib import suppress

import pytest
from harness.c_loops import CLibrary, CLoop, parameters_by_chance, states_by_chance
from harness.examples import examples
from harness.loops import loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.tuning.export import GivenLoop, golden_vectors, in_single
from hpid_ros.base.errors import HpidError
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.norms import NORMS

SETTINGS = loop_settings(gains__p=40.0, gains__i=130.0, gains__d=4.0, mu=-0.2)
SEEDS = st.integers(0, 2**32)
MS = 1_000_000
CONFLICT = 3  # condition of a loop in C


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return CLibrary(tmp_path_factory.mktemp("double"), SETTINGS)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    return CLibrary(tmp_path_factory.mktemp("single"), SETTINGS, "single")


def bits(number):
    return struct.pack("d", number)


def settings_by_chance(chance, **others):
    """Return settings that go together."""
    while True:
        try:
            return LoopSettings.from_parameters(parameters_by_chance(chance, **others))
        except HpidError:
            continue


def both(library, settings):
    loop = CLoop(library, settings)
    assert loop.is_ready
    return GivenLoop(settings), loop


def assert_equal_answers(python, c, states):
    for count, state in enumerate(states):
        mine, other = c.step(*state), python.step(*state)
        assert bits(mine) == bits(other), (count, state)
        assert bits(c.state.integral) == bits(python.loop.law.integral), (count, state)


@given(SEEDS)
@examples(4)
def test_c_answers_every_state_as_python_to_the_last_bit(library, seed):
    chance = random.Random(seed)
    settings = settings_by_chance(chance)
    states = states_by_chance(chance, 200, settings.timing.control_period)
    assert_equal_answers(*both(library, settings), states)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("degree", [-0.45, 0.49])
def test_c_answers_the_smallest_errors_as_python(library, norm, degree):
    """There the canonical norm brings a point to unit size in two steps."""
    changes = {"mu": degree, "norm.type": norm, "norm.floor": 0.0, "takeover_time": 0.0}
    python, c = both(library, SETTINGS.with_parameters(changes))
    exponents = [-323, *range(-320, -140, 3), *range(-140, 0, 10)]
    points = [
        (sign * 10.0**position, 10.0**velocity)
        for position in exponents
        for velocity in (-330, position, -150)
        for sign in (1.0, -1.0)
    ]
    assert_equal_answers(python, c, [(k * MS, 0.0, 0.0, *at) for k, at in enumerate(points)])
    assert python.loop.counts.samples == len(points)


@given(SEEDS)
@examples(4)
def test_whatever_comes_between_two_states_c_answers_as_python_to_the_last_bit(library, seed):
    """Settings, others or the same, another effort and a reset, also within a gap or a jump."""
    chance = random.Random(seed)
    settings = settings_by_chance(chance, control_period=0.001)
    python, c = both(library, settings)
    for state in states_by_chance(chance, 300, 0.001):
        if chance.random() < 0.05:
            if chance.random() < 0.7:
                settings = settings_by_chance(chance, control_period=0.001)
            python.loop.retune(settings)
            assert c.retune(settings)
            assert bits(c.state.effort) == bits(python.loop.law.effort), state
        elif chance.random() < 0.03:
            effort = chance.choice((chance.gauss(0.0, 10.0), math.nan, math.inf))
            python.loop.supersede(effort)
            c.supersede(effort)
        elif chance.random() < 0.01:
            python.loop.reset()
            c.reset()
        assert_equal_answers(python, c, [state])


@given(SEEDS)
@examples(4)
def test_c_recognises_two_sources_of_states_as_python_to_the_last_bit(library, seed):
    """Their rates, places and clocks by chance, one of them for a while."""
    chance = random.Random(seed)
    turn = chance.choice((0.0, math.tau))
    others = {"control_period": 0.001, "position_step_max": 0.0, "encoder_wrap": turn}
    settings = settings_by_chance(chance, **others)
    python, c = both(library, settings)
    apart = chance.choice((0.004, 0.012, 0.1, 1.0, math.tau))
    every, offset_ns = chance.randint(1, 20), chance.choice((0, 0, 1000, -(10**9), 10**12))
    conflicts = 0
    for k in range(2500):
        stamp_ns, position = k * MS, 0.1 * math.sin(0.01 * k) + chance.gauss(0.0, 1e-4)
        states = [(stamp_ns, 0.2, 0.0, position, None)]
        if 500 < k < 1500 and k % every == 0:
            states.append((stamp_ns + offset_ns, 0.2, 0.0, position + apart, 0.0))
        assert_equal_answers(python, c, states)
        is_conflict = python.loop.state.mode is LoopMode.CONFLICT
        assert (c.state.condition == CONFLICT) == is_conflict
        conflicts += is_conflict
    assert conflicts > 1000 or apart in (0.004, 0.012, math.tau)
    assert python.loop.state.mode is not LoopMode.CONFLICT


@given(SEEDS)
@examples(4)
def test_c_accepts_the_settings_that_python_accepts(library, seed):
    values = parameters_by_chance(random.Random(seed))
    try:
        settings = LoopSettings.from_parameters(values)
    except HpidError:
        settings = None
    everything = {name: spec.default for name, spec in LOOP_PARAMETERS.items()} | values
    told = library.of_values(everything)
    state = library.state_type()
    assert library.call("init", state, told) == (settings is not None), values


@pytest.mark.parametrize("position", [1e9, -1e9])
def test_a_position_that_is_no_joints_once_its_turns_are_added_is_a_fault(library, position):
    settings = settings_by_chance(random.Random(1), encoder_wrap=1.0, velocity_source="filtered")
    python, c = both(library, settings)
    turns = [math.copysign(0.1 * k % 1.0, position) for k in range(40)]
    states = [(k * MS, 0.0, 0.0, each, None) for k, each in enumerate([*turns, 0.1])]
    far = [(10**12 + k * MS, 0.0, 0.0, position, None) for k in range(3)]
    assert_equal_answers(python, c, [*states, *far, (10**12 + 3 * MS, 0.0, 0.0, 0.1, None)])
    assert python.loop.counts.rejected == 3  # with the first after the gap


@pytest.mark.parametrize(
    "changes",
    [
        {"gains.p": -1.0},
        {"gains.p": math.nan},
        {"mu": 0.5},
        {"mu": math.nan},
        {"norm.floor": 2e6},
        {"norm.error_scale": 0.0},
        {"norm.effort_scale": 1.0, "norm.error_scale": 0.5},
        {"norm.effort_scale": 1.0, "gains.d": 0.0},
        {"norm.effort_scale": 1e-300, "norm.type": "canonical"},
        {"norm.effort_scale": 5e-324, "norm.type": "weighted"},
        {"encoder_wrap": 5e-324},
        {"u_clamp_min": 1.0, "u_clamp_max": 0.0},
        {"state_timeout": 0.001},
        {"discretization": "semi_implicit"},
        {"inertia": 10.0},
        {"angle_wraparound": True, "position_max": 1.0},
    ],
    ids=str,
)
def test_what_is_refused_leaves_the_loop_as_it_was(library, changes):
    values = {**SETTINGS.to_parameters(), **changes}
    with pytest.raises(HpidError):
        LoopSettings.from_parameters(values)
    python, c = both(library, SETTINGS)
    states = [(k * MS, 0.3, 0.0, 0.001 * k, 1.0) for k in range(20)]
    assert_equal_answers(python, c, states[:10])
    assert not library.call("retune", c.state, library.of_values(values))
    assert_equal_answers(python, c, states[10:])
    fresh = library.state_type()
    assert not library.call("init", fresh, library.of_values(values))


def test_nothing_spoils_the_loop_in_c(library):
    assert bytes(library.exported()) == bytes(library.of_python(SETTINGS))
    c = CLoop(library, SETTINGS)
    for stamp in range(5):
        c.step(stamp * MS, 0.0, 0.0, 0.0, 0.0)
    c.supersede(math.nan)
    assert c.step(5 * MS, 0.0, 0.0, 0.0, 0.0) == 0.0
    assert c.state.integral == 0.0
    for stamp in (-(2**63), 2**63 - 1, -(2**63), 0):  # no difference overflows
        assert math.isfinite(c.step(stamp, 0.1, 0.0, 0.0, 0.0))
    refused = library.of_python(SETTINGS)
    refused.mu = 1.0
    library.call("init", c.state, refused)
    assert c.step(0, 1.0, 0.0, 0.0, 0.0) == c.step(MS, 1.0, 0.0, 0.0, 0.0) == 0.0


@given(SEEDS)
def test_single_precision_deviates_by_no_more_than_the_golden_vectors_allow(single, seed):
    chance = random.Random(seed)
    while True:
        settings = settings_by_chance(chance)
        with suppress(HpidError):
            in_single(settings)
            break
    golden, c = golden_vectors(settings), CLoop(single, settings)
    assert c.is_ready
    for row, state in enumerate(golden.rows):
        if row == golden.retune_at:
            assert c.set_gains(golden.retuned.gains)
            assert c.set_degree(golden.retuned.mu)
        assert abs(c.step(*state[:-1]) - state.effort) <= golden.single_tolerance, row
