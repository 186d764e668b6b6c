"""What is found of a joint whose truth is known."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from harness.motions import Plant, motion, record
from rich.console import Console

from benchmarks.strange_plants import GRAVITY, PLANTS
from benchmarks.strange_plants import Motion as MovingPlant
from hpid_bench.tuning.identification.identification_report import (
    as_mapping,
    experiment_text,
    report,
)
from hpid_bench.tuning.identification.identify import Method, identify
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.identification.robot_identification import RobotIdentification
from hpid_ros.base.errors import SettingError
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.motion.generators import minimum_jerk

PID = {
    **{"joint": "arm", "law": "pid", "u_clamp_max": 21.0, "u_clamp_min": -21.0},
    **{"gains.p": 100.0, "gains.i": 330.0, "gains.d": 10.0},
}
NAMES = ("inertia", "viscous", "coulomb", "offset", "delay")


def found(*records, **options):
    return identify(records, **options)


def values(result):
    return {name: each.value for name, each in result.estimates.items()}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_without_noise_the_truth_is_found(seed):
    plant = Plant()
    (result,) = found(record(plant, seed=seed))
    assert values(result) == pytest.approx({n: getattr(plant, n) for n in NAMES}, rel=2e-3)
    assert result.explained > 0.99999
    assert not [name for name in result.unreliable if name != "gravity_sin"]


def test_a_delay_beyond_what_is_looked_through_is_not_told():
    (result,) = found(record(Plant(delay=0.05)), method=Method(longest_delay=0.03))
    assert result.unreliable["delay"] == "the best is at the end of what was looked through, 30 ms"


@pytest.mark.parametrize("delay", [-0.0005, 0.0, 0.0004, 0.0037, 0.05])
def test_a_delay_is_found_between_samples(delay):
    (result,) = found(record(Plant(delay=delay)))
    assert result.estimates["delay"].value == pytest.approx(delay, abs=2e-5)


def test_a_held_command_acts_half_a_period_later_than_a_sample():
    sampled = record(Plant(delay=0.002), np.arange(0.0, 15.0, 0.004))
    as_sample, as_command = (found(each)[0] for each in (sampled, replace(sampled, is_held=True)))
    difference = as_sample.estimates["delay"].value - as_command.estimates["delay"].value
    assert difference == pytest.approx(0.002, abs=1e-4)


def test_everything_but_the_delay_scales_with_the_efforts_and_nothing_with_the_time():
    one = record(Plant(), noise=1e-4)
    first, second, third = (
        found(each)[0]
        for each in (
            one,
            replace(one, effort=7.0 * one.effort),
            replace(one, time=one.time + 4096.0, effort_time=one.effort_time + 4096.0),
        )
    )
    for name, each in first.estimates.items():
        factor = 1.0 if name == "delay" else 7.0
        scaled = second.estimates[name]
        assert scaled.value == pytest.approx(factor * each.value, rel=1e-6)
        assert scaled.half_width == pytest.approx(factor * each.half_width, rel=1e-4)
    assert values(third) == pytest.approx(values(first), rel=1e-5)


def drag(q, v, a):
    return 0.01 * a[::-1]  # each joint drags the other


@pytest.mark.parametrize("body", [None, drag])
def test_the_order_of_joints_does_not_matter(body):
    one, two = record(Plant(), name="a"), record(Plant(inertia=0.1), name="b", seed=4)
    forward, backward = found(one, two, rigid_body=body), found(two, one, rigid_body=body)
    assert [each.joint for each in forward] == ["a", "b"]
    for k in (0, 1):
        assert values(forward[k]) == pytest.approx(values(backward[1 - k]), rel=1e-9)
    (only,) = found(one, two, rigid_body=body, wanted=["b"])
    assert values(only) == values(forward[1])


def test_who_moves_at_the_same_time_is_named():
    still = record(Plant(), name="c", amplitude=1e-4)
    one, two = record(Plant(), name="a"), record(Plant(), name="b", seed=4)
    first, _, _ = found(one, two, still)
    (remark,) = first.remarks
    assert remark.startswith("b moved at the same time")
    later = np.arange(12.0, 24.0, 2e-3)
    after = record(Plant(), later, name="b", seed=4)
    assert found(one, after)[0].remarks == ()


def test_years_between_two_samples_are_not_looked_through():
    """A clock that begins in 1970 is set when the network comes."""
    both = [record(Plant(), name=name, seed=seed) for name, seed in (("a", 1), ("b", 4))]
    late = [
        replace(
            each,
            time=np.append(each.time, 1e11),
            position=np.append(each.position, each.position[-1]),
            effort_time=np.append(each.effort_time, 1e11),
            effort=np.append(each.effort, 0.0),
        )
        for each in both
    ]
    known, jumped = found(*both), found(*late)
    assert [each.remarks for each in jumped] == [each.remarks for each in known]
    assert values(jumped[0]) == pytest.approx(values(known[0]), rel=1e-3)


@pytest.mark.parametrize("share", [1.0, -1.0, 0.0])
def test_what_spinning_rotors_pull_is_found_whichever_way_they_turn(share):
    """And no interval is of a model that lacks it."""
    plant, pull = Plant(inertia=0.3), 0.01

    def no_links(q, v, a):
        return 0.0 * a

    def spin(q, v, a, rotors):
        return pull * (rotors[:, None] * a)[::-1]  # each joint feels the other's rotor

    records = []
    for seed in (1, 4):
        own = record(plant, seed=seed, name=str(seed), noise=2e-5)
        other = motion(own.time + plant.delay, 5 - seed)[2]
        pulled = own.effort + share * pull * plant.inertia * other
        records.append(replace(own, effort=pulled))
    with_spin = found(*records, rigid_body=no_links, spin=spin)
    without = found(*records, rigid_body=no_links)
    for one, before in zip(with_spin, without, strict=True):
        assert len(one.remarks) == abs(share)
        inertia = one.estimates["inertia"]
        assert inertia.low <= plant.inertia <= inertia.high
        if share:
            told = float(one.remarks[0].partition(" is ")[2].split()[0])
            assert told == pytest.approx(share, abs=0.05)
            assert inertia.half_width < 0.6 * before.estimates["inertia"].half_width


@pytest.mark.parametrize("scale", [2.5, -2.5])
def test_efforts_in_a_unit_of_their_own_are_scaled_by_the_masses(scale):
    plant = Plant(gravity_sin=3.0, gravity_cos=1.0)
    one = record(plant, amplitude=0.5)
    currents = replace(one, effort=one.effort / scale)

    def link(q, v, a):
        return 0.2 * a + 3.0 * np.sin(q) + 1.0 * np.cos(q)  # which leaves a rotor of 0.3

    (result,) = found(currents, rigid_body=link, method=Method(has_scale=True))
    assert result.estimates["effort_scale"].value == pytest.approx(scale, rel=5e-3)
    assert any("has the other sign" in each for each in result.remarks) == (scale < 0.0)
    assert result.estimates["inertia"].value == pytest.approx(0.3, rel=2e-2)
    assert result.estimates["coulomb"].value == pytest.approx(0.6, rel=2e-2)
    (told,) = found(currents, rigid_body=link)
    assert "not 1" in told.unreliable["effort_scale"]
    assert set(told.estimates) - set(told.unreliable) == {"delay"}


def test_what_stands_on_a_doubted_scale_is_in_brackets_and_in_no_file():
    one = record(Plant(gravity_sin=3.0), amplitude=0.5)
    weak = replace(one, effort=0.8 * one.effort)

    def link(q, v, a):
        return 0.2 * a + 3.0 * np.sin(q)

    (right,), (doubted,) = found(one, rigid_body=link), found(weak, rigid_body=link)
    for result, is_told in ((right, True), (doubted, False)):
        whole = RobotIdentification((result,), {})
        console = Console(width=120, file=StringIO())
        for part in report(whole):
            console.print(part, markup=False)
        row = next(line for line in console.file.getvalue().splitlines() if "%" in line)
        assert row.count("(") == (0 if is_told else 4)  # rotor, viscous, Coulomb, load
        text = experiment_text(whole, {}, ("description", "robot.urdf"), ())
        assert ("      friction: " in text) == is_told
        assert ("efforts' scale, which is doubted" in text) != is_told
        document = as_mapping(whole)["joint"]
        assert bool(document["estimates"]["inertia"]["reason"]) != is_told
        assert ("coulomb" in document["not_told"]) != is_told


def scale_of(seed):
    """Return the effort's scale, which is 1, by a link's inertia and noisy positions."""
    one = record(Plant(gravity_sin=3.0), seed=seed, noise=2e-3, amplitude=0.5)
    own = replace(one, reference=motion(one.time, seed, 0.5)[0])

    def link(q, v, a):
        return 0.4 * a + 3.0 * np.sin(q)

    (result,) = found(own, rigid_body=link, method=Method(cutoff=8.0))
    return result.estimates["effort_scale"]


@pytest.mark.slow
def test_noise_does_not_bias_the_efforts_scale():
    """Their links' accelerations are as noisy as the rotors'."""
    scales = [scale_of(seed) for seed in range(12)]
    assert np.mean([each.value for each in scales]) == pytest.approx(1.0, abs=8e-3)
    assert sum(each.low <= 1.0 <= each.high for each in scales) >= 10


def test_noise_that_a_controller_feeds_back_does_not_bias_viscous_friction_and_delay():
    """Between rests, where the reference alone hardly tells delay from viscous friction."""
    plant = replace(PLANTS[0], noise=2e-5, counts=0)
    loop = JointLoop(LoopSettings.from_parameters(PID))
    places = [0.3, -0.2, 0.4, -0.1, 0.3]
    column = minimum_jerk([2.0 * k for k in range(5)], {"arm": places}).column("arm")
    loop.follow(column)
    aim, moving = column.start(0, places[0]), MovingPlant(plant, 1e-3, places[0], 1)
    rows = []
    for stamp in range(0, 8_000_000_000, 1_000_000):
        position, _ = moving.read()
        effort = loop.step(stamp, position)
        rows.append((stamp * 1e-9, position, effort, aim.sample(stamp).position))
        moving.step(effort)
    time, position, effort, reference = np.array(rows).T

    def link(q, v, a):
        return plant.mass * plant.length * (plant.length * a + GRAVITY * np.sin(q))

    own = JointRecord("arm", time, position, time, effort, reference)
    (result,) = found(own, rigid_body=link)
    truth = {"viscous": plant.viscous, "delay": -0.5e-3 / 20}  # half a step of the integration
    for name, value in truth.items():
        assert result.estimates[name].low <= value <= result.estimates[name].high


def test_what_says_nothing_of_a_joint_gives_a_reason_and_no_number():
    moving, times = record(Plant(), name="a"), np.arange(0.0, 12.0, 2e-3)
    chance, constant = np.random.default_rng(1), np.full(len(times), 2.0)
    jitter = chance.standard_normal(len(times))
    still = JointRecord("b", times, 0.7 + 1e-5 * jitter, times, constant)
    frozen = JointRecord("c", times, np.full(len(times), 0.7), times, constant)
    noise = JointRecord("d", times, 1e-4 * jitter, times, chance.normal(size=len(times)))
    of_another = replace(moving, effort=record(Plant(), seed=9).effort)
    short = record(Plant(), np.arange(0.0, 0.5, 1e-3))
    empty = JointRecord("joint", *(np.empty(0) for _ in range(4)))
    for records, words in (
        ([still, moving], "did not move"),
        ([frozen, moving], "did not move"),
        ([noise], ""),
        ([of_another], "explains only"),
        ([short], "longer than"),
        ([empty], ""),
    ):
        result = found(*records)[0]
        assert not result.is_found
        assert words in result.unreliable[result.joint]
        assert result.unreliable[result.joint]


def test_coulomb_friction_needs_both_directions():
    def onward(time, seed, amplitude):
        position, velocity, acceleration = motion(time, seed, amplitude)
        return position + 6.0 * np.asarray(time), velocity + 6.0, acceleration

    (result,) = found(record(Plant(), along=onward))
    assert "coulomb" not in result.estimates
    assert "one direction only" in result.unreliable["coulomb"]
    assert result.estimates["inertia"].value == pytest.approx(0.5, rel=1e-2)


def test_gravity_is_told_from_a_load_where_the_joint_moves_far():
    plant = Plant(gravity_sin=4.0, gravity_cos=-2.0, offset=0.5)
    (far,) = found(record(plant, amplitude=0.8, noise=1e-5))
    assert far.estimates["gravity_sin"].value == pytest.approx(4.0, rel=2e-2)
    assert far.estimates["gravity_cos"].value == pytest.approx(-2.0, rel=2e-2)
    (flat,) = found(record(Plant(), noise=1e-4))
    assert "gravity_sin" not in flat.estimates
    assert "constant load" in flat.unreliable["gravity_sin"]


def test_stribeck_friction_is_found_where_it_is_and_only_there():
    (creeping,) = found(record(Plant(stribeck=0.6), noise=1e-5))
    assert creeping.estimates["stribeck"].low > 0.0
    assert not [
        seed
        for seed in range(3)
        if "stribeck" in found(record(Plant(), noise=1e-4, seed=seed))[0].estimates
    ]


def test_a_drive_that_gives_less_than_it_is_asked_for_is_found():
    plant = Plant()
    acting = replace(record(plant, np.arange(0.0, 8.0, 0.004)), is_held=True)
    limit = 0.8 * float(np.abs(acting.effort).max())
    asked = np.where(np.abs(acting.effort) > limit, 2.5 * acting.effort, acting.effort)
    (plain,), (saturated,) = found(acting), found(replace(acting, effort=asked))
    assert plain.effort_limit == np.inf
    assert saturated.effort_limit == pytest.approx(limit, rel=0.1)
    assert values(saturated)["inertia"] == pytest.approx(plant.inertia, rel=0.1)


def test_gaps_uneven_stamps_and_stamps_too_close_do_little():
    chance = np.random.default_rng(3)
    times = np.sort(np.arange(0.0, 30.0, 2e-3) + chance.uniform(-5e-4, 5e-4, 15000))
    close = np.sort(np.concatenate([times, times[1000:1100] + 1e-6]))
    kept = close[(close < 9.0) | (close > 9.4)]
    (result,) = found(record(Plant(), kept, noise=1e-5))
    truth = {n: getattr(Plant(), n) for n in NAMES}
    assert values(result) == pytest.approx(truth, rel=2e-2)
    assert result.time < 30.0


@pytest.mark.slow
def test_intervals_contain_the_truth_as_often_as_they_say():
    plant = Plant()
    hits = dict.fromkeys(NAMES, 0)
    runs = 30
    for seed in range(runs):
        one = record(plant, np.arange(0.0, 8.0, 4e-3), seed=seed, noise=2e-4, effort_noise=0.3)
        (result,) = found(one)
        for name in NAMES:
            each = result.estimates[name]
            hits[name] += each.low <= getattr(plant, name) <= each.high
    # Of 30 draws at 95 %, fewer than 24 come by chance once in 5 000 times.
    assert min(hits.values()) >= 24
    assert sum(hits.values()) / (runs * len(NAMES)) < 0.995


def test_a_record_says_what_is_wrong_with_it():
    times, ones = np.arange(3.0), np.ones(3)
    for fields, words in (
        ((times, ones, times, np.ones(4)), "'a': effort has shape"),
        ((times, np.array([1.0, np.nan, 1.0]), times, ones), "must be finite"),
        ((times[::-1], ones, times, ones), "must increase strictly"),
    ):
        with pytest.raises(SettingError, match=words):
            JointRecord("a", *fields)
    with pytest.raises(SettingError, match="cutoff must be above 0"):
        Method(cutoff=-1.0)
