"""One sender of joint states stays one, whatever it sends; two are two."""

import time

import numpy as np
import pytest
from harness.bags import JOINT_STATE, S
from harness.foreign_bags import write
from harness.senders import T0, joint_state, one_sender, two_senders

from hpid_ros.messages.reading.senders import find_senders
from hpid_ros.messages.selection import BagSelection
from hpid_ros.metrics import Measuring, measure

COUNT = 1000
K = np.arange(COUNT)
T = K / 100
WAVE, EFFORT = 0.8 * np.sin(T), 3.0 * np.cos(T) + 0.1 * np.sin(50.0 * T)


def measured(path, messages):
    """Return what is measured of states: stamps in [ns] and bytes, received 0.2 ms later."""
    log = [("/joint_states", int(T0 + log_ns), raw) for log_ns, raw in messages]
    bag = write(path / "bag", {"/joint_states": JOINT_STATE}, log)
    return measure(bag, how=Measuring(BagSelection(reference="hold")))


def of_j1(positions, efforts):
    for k in range(COUNT):
        stamp_ns = k * S // 100
        raw = joint_state(T0 + stamp_ns, ["j1"], [positions[k]], (), [efforts[k]])
        yield stamp_ns + 200_000, raw


def trapezoid(t, y):
    return float(np.sum(np.diff(t) * (y[1:] + y[:-1])) / 2.0)


def require(found, joint, t, positions, efforts):
    """Require the indices of all states of one sender, and no word of several."""
    assert not any("senders" in line for line in found.defects)
    error, indices = np.abs(positions - positions[0]), found.run.joints[joint]
    assert indices["ivc"] == pytest.approx(np.abs(np.diff(efforts)).sum(), rel=1e-12)
    assert indices["itae"] == pytest.approx(trapezoid(t, t * error), rel=1e-9)
    assert indices["iavc"] == pytest.approx(trapezoid(t, np.abs(efforts)), rel=1e-9)


CHATTER = {
    "against a limit": np.where(K % 2, -9.5 + 0.4 * np.sin(T), 10.0),
    "measured every other cycle": np.where(K % 2, 0.0, EFFORT),
    "measured every third cycle": np.where(K % 3, 0.0, EFFORT),
    "half the rate": EFFORT + 5.0 * np.cos(np.pi * K + 0.3),
}


@pytest.mark.parametrize("kind", CHATTER)
def test_a_chattering_effort_is_measured_and_not_thrown_away(tmp_path, kind):
    found = measured(tmp_path, of_j1(WAVE, CHATTER[kind]))
    require(found, "j1", T, WAVE, CHATTER[kind])
    does_stand = kind in ("against a limit", "measured every other cycle")
    assert does_stand == any("every other effort" in line for line in found.defects)


@pytest.mark.parametrize("share", [1 / 2, 1 / 3, 1 / 4])
def test_a_limit_cycle_at_a_part_of_the_states_rate_is_one_senders(tmp_path, share):
    phase = 2.0 * np.pi * share * K + 0.7
    swinging, efforts = WAVE + 0.05 * np.sin(phase), 5.0 * np.cos(phase)
    found = measured(tmp_path, of_j1(swinging, efforts))
    require(found, "j1", T, swinging, efforts)
    if share == 1 / 2:
        assert any("positions come back" in line for line in found.defects)


def test_positions_that_no_joint_can_reach_in_turn_are_of_two_senders(tmp_path):
    positions = np.where(K % 2, 0.0, 0.5 + WAVE)  # joint_state_publisher beside a driver
    found = measured(tmp_path, of_j1(positions, EFFORT))
    assert any("states of 2 senders" in line for line in found.defects)


def gripper(k):
    return (["j1", "g"] if k // 100 % 2 else ["j1"]), ()


def velocity(k):
    return ["j1"], ([0.1] if k // 100 % 2 else [])


def order(k):
    return (["j1", "g"] if k // 200 % 2 else ["g", "j1"]), ()


def shuffle(k):
    return list(np.random.default_rng(k).permutation(["j1", "g", "h"])), ()


def any_field(k):
    return ["j1"], ([0.1] if np.random.default_rng(k).random() < 0.5 else [])


@pytest.mark.parametrize("layout", [gripper, velocity, order, shuffle, any_field])
@pytest.mark.parametrize("effort", ["smooth", "chatter"])
def test_one_sender_whose_layout_changes_is_one(tmp_path, layout, effort):
    efforts = EFFORT if effort == "smooth" else CHATTER["against a limit"]
    log = []
    for k in range(COUNT):
        names, velocities = layout(k)
        positions, some = ([x if n == "j1" else 0.0 for n in names] for x in (WAVE[k], efforts[k]))
        stamp_ns = k * S // 100
        raw = joint_state(T0 + stamp_ns, names, positions, velocities, some)
        log.append((stamp_ns + 200_000, raw))
    require(measured(tmp_path, log), "j1", T, WAVE, efforts)


def test_names_in_any_order_take_time_in_proportion(tmp_path):
    count, random = 600, np.random.default_rng(1)
    names = np.array([f"joint_{number:02d}" for number in range(30)])
    wave = np.sin(np.arange(count) / 100)[:, None] * np.arange(30)
    log = []
    for k in range(count):
        order = random.permutation(30)
        some = wave[k][order]
        raw = joint_state(T0 + k * S // 100, names[order], some, (), some)
        log.append((k * S // 100 + 200_000, raw))
    begin = time.process_time()
    found = measured(tmp_path, log)
    assert time.process_time() - begin < 5.0  # was 40 s
    for number in (1, 7, 29):
        require(
            found, f"joint_{number:02d}", np.arange(count) / 100, wave[:, number], wave[:, number]
        )


@pytest.mark.parametrize(("step", "text"), [(S, "1 s"), (S // 20, "0.05 s")])
def test_stamps_that_are_coarse_are_no_sign_of_several_senders(tmp_path, step, text):
    log = []
    for k in range(COUNT):
        stamp_ns = k * S // 100
        raw = joint_state(T0 + stamp_ns // step * step, ["j1"], [WAVE[k]], (), [EFFORT[k]])
        log.append((stamp_ns + 200_000, raw))
    found = measured(tmp_path, log)
    require(found, "j1", T, WAVE, EFFORT)
    (line,) = [each for each in found.defects if "in steps of" in each]
    assert f"/joint_states come in steps of {text}" in line
    assert "receive times are taken" in line


def test_coarse_stamps_on_another_clock_stand_and_are_named(tmp_path):
    """A simulation at half the speed, whose clock ticks every 50 ms."""
    log = []
    for k in range(COUNT):
        raw = joint_state(k * S // 100 // 50_000_000 * 50_000_000 + S, ["j1"], [WAVE[k]])
        log.append((k * S // 50, raw))
    found = measured(tmp_path, log)
    assert not any("senders" in line for line in found.defects)
    assert any(
        "in steps of 0.05 s" in x and "--clock receive takes all" in x for x in found.defects
    )


def test_states_that_are_sent_twice_keep_their_stamps(tmp_path):
    log = []
    for k in range(COUNT):
        first = k // 2 * 2
        raw = joint_state(T0 + first * S // 100, ["j1"], [WAVE[first]], (), [EFFORT[first]])
        log.append((k * S // 100 + 200_000, raw))
    found = measured(tmp_path, log)
    require(found, "j1", T[::2], WAVE[::2], EFFORT[::2])
    assert not any("in steps of" in line for line in found.defects)


def test_one_sender_is_one_however_it_keeps_time():
    several = [seed for seed in range(150) if find_senders(one_sender(seed)) is not None]
    assert len(several) <= 1, several


def test_two_senders_with_motions_of_their_own_are_two():
    missed = []
    for seed in range(100):
        parts, counts = two_senders(seed)
        found = find_senders(parts)
        left = 0 if found is None else len(found.left_out)
        if not any(abs(left - count) <= max(3, 0.1 * count) for count in counts):
            missed.append(seed)
    assert len(missed) <= 1, missed
