"""Efforts on several topics and without numbers, stamps of zero, of other clocks, set back."""

import numpy as np
import pytest
from harness.bags import JOINT_STATE, JOINT_TRAJECTORY, S, ramp, trajectory
from harness.recordings import (
    CONTROLLER_STATE,
    STORE,
    T0,
    header,
    integral,
    itae,
    j1,
    joint_state,
    made,
    states,
    write,
)

from hpid_ros.messages.columns import JointSamples
from hpid_ros.messages.reading.clocks import ahead_ns, set_backs

T = np.arange(1000) / 100
WAVE, LATE = 0.8 * np.sin(T), 0.8 * np.sin(T - 0.01)
EFFORT = 3.0 * np.cos(T) + 0.1 * np.sin(50.0 * T)
IVC = float(np.abs(np.diff(EFFORT)).sum())
IAVC = integral(T, np.abs(EFFORT))
ITAE = itae(T, WAVE - LATE)
ARM, HAND = "/arm/controller_state", "/hand/controller_state"
STATES, COMMANDS = "/joint_states", "/joint_commands"


def output(stamp_ns, efforts, reference=0.0, names=("j1",)):
    """Return what a trajectory controller with an effort interface reports."""
    none, time = np.zeros(0), STORE.types["builtin_interfaces/msg/Duration"](0, 0)
    point = STORE.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    multi = STORE.types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]([], [], [], time)
    points = [point(np.full(len(names), reference), none, none, none, time)]
    points += [point(none, none, none, none, time)] * 2
    points += [point(none, none, none, np.array(efforts, float), time)]
    return made(CONTROLLER_STATE, header(stamp_ns), list(names), *points, [], *[multi] * 4, 1.0)


def outputs(topic, which, efforts=EFFORT):
    stamps_ns = [T0 + int(k) * S // 100 for k in which]
    return [
        (topic, at + 3e5, output(at, [efforts[k]], WAVE[k]))
        for k, at in zip(which, stamps_ns, strict=True)
    ]


def commands(which, efforts=EFFORT, name="j1"):
    stamps_ns = [T0 + int(k) * S // 100 for k in which]
    return [
        (COMMANDS, at + 4e5, joint_state(at, [name], (), (), [efforts[k]]))
        for k, at in zip(which, stamps_ns, strict=True)
    ]


def bag_of(path, log):
    kinds = {
        topic: CONTROLLER_STATE if "controller" in topic else JOINT_STATE for topic, *_ in log
    }
    return write(path, kinds, log)


def efforts_of(found, joint="j1"):
    return [found.run.joints[joint][key] for key in ("ivc", "iavc")]


# Efforts in turn -------------------------------------------------------------------------------

EVERY = np.arange(1000)
MIDDLE = (EVERY >= 300) & (EVERY < 700)
BLINK = (EVERY % 100 >= 40) & (EVERY % 100 < 70)


@pytest.mark.parametrize("of_hand", [MIDDLE, ~MIDDLE, EVERY >= 500, EVERY < 500, BLINK])
def test_efforts_of_two_controllers_in_turn_are_one_sequence(tmp_path, of_hand):
    log = states(LATE, np.zeros(1000))
    log += outputs(ARM, EVERY[~of_hand]) + outputs(HAND, EVERY[of_hand])
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert not found.defects


@pytest.mark.parametrize("of_report", [EVERY >= 500, EVERY < 500, MIDDLE])
def test_commands_and_what_a_controller_reports_in_turn_are_one_sequence(tmp_path, of_report):
    log = states(LATE) + commands(EVERY[~of_report]) + outputs(ARM, EVERY[of_report])
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)


def test_two_controllers_that_hand_over_with_two_samples_of_both_are_in_turn(tmp_path):
    log = states(LATE) + outputs(ARM, EVERY[:502]) + outputs(HAND, EVERY[500:], EFFORT + 0.0)
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert not any("unlike" in line for line in found.defects)


def test_of_topics_with_unlike_efforts_at_once_the_first_counts_and_both_are_named(tmp_path):
    lossy = EVERY[EVERY % 50 != 7]
    log = states(LATE) + outputs(ARM, lossy) + outputs(HAND, EVERY, -5.0 - EFFORT)
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found)[0] == pytest.approx(np.abs(np.diff(EFFORT[lossy])).sum(), rel=1e-12)
    (line,) = [each for each in found.defects if "unlike efforts" in each]
    assert f"{ARM} and {HAND} have unlike efforts of j1 at the same time (by up to 11" in line
    assert f"{ARM} is taken, {HAND} is left out" in line


def test_what_a_report_repeats_of_the_commands_changes_nothing(tmp_path):
    log = states(LATE) + commands(EVERY)
    alone = j1(bag_of(tmp_path / "one", log)).run.joints["j1"]
    found = j1(bag_of(tmp_path / "both", log + outputs(ARM, EVERY)))
    assert efforts_of(found) == [alone["ivc"], alone["iavc"]]
    assert not any("unlike" in line for line in found.defects)


# Efforts that are no numbers -------------------------------------------------------------------


@pytest.mark.parametrize("topic", [ARM, COMMANDS])
def test_efforts_that_are_not_a_number_leave_those_that_were_measured(tmp_path, topic):
    nothing = np.full(1000, np.nan)
    log = states(LATE, EFFORT)
    log += outputs(ARM, EVERY, nothing) if topic == ARM else commands(EVERY, nothing)
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert any(
        f"the efforts of j1 on {topic} are not a number throughout: those that {STATES} measured "
        "are read" in line
        for line in found.defects
    )


def two(joints, efforts, measured):
    """Return states of two joints, and what one controller reports of both."""
    log = []
    for k in range(1000):
        at = T0 + k * S // 100
        raw = joint_state(at, joints, [LATE[k]] * 2, (), [each[k] for each in measured])
        log.append((STATES, at + 2e5, raw))
        raw = output(at, [each[k] for each in efforts], WAVE[k], joints)
        log.append((ARM, at + 3e5, raw))
    return log


def test_one_joint_without_numbers_takes_its_own_measured_efforts(tmp_path):
    nothing = np.full(1000, np.nan)
    log = two(["j1", "g"], [EFFORT, nothing], [0.1 * EFFORT, 2.0 * EFFORT])
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert efforts_of(found, "g") == pytest.approx([2.0 * IVC, 2.0 * IAVC], rel=1e-12)
    assert any("the efforts of g on" in line for line in found.defects)
    assert list(found.run.assumed.values()) == ["measured, of /joint_states (g)"]


def test_one_joint_without_numbers_takes_another_topic_before_measured_ones(tmp_path):
    nothing = np.full(1000, np.nan)
    log = two(["j1", "g"], [EFFORT, 2.0 * EFFORT], [0.1 * EFFORT] * 2)
    log += [each for k in range(1) for each in commands(EVERY, nothing, "g")]
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found, "g") == pytest.approx([2.0 * IVC, 2.0 * IAVC], rel=1e-12)
    assert any(
        f"g on {COMMANDS} are not a number throughout: those of {ARM} are taken" in line
        for line in found.defects
    )


def test_one_joint_without_any_efforts_has_none_and_says_why(tmp_path):
    nothing = np.full(1000, np.nan)
    log = two(["j1", "g"], [EFFORT, nothing], [nothing, nothing])
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert "ivc" not in found.run.joints["g"]
    assert "not a number throughout" in str(found.run.lacking["g"])


def test_a_joint_whose_positions_are_not_a_number_is_left_out_alone(tmp_path):
    log = []
    for k in range(1000):
        at = T0 + k * S // 100
        raw = joint_state(at, ["j1", "g"], [LATE[k], np.nan], (), [EFFORT[k], 0.0])
        log.append((STATES, at + 2e5, raw))
    found = j1(bag_of(tmp_path / "bag", log), reference="hold")
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert any("joint 'g' is left out: no position of it is a number" in x for x in found.defects)


# Stamps of zero --------------------------------------------------------------------------------


def stamped(stamps_ns, log_times_ns=None, references=True, efforts=True):
    """Return states and reports of the wave with some stamps, received 0.2 and 0.3 ms later."""
    log = []
    for k, stamp_ns in enumerate(stamps_ns):
        at = T0 + k * S // 100 if log_times_ns is None else log_times_ns[k]
        raw = joint_state(stamp_ns, ["j1"], [LATE[k]], (), [EFFORT[k]] if efforts else ())
        log.append((STATES, at + 2e5, raw))
        if references:
            log.append((ARM, at + 3e5, output(stamp_ns, [], WAVE[k], ["j1"])))
    return log


def rest(first):
    """Return the true indices from one state on."""
    t, e = T[first:] - T[first], (WAVE - LATE)[first:]
    u = EFFORT[first:]
    return [np.abs(np.diff(u)).sum(), integral(t, np.abs(u)), itae(t, e)]


@pytest.mark.parametrize("begin", [T0, 12 * S, S // 2])
@pytest.mark.parametrize("count", [1, 3, 50])
def test_messages_without_a_stamp_before_stamped_ones_are_left_out(tmp_path, begin, count):
    stamps = [0 if k < count else begin + k * S // 100 for k in range(1000)]
    found = j1(bag_of(tmp_path / "bag", stamped(stamps)))
    got = [found.run.joints["j1"][key] for key in ("ivc", "iavc", "itae")]
    assert got == pytest.approx(rest(count), rel=1e-9)
    messages = "1 message" if count == 1 else f"{count} messages"
    for topic in (STATES, ARM):
        assert any(f"{messages} on {topic} left out" in line for line in found.defects)


def test_commands_without_a_stamp_among_stamped_ones_are_left_out(tmp_path):
    log = states(LATE) + commands(EVERY)
    log.append((COMMANDS, T0 + 4 * S + 1, joint_state(0, ["j1"], (), (), [77.0])))
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert any(f"1 message on {COMMANDS} left out" in line for line in found.defects)


def test_simulated_time_begins_at_zero(tmp_path):
    found = j1(bag_of(tmp_path / "bag", stamped([k * S // 100 for k in range(1000)])))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert found.run.joints["j1"]["itae"] == pytest.approx(ITAE, rel=1e-12)
    assert not any("left out" in line for line in found.defects)


# Two clocks ------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead", [0.4, -0.4])
@pytest.mark.parametrize("topic", [ARM, COMMANDS])
def test_stamps_of_another_clock_are_named(tmp_path, topic, ahead):
    log = states(LATE, None if topic == COMMANDS else EFFORT)
    for k, at in enumerate(T0 + EVERY * S // 100):
        stamp_ns = at + round(ahead * S)
        raw = joint_state(stamp_ns, ["j1"], (), (), [EFFORT[k]])
        log.append((topic, at + 3e5, output(stamp_ns, [], WAVE[k]) if topic == ARM else raw))
    bag = bag_of(tmp_path / "bag", log)
    how = "later" if ahead > 0 else "earlier"
    line = f"{topic} is stamped 0.4 s {how} than {STATES}, against the times at which both"
    assert any(line in each for each in j1(bag, reference="auto").defects)
    received = j1(bag, clock="receive")
    assert not any("is stamped" in each for each in received.defects)
    if topic == ARM:
        assert received.run.joints["j1"]["itae"] == pytest.approx(ITAE, rel=0.05)


def test_what_is_late_in_bunches_slow_or_on_a_slow_clock_is_of_one_clock(tmp_path):
    """A recorder that gets 0.5 s at once; a controller that reports at 5 Hz; half real time."""
    stamps = T0 + EVERY * S // 100
    log_times = {
        "of reports": T0 + (1 + EVERY // 50) * S // 2 + EVERY,
        "slow clock": T0 + EVERY * S // 50,
    }
    for name, logged in log_times.items():
        log = []
        for k, at in enumerate(stamps.tolist()):
            state = joint_state(at, ["j1"], [LATE[k]], (), [EFFORT[k]])
            log.append((STATES, (logged[k] if name == "slow clock" else at) + 2e5, state))
            if k % 20 == 3 or name == "of reports":
                log.append((ARM, int(logged[k]) + 3e5, output(at, [], WAVE[k])))
        found = j1(bag_of(tmp_path / name, log))
        assert not any("is stamped" in line for line in found.defects), name


@pytest.mark.parametrize(("ahead", "is_named"), [(-0.3, True), (0.3, False), (-0.005, False)])
def test_a_trajectory_that_came_after_it_was_to_begin_is_named(tmp_path, ahead, is_named):
    plan = ramp("j1", stamp_ns=T0 + S + round(ahead * S), t0=0.0, t4=1.0)
    _, at, raw = trajectory(T0 + S, plan)
    log = [*states(np.clip((T - 1.0) / 4.0, 0.0, 1.0), EFFORT), ("/arm/joint_trajectory", at, raw)]
    kinds = {STATES: JOINT_STATE, "/arm/joint_trajectory": JOINT_TRAJECTORY}
    found = j1(write(tmp_path / "bag", kinds, log))
    line = "/arm/joint_trajectory is stamped 0.3 s before it was received"
    assert any(line in each for each in found.defects) == is_named


# A clock that was set back ---------------------------------------------------------------------


@pytest.mark.parametrize("back", [0.0834, 0.2034, 0.5, 0.95])
@pytest.mark.parametrize("separates", [False, True])
def test_a_clock_that_was_set_back_goes_on(tmp_path, back, separates):
    stamps = [T0 + k * S // 100 - (round(back * S) if k >= 500 else 0) for k in range(1000)]
    logged = [T0 + k * S // 100 for k in range(1000)]
    found = j1(bag_of(tmp_path / "bag", stamped(stamps, logged)), separates_runs=separates)
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-9)
    assert found.run.joints["j1"]["itae"] == pytest.approx(ITAE, rel=1e-9)
    line = f"the clock of {STATES} was set back by {back:.3g} s at 5.000 s"
    assert any(line in each for each in found.defects)
    assert not any("out of order" in each for each in found.defects)


def test_a_clock_that_was_set_back_twice_with_commands_and_slow_reports(tmp_path):
    def clock(at):
        return at - 150_000_000 * (at >= T0 + 3 * S) - 420_000_000 * (at >= T0 + 7 * S)

    log = []
    for k, at in enumerate((T0 + EVERY * S // 100).tolist()):
        log.append((STATES, at + 2e5, joint_state(clock(at), ["j1"], [LATE[k]])))
        raw = joint_state(clock(at), ["j1"], (), (), [EFFORT[k]])
        log.append((COMMANDS, at + 4e5, raw))
        if k % 10 == 0:  # linear between two of them
            log.append((ARM, at + 3e5, output(clock(at), [], T[k])))
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-9)
    assert found.run.joints["j1"]["error_max"] == pytest.approx(np.abs(T - LATE).max(), rel=0.02)
    assert sum("was set back" in line for line in found.defects) == 2


def test_a_clock_of_another_machine_stays_where_it_was(tmp_path):
    log = []
    for k, at in enumerate((T0 + EVERY * S // 100).tolist()):
        stamp_ns = at - 200_000_000 * (k >= 500)
        log.append((STATES, at + 2e5, joint_state(stamp_ns, ["j1"], [LATE[k]], (), [EFFORT[k]])))
        log.append((ARM, at + 3e5, output(at, [], WAVE[k])))
    found = j1(bag_of(tmp_path / "bag", log))
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-9)
    assert found.run.joints["j1"]["itae"] == pytest.approx(ITAE, rel=1e-9)


@pytest.mark.parametrize("kind", ["late one", "bunches", "bunches of three"])
def test_messages_that_come_late_are_of_a_clock_that_was_not_set_back(tmp_path, kind):
    order = EVERY.copy()
    if kind == "late one":
        order[300:331] = [*range(301, 331), 300]
    elif kind == "bunches":
        order[300:340] = [*range(320, 340), *range(300, 320)]
    else:
        order[300:345] = [*range(330, 345), *range(300, 330)]
    log = []
    for place, k in enumerate(order.tolist()):
        raw = joint_state(T0 + k * S // 100, ["j1"], [LATE[k]], (), [EFFORT[k]])
        log.append((STATES, T0 + place * S // 100, raw))
    found = j1(bag_of(tmp_path / "bag", log), reference="hold")
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-9)
    assert not any("set back" in line for line in found.defects)


# Several topics of states ----------------------------------------------------------------------


def test_other_topics_of_states_are_named_with_rate_and_efforts(tmp_path):
    """A driver at 100 Hz with efforts, and joint_state_publisher at 33 Hz without."""
    log = [("/franka/joint_states", at, raw) for _, at, raw in states(LATE, EFFORT)]
    for k, at in enumerate((T0 + EVERY * S // 100).tolist()):
        log.append((ARM, at + 3e5, output(at, [], WAVE[k])))
        if k % 3 == 1:
            raw = joint_state(at + 5_000_000, ["j1", "finger"], [LATE[k], 0.0])
            log.append((STATES, at + 55e5, raw))
    bag = bag_of(tmp_path / "bag", log)
    found = j1(bag)
    assert any(
        "/franka/joint_states (100 Hz, with efforts) has states of j1, too: /joint_states (33.3 "
        "Hz, without efforts) is read (--states /franka/joint_states takes the other)" in line
        for line in found.defects
    )
    (reason,) = found.run.lacking["j1"].values()
    assert "/franka/joint_states has some (--states)" in reason
    named = j1(bag, states="/franka/joint_states")
    assert efforts_of(named) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert not any("joint_states (" in line for line in named.defects)


def test_states_of_other_joints_are_not_named(tmp_path):
    log = states(LATE, EFFORT)
    for at in (T0 + EVERY * S // 100).tolist():
        log.append(("/hand/joint_states", at + 1e5, joint_state(at, ["finger"], [0.0])))
    found = j1(bag_of(tmp_path / "bag", log), reference="hold")
    assert efforts_of(found) == pytest.approx([IVC, IAVC], rel=1e-12)
    assert not any("/hand/joint_states" in line for line in found.defects)


def test_reports_beside_other_states_of_the_same_joints_are_named(tmp_path):
    """The union of what two drivers say, which both have controllers in their namespaces."""
    log = []
    for k, at in enumerate((T0 + EVERY * S // 100).tolist()):
        sides = ("/left", ["l"]), ("/right", ["r"]), ("", ["l", "r"])
        for space, names in sides:
            count = len(names)
            raw = joint_state(at, names, [LATE[k]] * count, (), [EFFORT[k]] * count)
            log.append((f"{space}/joint_states", at + 2e5, raw))
            if space:
                raw = output(at, [], WAVE[k], names)
                log.append((f"{space}/arm/controller_state", at + 3e5, raw))
    bag = bag_of(tmp_path / "bag", log)
    lines = [each for each in j1(bag).defects if "takes the other" in each]
    assert len(lines) == 2
    assert lines[0].endswith("what is beside them is not read: /left/arm/controller_state")
    found = j1(bag, states=("/left/joint_states", "/right/joint_states"))
    for joint in ("l", "r"):
        assert found.run.joints[joint]["itae"] == pytest.approx(ITAE, rel=1e-12)


@pytest.mark.parametrize("seed", range(60))
def test_clocks_that_were_set_back_are_told_from_disorder(seed):
    """Jitter, losses, bunches of 0.1 s, late messages, and delays of up to many periods."""
    random = np.random.default_rng(seed)
    rate, count = int(random.choice([50, 100, 250, 1000])), 5000
    period = S // rate
    times = T0 + np.arange(count) * period
    stamps = times + (random.normal(0.0, 0.1, count) * period).astype(np.int64)
    logged = times + (random.exponential(random.choice([1e-4, 4e-3]), count) * S).astype(np.int64)
    if seed % 3 == 1:
        logged = (logged // (S // 10) + 1) * (S // 10) + np.arange(count)
    if seed % 3 == 2:
        is_late = random.random(count) < 0.02
        logged = np.where(is_late, logged + random.integers(1, 30 * period, count), logged)
    order = np.argsort(logged, kind="stable")
    order = order[random.random(count) > 0.03]

    def found(stamps_ns):
        none = np.zeros(len(order))
        samples = JointSamples(stamps_ns[order], logged[order], np.arange(len(order)), none)
        return set_backs(samples)

    assert not found(stamps)
    back = random.uniform(0.15, 0.9)
    if seed % 3 != 2:
        (one,) = found(stamps - np.where(np.arange(count) < 2500, 0, int(back * S)))
        assert one.by_ns == pytest.approx(back * S, abs=max(4 * period, 20_000_000))


@pytest.mark.parametrize("seed", range(60))
def test_topics_of_one_clock_are_not_said_to_be_apart(seed):
    """Other rates, another part of the time, bunches of 0.5 s, and another speed of the clock."""
    random = np.random.default_rng(seed)

    def topic(rate, begin, end, is_bunched, speed, ahead=0):
        at = T0 + (np.arange(begin, end, 1.0 / rate) * S).astype(np.int64)
        logged = T0 + ((at - T0) * speed).astype(np.int64)
        logged += (random.exponential(2e-3, len(at)) * S).astype(np.int64)
        if is_bunched:
            logged = (logged // (S // 2) + 1) * (S // 2) + np.arange(len(at))
        order = np.argsort(logged, kind="stable")
        return JointSamples(
            at[order] + ahead, logged[order], np.arange(len(at)), np.zeros(len(at))
        )

    speed = float(random.choice([1.0, 1.0, 0.5, 3.0]))
    begin = float(random.uniform(0.0, 15.0))
    rate, bunched = float(random.choice([5, 20, 100, 1000])), random.random(2) < 0.3
    states_ = topic(100.0, 0.0, 20.0, bunched[0], speed)
    other = begin, begin + random.uniform(2.0, 5.0), bunched[1]
    assert ahead_ns(topic(rate, *other, speed), states_) == 0
    if not bunched.any():
        for ahead in (0.3, -0.3):
            apart = ahead_ns(topic(rate, *other, speed, round(ahead * S)), states_)
            assert apart == pytest.approx(ahead * S, rel=0.2 if speed == 1.0 else 3.0)
