"""Recordings as people have them: several candidates, controllers, senders, turns, starts."""

import json
import math

import numpy as np
import pytest
from harness.bags import (
    FLOATS,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MS,
    S,
    floats,
    ramp,
    serialised,
    small_log,
    trajectory,
    write_bag,
)
from harness.recordings import (
    CONTROLLER_STATE,
    DOFS,
    PID_STATE,
    STORE,
    STRING,
    T0,
    header,
    integral,
    itae,
    j1,
    joint_state,
    made,
    pid_report,
    reports,
    states,
    write,
)
from rosbags.typesys import get_types_from_msg

from hpid_bench.cli.main import main
from hpid_ros.base.errors import SettingError
from hpid_ros.messages.reading.senders import Part, find_senders
from hpid_ros.metrics import Measuring, measure
from hpid_ros.metrics.measure import compare, measure_all

URDF = """<robot name="r"><link name="base"/><link name="arm"/><joint name="j1" type="{}">
<parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit effort="10" velocity="5" lower="-3" upper="3"/></joint></robot>"""

T = np.arange(1000) / 100
WAVE, LATE = 0.5 * np.sin(T), 0.5 * np.sin(T - 0.03)


# References ------------------------------------------------------------------------------------


def test_what_a_controller_reports_counts_and_not_the_one_goal_that_was_caught(tmp_path, capsys):
    kinds = {"/joint_states": JOINT_STATE, "/hand/controller_state": CONTROLLER_STATE}
    log = states(LATE) + reports("/hand/controller_state", WAVE)
    _, _, goal = trajectory(0, ramp("j1", t0=0.0, t2=0.0))
    log.append(("/hand/joint_trajectory", T0 + 2 * S, goal))
    bag = write(tmp_path / "bag", kinds | {"/hand/joint_trajectory": JOINT_TRAJECTORY}, log)
    found = j1(bag)
    assert found.run.joints["j1"]["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=1e-12)
    assert found.run.against == {"j1": "/hand/controller_state (controller_state)"}
    assert any(
        "/hand/controller_state reports another reference than /hand/joint_trajectory" in line
        for line in found.defects
    )
    for style in ("table", "csv", "json"):
        assert main(["metrics", str(bag), "--format", style]) == 0
        text = capsys.readouterr().out
        assert "hand/controller" in text, style
    assert json.loads(text)["runs"]["bag"]["against"] == found.run.against
    page = tmp_path / "page.html"
    assert main(["metrics", str(bag), "--report", str(page)]) == 0
    assert "against /hand/controller_state" in page.read_text()


def test_controllers_that_are_active_in_turn_make_one_reference(tmp_path):
    topics = ("/scaled/controller_state", "/jtc/controller_state")
    log = states(LATE) + reports(topics[0], WAVE[:500]) + reports(topics[1], WAVE[500:], first=500)
    bag = write(
        tmp_path / "bag",
        {"/joint_states": JOINT_STATE} | dict.fromkeys(topics, CONTROLLER_STATE),
        log,
    )
    found = j1(bag)
    assert found.run.joints["j1"]["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=1e-12)
    assert found.run.against["j1"] == f"{topics[0]} and {topics[1]} (controller_state)"
    assert not any("reference" in line for line in found.defects)


def test_of_two_that_report_at_once_the_followed_one_counts_at_each_time(tmp_path):
    topics = ("/a/controller_state", "/b/controller_state")
    stale = np.where(T[:600] < 5.0, WAVE[:600], WAVE[499])
    early = np.where(T[400:] < 5.0, -0.3, WAVE[400:])
    log = states(LATE) + reports(topics[0], stale) + reports(topics[1], early, first=400)
    kinds = {"/joint_states": JOINT_STATE} | dict.fromkeys(topics, CONTROLLER_STATE)
    found = j1(write(tmp_path / "bag", kinds, log))
    assert found.run.joints["j1"]["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=1e-9)
    assert any("unlike references of j1" in line for line in found.defects)


def test_no_reference_is_made_up_for_the_time_in_which_nobody_reports(tmp_path):
    topic = "/c/controller_state"
    known = np.r_[300:500, 700:800]
    log = states(LATE) + reports(topic, WAVE[300:500], first=300)
    log += reports(topic, WAVE[700:800], first=700)
    bag = write(tmp_path / "bag", {"/joint_states": JOINT_STATE, topic: CONTROLLER_STATE}, log)
    found, e = j1(bag), WAVE - LATE
    numbers = found.run.joints["j1"]
    parts = (slice(300, 500), slice(700, 800))
    expected = sum(itae(T[each], e[each]) for each in parts)
    assert numbers["itae"] == pytest.approx(expected, rel=1e-12)
    mean = sum(integral(T[each], e[each] ** 2) for each in parts) / (1.99 + 0.99)
    assert numbers["rmse"] == pytest.approx(math.sqrt(mean), rel=1e-12)
    assert numbers["error_max"] == np.abs(e[known]).max()
    (line,) = [each for each in found.defects if "the reference of j1 is known from" in each]
    assert "3.000 s to 4.990 s, 7.000 s to 7.990 s" in line


@pytest.mark.parametrize("kind", [JOINT_STATE, JOINT_TRAJECTORY])
def test_a_plan_that_nothing_follows_is_not_taken(tmp_path, kind):
    name = "reference" if kind == JOINT_STATE else "joint_trajectory"
    plan, own = f"/planner/{name}", f"/arm/{name}"
    reference, position = (0.8 * np.clip(T - late, 0.0, 1.0) for late in (2.0, 2.03))
    log = states(position)
    if kind == JOINT_STATE:
        for topic, values in ((plan, -WAVE), (own, reference)):
            log += [
                (topic, T0 + k * S // 100, joint_state(T0 + k * S // 100, ["j1"], [value]))
                for k, value in enumerate(values)
            ]
    else:
        log.append((plan, T0 + 1.5 * S, trajectory(0, ramp("j1", t2=-1.0))[2]))
        log.append((own, T0 + 1.995 * S, trajectory(0, ramp("j1", t0=0.0, t1=0.8))[2]))
    found = j1(write(tmp_path / "bag", {"/joint_states": JOINT_STATE, plan: kind, own: kind}, log))
    expected = itae(T, reference - position)
    assert found.run.joints["j1"]["itae"] == pytest.approx(expected, rel=1e-9)
    assert found.run.against["j1"].startswith(f"{own} ")
    assert any(f"the joint follows {own}" in line for line in found.defects)


def test_a_trajectory_that_controllers_refuse_is_no_reference(tmp_path):
    topic = "/arm/joint_trajectory"
    position = 0.8 * np.clip(T - 2.0, 0.0, 1.0)
    log = states(position)
    log.append((topic, T0 + 1.995 * S, trajectory(0, ramp("j1", t0=0.0, t1=0.8))[2]))
    for received, stamp in ((5, 1), (6, 7200)):  # ended in the past; begins in two hours
        raw = trajectory(0, ramp("j1", t2=-2.0, stamp_ns=T0 + stamp * S))[2]
        log.append((topic, T0 + received * S, raw))
    kinds = {"/joint_states": JOINT_STATE, topic: JOINT_TRAJECTORY}
    found = j1(write(tmp_path / "bag", kinds, log))
    assert found.run.joints["j1"]["itae"] == pytest.approx(0.0, abs=1e-9)
    assert any("2 trajectories on /arm/joint_trajectory left out" in x for x in found.defects)
    assert any("the reference of j1 begins at 2.000 s" in line for line in found.defects)


def test_before_its_first_trajectory_a_joint_that_moved_has_no_reference(tmp_path):
    topic = "/arm/joint_trajectory"
    log = states(WAVE)
    log.append((topic, T0 + 4.995 * S, trajectory(0, ramp("j1", t0=0.0, t1=0.0))[2]))
    kinds = {"/joint_states": JOINT_STATE, topic: JOINT_TRAJECTORY}
    found = j1(write(tmp_path / "bag", kinds, log))
    expected = itae(T[500:], WAVE[500:])
    assert found.run.joints["j1"]["itae"] == pytest.approx(expected, rel=1e-12)
    assert any("known from 5.000 s to 9.990 s" in line for line in found.defects)


def test_what_a_pid_controller_reports_is_reference_and_effort(tmp_path):
    topic, effort = "/pid_controller/controller_state", 40.0 * (WAVE - LATE)
    log = []
    for k, (r, y, u) in enumerate(zip(WAVE, LATE, effort, strict=True)):
        stamp_ns = T0 + k * S // 100
        both = joint_state(stamp_ns, ["a_wheel", "j1"], [5.0 * T[k], y])
        log.append(("/joint_states", stamp_ns + 2e5, both))
        raw = pid_report(stamp_ns, j1=(r, y, u), a_wheel=(5.0, 4.9, 1.0))
        log.append((topic, stamp_ns + 3e5, raw))
    found = j1(write(tmp_path / "bag", {"/joint_states": JOINT_STATE, topic: DOFS}, log))
    numbers = found.run.joints["j1"]
    assert numbers["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=1e-12)
    assert numbers["ivc"] == pytest.approx(np.abs(np.diff(effort)).sum(), rel=1e-12)
    # What it controls of the wheel is a velocity.
    assert "itae" not in found.run.joints["a_wheel"]
    assert any("reports no positions of a_wheel" in line for line in found.defects)


def test_what_a_pid_says_without_a_joint_is_named_where_nothing_says_more(tmp_path):
    pid, reports_too = "/pid_controller/j1/pid_state", "/arm/controller_state"
    kinds = {"/joint_states": JOINT_STATE, pid: PID_STATE}
    fields = (0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0)
    timestep = STORE.types["builtin_interfaces/msg/Duration"](0, 10 * MS)
    log = states(LATE)
    log += [
        (pid, T0 + k * 10 * MS + 3e5, made(PID_STATE, header(T0 + k * 10 * MS), timestep, *fields))
        for k in range(len(T))
    ]
    alone = j1(write(tmp_path / "alone", kinds, log))
    line = f"{pid}: errors and outputs of a PID, which name no joint: not read; record what names"
    assert any(line in each for each in alone.defects)
    kinds[reports_too] = CONTROLLER_STATE
    beside = j1(write(tmp_path / "beside", kinds, log + reports(reports_too, WAVE)))
    assert not any("of a PID" in each for each in beside.defects)
    assert beside.run.joints["j1"]["itae"] == pytest.approx(itae(T, WAVE - LATE), rel=1e-12)


def test_goals_of_an_action_are_named_where_nothing_else_is_a_reference(tmp_path):
    """Their content is never read: any bytes will do."""
    goal = "/arm/follow_joint_trajectory/goal"
    kind = "control_msgs/msg/FollowJointTrajectoryActionGoal"
    STORE.register(get_types_from_msg("string data\n", kind))
    kinds = {"/joint_states": JOINT_STATE, goal: kind}
    log = [*states(LATE), (goal, T0 + 1, made(kind, "a goal"))]
    alone = j1(write(tmp_path / "alone", kinds, log))
    assert any(f"{goal}: goals of an action" in each for each in alone.defects)
    kinds["/arm/controller_state"] = CONTROLLER_STATE
    log += reports("/arm/controller_state", WAVE)
    beside = j1(write(tmp_path / "beside", kinds, log))
    assert not any("of an action" in each for each in beside.defects)


# Turns -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["continuous", "revolute", None])
@pytest.mark.parametrize("low", [-math.pi, 0.0])
def test_turns_that_a_driver_leaves_out_are_added_up(tmp_path, kind, low):
    def of_driver(x):
        return (x - low) % math.tau + low

    reference, position = (2.0 * t + 0.5 * np.sin(t) for t in (T, T - 0.02))
    topic, description = "/arm/controller_state", "/robot_description"
    log = states(of_driver(position), np.ones(len(T)))
    log += reports(topic, of_driver(reference))
    if kind is not None:
        log.append((description, T0, serialised(STRING, URDF.format(kind))))
    kinds = {"/joint_states": JOINT_STATE, topic: CONTROLLER_STATE, description: STRING}
    found = j1(write(tmp_path / "bag", kinds, log))
    numbers, error = found.run.joints["j1"], reference - position
    assert numbers["itae"] == pytest.approx(itae(T, error), rel=1e-9)
    assert numbers["error_max"] == pytest.approx(np.abs(error).max(), rel=1e-9)
    assert numbers["energy"] == pytest.approx(np.ptp(position), rel=1e-9)
    assert any("jump by a turn" in line for line in found.defects) is (kind != "continuous")


def test_a_joint_that_rests_where_its_driver_wraps_does_not_move(tmp_path):
    topic, random = "/arm/controller_state", np.random.default_rng(2)
    position = math.pi + random.normal(0.0, 0.002, len(T))
    log = states((position + math.pi) % math.tau - math.pi)
    log += reports(topic, np.full(len(T), math.pi))
    found = j1(
        write(tmp_path / "bag", {"/joint_states": JOINT_STATE, topic: CONTROLLER_STATE}, log)
    )
    largest = np.abs(position - math.pi).max()
    assert found.run.joints["j1"]["error_max"] == pytest.approx(largest, rel=1e-9)


def test_an_error_of_more_than_half_a_turn_stays_what_it_is(tmp_path):
    topic = "/wheel/controller_state"
    kinds = {"/joint_states": JOINT_STATE, topic: CONTROLLER_STATE, "/robot_description": STRING}
    log = states(np.zeros(len(T))) + reports(topic, 2.0 * T)  # a wheel that is stuck
    log.append(("/robot_description", T0, serialised(STRING, URDF.format("continuous"))))
    found = j1(write(tmp_path / "bag", kinds, log))
    assert found.run.joints["j1"]["error_max"] == pytest.approx(2.0 * T[-1])


# Senders ---------------------------------------------------------------------------------------


def arm(t):
    return [0.5 * math.sin(2.0 * t), -0.3 * math.sin(1.3 * t)]


def other_sender(kind, k):
    """Return log time and message of a second sender, at 10 Hz."""
    stamp_ns = T0 + k * S // 10
    if kind == "one stamp, other order":
        return stamp_ns + 4e5, joint_state(stamp_ns, ["j2", "j1"], [0.0, 0.0])
    if kind == "other stamps, other order":
        return stamp_ns + 7.4e6, joint_state(stamp_ns + 7_000_000, ["j2", "j1"], [0.0, 0.0])
    if kind == "a clock of its own":
        raw = joint_state(k * S // 10, ["j1", "j2"], [0.0, 0.0], [0.0] * 2, [0.0] * 2)
        return stamp_ns + 7.4e6, raw
    late = [round(x, 2) for x in arm(k / 10 - 0.06)]
    raw = joint_state(stamp_ns + 2_500_000, ["j1", "j2"], late, [0.0] * 2, [0.0] * 2)
    return stamp_ns + 3e6, raw


KINDS = (
    "one stamp, other order",
    "other stamps, other order",
    "a clock of its own",
    "a driver of the same layout",
)


def senders(path, *kinds):
    log, efforts = [], []
    for k in range(500):
        stamp_ns, effort = T0 + k * S // 50, [2.0 * math.sin(0.04 * k), -math.sin(0.026 * k)]
        efforts.append(effort)
        raw = joint_state(stamp_ns, ["j1", "j2"], arm(k / 50), [0.0] * 2, effort)
        log.append(("/joint_states", stamp_ns + 2e5, raw))
    for number, kind in enumerate(kinds):
        for k in range(1, 100):
            log_time_ns, raw = other_sender(kind, k)
            log.append(("/joint_states", log_time_ns + number, raw))
    bag = write(path, {"/joint_states": JOINT_STATE}, log)
    return bag, np.abs(np.diff(efforts, axis=0)).sum(axis=0)


@pytest.mark.parametrize("kinds", [*((each,) for each in KINDS), (KINDS[1], KINDS[3])])
def test_of_several_senders_one_is_taken_and_all_are_named(tmp_path, kinds):
    bag, variation = senders(tmp_path / "bag", *kinds)
    found = j1(bag, reference="hold")
    assert [found.run.joints[x]["ivc"] for x in ("j1", "j2")] == pytest.approx(variation)
    assert found.run.joints["j1"]["error_max"] == pytest.approx(
        max(abs(arm(k / 50)[0]) for k in range(500))
    )
    (line,) = [each for each in found.defects if "senders" in each]
    assert f"states of {1 + len(kinds)} senders, sender 1: 500 messages, 50 Hz" in line
    assert "99 messages, 10 Hz" in line
    assert "sender 1 is taken, the others are left out" in line


def test_a_sender_is_chosen_by_number_rate_or_layout(tmp_path, capsys):
    bag, _ = senders(tmp_path / "bag", KINDS[1])
    for sender in ("2", "10Hz", "j2,j1"):
        found = j1(bag, reference="hold", sender=sender)
        assert found.run.joints["j1"]["error_max"] == 0.0, sender
        assert any("sender 2 is taken" in line for line in found.defects)
    with pytest.raises(SettingError, match=r"no sender is '3': .*sender 1: 500 messages"):
        j1(bag, reference="hold", sender="3")
    assert main(["metrics", str(bag), "--reference", "hold", "--sender", "2"]) == 0
    assert "0.000" in capsys.readouterr().out


def test_one_sender_with_jitter_noise_or_two_layouts_stays_one(tmp_path):
    random, log = np.random.default_rng(1), []
    for k, time in enumerate(np.sort(T + random.normal(0.0, 2e-3, len(T)))):
        stamp_ns = T0 + S + int(time * S)
        position, effort = 0.5 * math.sin(2.0 * time), random.normal(0.0, 0.3)
        velocity = [0.0] if k % 10 == 0 else []  # now and then
        raw = joint_state(stamp_ns, ["j1"], [position], velocity, [effort])
        log.append(("/joint_states", stamp_ns + random.integers(0, 2_000_000), raw))
    found = j1(write(tmp_path / "bag", {"/joint_states": JOINT_STATE}, log), reference="hold")
    assert found.series is not None
    assert found.series.joints[0].position.size == len(T)
    assert not any("senders" in line for line in found.defects)


def part_of(times, positions):
    """Return states of one layout as senders are looked for in them."""
    stamps_ns = T0 + np.round(np.asarray(times) * S).astype(np.int64)
    return Part("j1", stamps_ns, stamps_ns + MS, np.arange(len(times)), {"j1": positions}, {})


def test_states_that_come_by_hand_are_of_one_sender():
    """Poses that a person has taken, one by one: they keep no period."""
    several = 0
    for seed in range(200):
        random = np.random.default_rng(seed)
        count = int(random.integers(20, 200))
        part = part_of(np.cumsum(random.uniform(4, 20, count)), random.uniform(-1, 1, count))
        several += find_senders([part]) is not None
    assert several <= 4


@pytest.mark.parametrize("strays", [0, 3])
def test_a_sender_that_is_late_and_makes_up_for_it_is_one(strays):
    """A timer of 10 ms, one tick in ten 10 ms late; some more besides."""
    ticks = 0.01 * np.arange(4000)
    late = np.where(np.arange(4000) % 10 == 7, 0.01, 0.0) + np.where(
        np.arange(4000) % 10 == 8, 0.002, 0.0
    )
    late[1003 : 1003 + 900 * strays : 900] += 0.008
    times = np.sort(ticks + late)
    steps = np.random.default_rng(1).choice([0.0, 2.69], 4000, p=[0.9, 0.1]).cumsum()
    assert find_senders([part_of(times, np.sin(0.3 * times) + steps)]) is None


@pytest.mark.parametrize("jitter", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("rate", [5, 10, 50])
def test_two_senders_of_one_layout_are_told_apart_though_both_jitter(jitter, rate):
    random = np.random.default_rng(rate)
    one = np.arange(600) / 50 + random.normal(0.0, jitter / 50, 600)
    other = np.arange(1, int(11.9 * rate)) / rate + 0.0033
    other += random.normal(0.0, jitter / 50, other.size)
    times = np.concatenate((one, other))
    positions = np.concatenate((0.5 * np.sin(2 * one), 0.5 * np.sin(2 * other - 0.3) + 0.2))
    order = np.argsort(times)
    found = find_senders([part_of(times[order], positions[order])])
    assert found is not None
    assert len(found.left_out) == pytest.approx(other.size, abs=max(3, 0.05 * other.size))


def test_two_controllers_of_one_joint_are_not_one(tmp_path):
    log = states(LATE)
    effort = 2.0 * np.cos(T)
    for k, u in enumerate(effort):
        stamp_ns = T0 + k * S // 100
        for late, value in ((3e5, u), (4e5, -7.0 + 0.1 * math.sin(5.0 * T[k]))):
            raw = joint_state(stamp_ns, ["j1"], (), (), [value])
            log.append(("/joint_commands", stamp_ns + late, raw))
    kinds = dict.fromkeys(("/joint_states", "/joint_commands"), JOINT_STATE)
    found = j1(write(tmp_path / "bag", kinds, log), reference="hold")
    assert found.run.joints["j1"]["ivc"] == pytest.approx(np.abs(np.diff(effort)).sum())
    assert any("efforts of 2 senders" in line for line in found.defects)


# The same motion -------------------------------------------------------------------------------


def moved(path, ahead, late, noise=0.0, count=800):
    """Record one motion, begun so many seconds after the recorder."""
    random = np.random.default_rng(3)
    t = np.arange(count) / 100

    def motion(s):
        x = np.clip(s / 2.0, 0.0, 1.0)
        return 0.8 * (10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5)

    reference, position = motion(t - ahead), motion(t - ahead - late)
    log = states(position, 50.0 * (reference - position))
    for k, r in enumerate(reference + noise * random.standard_normal(count)):
        stamp_ns = T0 + k * S // 100
        log.append(("/arm/reference", stamp_ns + 1e5, joint_state(stamp_ns, ["j1"], [r])))
    bag = write(path, dict.fromkeys(("/joint_states", "/arm/reference"), JOINT_STATE), log)
    return bag, t - ahead, reference - position


@pytest.mark.parametrize("clock", ["shared", "out of order"])
def test_log_times_that_are_shared_or_out_of_order_change_no_index(tmp_path, clock):
    log = small_log(count=300)
    jitter = np.random.default_rng(1).integers(-15 * MS, 15 * MS, len(log))
    other = [
        (topic, at - at % (100 * MS) if clock == "shared" else max(at + int(late), 0), raw)
        for (topic, at, raw), late in zip(log, jitter, strict=True)
    ]
    found = [
        measure(write_bag(tmp_path / name, each), "run").run.as_mapping()
        for name, each in (("as sent", log), ("as logged", other))
    ]
    assert found[0] == found[1]
    assert found[0]["totals"]["itae"] > 0.0


def test_runs_begun_by_hand_are_laid_over_each_other_where_the_reference_moves(tmp_path, capsys):
    slow, t, e = moved(tmp_path / "slow", 1.0, 0.06)
    fast, _, _ = moved(tmp_path / "fast", 1.7, 0.03)
    comparison = compare([slow, fast])
    kept = (t >= -1e-9) & (t <= 7.99 - 1.7 + 1e-9)
    assert comparison.run("slow").totals["itae"] == pytest.approx(itae(t[kept], e[kept]))
    run = comparison.run("fast")
    assert run.shift == pytest.approx(0.7)
    assert "shifted by +0.7 s against slow; ITAE counts time from there" in run.cut
    assert comparison.as_mapping()["runs"]["fast"]["shift"] == pytest.approx(0.7)
    ratios = comparison.as_mapping()["ratios"]["fast"]["totals"]
    assert ratios["ivc"] == pytest.approx(0.5, abs=2e-3)
    assert ratios["itae"] == pytest.approx(0.493, abs=1e-3)
    for align in ("begin", "none"):
        apart = measure_all([slow, fast], Measuring(align=align))
        assert all(not each.run.cut for each in apart)
    window = ["--window", "slow=1.0", "--window", "fast=1.7:5"]
    assert main(["metrics", str(slow), str(fast), *window, "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    kept = (t >= -1e-9) & (t <= 3.3 + 1e-9)
    assert runs["slow"]["totals"]["itae"] == pytest.approx(itae(t[kept], e[kept]))
    assert runs["fast"]["conditions"]["duration"] == pytest.approx(3.3)
    for wrong in ("slow", "slow=2:1", "slow=-1", "other=1"):
        assert main(["metrics", str(slow), str(fast), "--window", wrong]) == 2, wrong
    noisy, _, _ = moved(tmp_path / "noisy", 2.31, 0.03, noise=2e-4, count=900)
    assert compare([slow, noisy]).run("noisy").shift == pytest.approx(1.31, abs=0.03)


def test_runs_that_begin_within_a_motion_are_laid_where_it_fits_best(tmp_path):
    def cut_out(path, skipped, late):
        t = T + skipped
        reference, position = (
            0.6 * np.sin(1.1 * s) + 0.3 * np.sin(2.7 * s) for s in (t, t - late)
        )
        log = states(position, 50.0 * (reference - position))
        log += reports("/arm/controller_state", reference)
        kinds = {"/joint_states": JOINT_STATE, "/arm/controller_state": CONTROLLER_STATE}
        return write(path, kinds, log)

    bags = [cut_out(tmp_path / "one", 0.0, 0.05), cut_out(tmp_path / "other", 1.23, 0.02)]
    run = compare(bags).run("other")
    assert run.shift == pytest.approx(-1.23, abs=0.01)
    assert "fits best" in run.cut


def test_a_motion_that_no_run_has_cannot_align_them(tmp_path, capsys):
    still = write(
        tmp_path / "still",
        {"/joint_states": JOINT_STATE, "/c/controller_state": CONTROLLER_STATE},
        states(np.zeros(100)) + reports("/c/controller_state", np.full(100, 0.1)),
    )
    assert main(["metrics", str(still), "--align", "motion"]) == 2
    assert "none moves in still" in capsys.readouterr().err
    assert main(["metrics", str(still), "--align", "sideways"]) == 2
    assert "auto, begin, motion, none" in capsys.readouterr().err


def test_a_single_state_and_joints_that_are_left_out_are_told(tmp_path):
    raw = joint_state(T0, ["j1"], [0.1], [0.0], [1.0])
    bag = write(tmp_path / "one", {"/joint_states": JOINT_STATE}, [("/joint_states", T0, raw)])
    (line,) = [x for x in measure(bag, "run").defects if "single state" in x]
    assert line == "run 'run': a single state of j1: integrals over no time are 0"

    bag = write_bag(tmp_path / "two", small_log(count=50))
    (line,) = [x for x in measure(bag, "run").defects if "left out" in x]
    assert line.startswith("run 'run': left out, as nothing commands them and nothing is their")
    assert "reference: b (--joint names joints to read)" in line


def test_efforts_that_are_called_after_no_joint_stop_nothing(tmp_path, capsys):
    """danieffe/7-DOF-robotic-manipulator-arm-dynamic-control: /effort_controller/commands."""
    kinds = {"/joint_states": JOINT_STATE, "/effort_controller/commands": FLOATS}
    log = []
    for k in range(100):
        stamp_ns = T0 + k * S // 100
        raw = joint_state(stamp_ns, ["j1"], [0.01 * k], [0.0])
        log.append(("/joint_states", stamp_ns, raw))
        log.append(("/effort_controller/commands", stamp_ns + MS, floats(0.1 * k)))
    bag = write(tmp_path / "bag", kinds, log)
    command = ["metrics", str(bag), "--reference", "hold", "--format", "json"]
    assert main([*command, "--commands", "effort"]) == 0
    found = capsys.readouterr()
    assert "'effort', after which it is called, is no joint of the states" in found.err
    assert json.loads(found.out)["runs"]["bag"]["totals"]["itae"] > 0.0
    topic = "j1=/effort_controller/commands[0]"
    assert main([*command, "--command-topic", topic]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert runs["bag"]["totals"]["ivc"] == pytest.approx(9.9)
