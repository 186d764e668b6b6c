"""The package for ros2_control: its controller answers as Python's loop does."""

import contextlib
import json
import math
import random
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from harness.bags import JOINT_STATE
from harness.c_loops import states_by_chance
from harness.loops import loop_settings
from harness.plugins import (
    ELBOW,
    LOOPS,
    MS,
    NAMES,
    PACKAGE,
    WRIST,
    Cycle,
    reference_of,
    run_threads,
)

from hpid_bench.experiment.in_process import controllers_text
from hpid_bench.tuning.export import GivenLoop, require_package
from hpid_bench.tuning.recorded_loops import read_records
from hpid_bench.tuning.replay import replay_joint
from hpid_ros.base.errors import GainError, SettingError, TrajectoryError
from hpid_ros.control import JointLoop
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion.joint_trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.stability.certification import check_certificate
from hpid_ros.stability.closed_loop import Certificate
from hpid_ros.stability.gain_boxes import _box, _range, gain_ranges
from hpid_ros.stability.gain_check import CERTIFICATES, certified_degrees, verify_certificates

pytestmark = pytest.mark.slow  # it compiles and certifies


def test_a_chained_controller_answers_as_python_does_to_the_last_bit(make):
    plugin = make(is_chained=True)
    assert plugin.activate()
    given = [GivenLoop(each) for each in LOOPS]
    for stamp_ns, reference, rate, position, velocity in positive(
        states_by_chance(random.Random(5), 20_000, 1e-3)
    ):
        if not (abs(reference) <= LARGEST_POSITION and math.isfinite(rate)):
            continue  # the joint is held then, and no state is one that cannot be used
        speed = math.nan if velocity is None else velocity
        plugin.ask((reference, rate), (reference, rate))
        efforts = plugin.update(stamp_ns, (position, speed), (position, speed))
        wanted = [each.step(stamp_ns, reference, rate, position, speed) for each in given]
        assert efforts == wanted


def positive(states):
    """Yield states whose stamps a clock of ROS can have."""
    for stamp_ns, *numbers in states:
        yield stamp_ns + 2 * 10**12, *numbers


def test_a_set_is_taken_from_the_next_cycle_on_as_python_takes_it(make):
    plugin = make(is_chained=True)
    plugin.activate()
    given, chance = GivenLoop(LOOPS[0]), random.Random(3)
    for number, (stamp_ns, *numbers) in enumerate(positive(states_by_chance(chance, 600, 1e-3))):
        if number in (200, 400):
            gains = {"gains.p": 41.0, "gains.d": 4.1} if number == 200 else {"mu": -0.15}
            changes = {name.replace(".", "__"): value for name, value in gains.items()}
            assert plugin.set("elbow", **changes) == ""
            given.loop.retune(given.loop.settings.with_parameters(gains))
        reference, rate, position, velocity = numbers
        if not (abs(reference) <= LARGEST_POSITION and math.isfinite(rate)):
            continue
        speed = math.nan if velocity is None else velocity
        plugin.ask((reference, rate), (0.0, 0.0))
        effort = plugin.update(stamp_ns, (position, speed), (0.0, 0.0))[0]
        assert effort == given.step(stamp_ns, reference, rate, position, speed)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gains__p": 80.0}, "not certified: gains.p = 80 is not within"),
        ({"gains__p": 10.0, "gains__d": 1.0}, "p d must exceed i x inertia"),
        ({"gains__p": math.nan}, "gains.p is not a number"),
        ({"fallback_effort": math.nan}, "fallback_effort is not a number"),
        ({"mu": 0.4}, "not certified: mu = 0.4 is not within -0.2 to 0.1"),
        ({"inertia": 0.3}, "not certified: inertia = 0.3 is not within 0.1 to 0.1"),
        ({"norm__rate_weight": 1.3}, "norm.rate_weight x norm.error_scale = 0.104 is not"),
        ({"u_clamp_min": 30.0}, "u_clamp_min must not exceed u_clamp_max"),
        ({"state_timeout": 0.001}, "1.5 times control_period"),
        ({"norm__floor": 1e6}, "no room below norm.cap"),
    ],
)
def test_what_the_certificate_or_the_loop_does_not_allow_is_refused_as_a_whole(
    active, changes, reason
):
    cycle = Cycle(active)
    assert reason in active.set("elbow", **{"fallback_effort": 0.5} | changes)
    cycle.as_python(20)
    assert cycle(1, speed=math.nan)[0] == 0.25


def test_more_sets_than_wait_for_an_inactive_controller_are_refused_with_the_reason(make):
    plugin = make()
    for k in range(64):
        assert plugin.set("elbow", takeover_time=0.01 * k) == ""
    assert "wait for the controller to be activated" in plugin.set("elbow", takeover_time=0.3)
    plugin.activate()
    Cycle(plugin)(1)
    assert plugin.set("elbow", takeover_time=0.3) == ""


def test_a_linear_joint_may_have_all_gains_that_are_stable(active):
    assert active.set("wrist", gains__p=500.0, gains__d=0.06) == ""
    assert "p d must exceed" in active.set("wrist", gains__d=4e-4)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gains.p": 80.0}, "elbow: not certified: gains.p = 80"),
        ({"joint": "shoulder"}, "elbow: parameter joint must be it, not shoulder"),
        ({"joint": ""}, "elbow: it is not a joint of this package"),
        ({"position_min": 2.0}, "elbow: position_min must not exceed position_max"),
    ],
)
def test_a_parameter_file_that_is_not_certified_is_not_configured(make, changes, reason):
    plugin = make(elbow=changes)
    assert not plugin.is_configured
    assert reason in plugin.log


def test_certificates_that_are_not_those_of_the_export_are_refused(make, exported):
    file = exported / "config" / "certificates.json"
    content = file.read_text()
    try:
        file.write_text(content.replace("0", "1", 1))
        assert "is not the one of the export" in make().log
        file.unlink()
        assert "cannot be read" in make().log
    finally:
        file.write_text(content)
    assert make().is_configured


@pytest.mark.parametrize("derivatives", [0, 1, 2])
@pytest.mark.parametrize("stamp_ns", [0, 5 * MS, -300 * MS])
def test_a_trajectory_is_followed_as_python_follows_it(active, derivatives, stamp_ns):
    chance = random.Random(derivatives)
    times_ns = [100 * MS, 250 * MS, 700 * MS, 1000 * MS]
    columns = [[chance.uniform(-0.5, 0.5) for _ in times_ns] for _ in range(derivatives + 1)]
    start_ns, rest = 10**9, [((0.1, 0.0))] * 2
    own = start_ns + stamp_ns if stamp_ns else 0
    points = [
        TrajectoryPoint(time_ns, *((column[k],) for column in columns))
        for k, time_ns in enumerate(times_ns)
    ]
    loop = JointLoop(LOOPS[0])
    active.update(start_ns, *rest)
    loop.step(start_ns, 0.1, 0.0)
    active.trajectory("elbow", own, times_ns, *columns)
    loop.follow(JointTrajectory(("elbow",), tuple(points), own).column("elbow"))
    for k in range(1, 1200):
        now_ns = start_ns + k * MS
        found = reference_of(active, "elbow", now_ns, rest)
        loop.step(now_ns, 0.1, 0.0)
        assert found == pytest.approx(loop.following.reference, abs=1e-12)


def test_a_new_trajectory_begins_where_the_reference_is_as_in_python(active):
    rest, now_ns = [(0.1, 0.0)] * 2, 10**9
    loop = JointLoop(LOOPS[0])
    active.update(now_ns, *rest)
    loop.step(now_ns, *rest[0])

    def send(time_ns, position, stamp_ns=0):
        active.trajectory("elbow", stamp_ns, [time_ns], [position], [0.0])
        point = TrajectoryPoint(time_ns, (position,), (0.0,))
        loop.follow(JointTrajectory(("elbow",), (point,), stamp_ns).column("elbow"))

    for k in range(1, 1800):
        if k == 1:
            send(500 * MS, 1.0)
        elif k == 300:
            send(400 * MS, 9.0)  # beyond the stop, where it waits
        elif k == 900:
            send(MS, -0.4, now_ns)  # glided onto, as it is under way
        found = reference_of(active, "elbow", now_ns + k * MS, rest)
        loop.step(now_ns + k * MS, *rest[0])
        assert found == pytest.approx(loop.following.reference, abs=1e-12)
    assert found == (-0.4, 0.0)


def test_a_trajectory_before_the_first_cycle_begins_where_the_joint_is(make):
    plugin, loop = make(), JointLoop(LOOPS[0])
    plugin.activate()
    plugin.trajectory("elbow", 0, [500 * MS], [0.8], [0.0])
    point = TrajectoryPoint(500 * MS, (0.8,), (0.0,))
    loop.follow(JointTrajectory(("elbow",), (point,)).column("elbow"))
    for k in range(600):
        found = reference_of(plugin, "elbow", 10**9 + k * MS, [(0.5, 0.0)] * 2)
        loop.step(10**9 + k * MS, 0.5, 0.0)
        assert found == pytest.approx(loop.following.reference, abs=1e-12)


def test_a_setpoint_is_a_step(active):
    rest = [(0.1, 0.0)] * 2
    assert reference_of(active, "elbow", 10**9, rest) == (0.1, 0.0)
    active.setpoint("elbow", 0.4)
    assert reference_of(active, "elbow", 10**9 + MS, rest) == (0.4, 0.0)


@pytest.mark.parametrize(
    ("names", "times_ns", "columns", "reason"),
    [
        ("elbow", [], [[]], "0 points"),
        ("elbow", [MS, MS], [[0.1, 0.2]], "times must increase; point 1"),
        ("elbow", [MS], [[math.nan]], "not finite"),
        ("elbow", [MS], [[2.0 * LARGEST_POSITION]], "beyond 1e9"),
        ("elbow", [MS], [[0.1], [math.inf]], "not finite"),
        ("elbow", [MS], [[0.2], None, None, [math.nan]], "not finite"),
        ("elbow wrist", [MS], [[0.2], None, None, [1.0]], "one number for each joint"),
        ("elbow wrist wrist", [MS], [[0.2]], "names a joint twice"),
    ],
)
def test_a_trajectory_that_is_none_is_refused_and_the_joint_is_held(
    active, names, times_ns, columns, reason
):
    rest = [(0.1, 0.0)] * 2
    active.update(10**9, *rest)
    active.trajectory(names, 0, times_ns, *columns)
    assert reason in active.told()
    assert reference_of(active, "elbow", 10**9 + MS, rest) == (0.1, 0.0)


def test_a_trajectory_before_all_time_is_refused(active):
    active.update(10**9, *[(0.1, 0.0)] * 2)
    active.trajectory("elbow", -(10**9), [MS], [0.2])
    assert "its stamp is negative" in active.told()


@pytest.mark.parametrize(
    ("begun_s", "start_s", "reason"),
    [
        (0, -2.5, ""),  # latched, as one that begins receives it: its end is approached
        (4, -1.0, ""),  # late in a stream
        (4, -2.5, "the trajectory ended at 102.000 s, in the past: it is 103.500 s now"),
        (4, 3600.0, ""),
        (4, 3601.0, "the trajectory must start within 3600 s, not at 3704.500 s"),
    ],
)
def test_a_trajectory_of_another_time_is_refused_as_python_refuses_it(
    active, begun_s, start_s, reason
):
    rest, begin_ns = [(0.1, 0.0)] * 2, 103_500 * MS
    active.update(begin_ns - begun_s * 10**9, *rest)
    active.update(begin_ns, *rest)
    own = begin_ns + round(start_s * 1e9)
    active.trajectory("elbow", own, [10**9], [0.3], [0.0])
    told = active.told()
    assert reason in told
    assert bool(reason) is ("refused" in told)
    loop = JointLoop(LOOPS[0])
    loop.step(begin_ns, 0.1, 0.0)
    motion = JointTrajectory(("elbow",), (TrajectoryPoint(10**9, (0.3,), (0.0,)),), own)
    with contextlib.suppress(TrajectoryError):
        loop.receive(motion.column("elbow"), carries_on=begun_s == 0)
    assert (loop.following.motion is None) is bool(reason)


def test_references_are_refused_while_nobody_may_give_them(make):
    plugin = make()
    plugin.setpoint("elbow", 0.4)
    assert "a setpoint refused: the joint is not active" in plugin.told()
    chained = make(is_chained=True)
    chained.activate()
    chained.trajectory("elbow", 0, [MS], [0.3])
    assert "another controller gives the references" in chained.told()


def test_a_preceding_controller_that_asks_for_nothing_has_the_joint_held(make):
    plugin = make(is_chained=True)
    plugin.activate()
    assert Cycle(plugin)(5, by=0.0, speed=0.0) == [0.0, 0.0]


def test_every_command_of_a_recording_is_the_laws(active, tmp_path):
    """Retuned, left, frozen and led: what the controller published, computed again."""
    cycle = Cycle(active)
    chance = random.Random(2)
    for k in range(3000):
        if k == 200:
            active.trajectory("elbow", 0, [500 * MS, 900 * MS], [0.5, 0.1], [0.0, 0.0])
            active.setpoint("wrist", 0.3)
        if k == 1200:
            active.tick()
            active.transition("elbow", "deactivate")
        if k == 1300:
            active.transition("elbow", "activate")
        if k in (2200, 2300):
            active.set_chained(k == 2200)
        if k == 2400:
            active.deactivate()
            active.tick()
            active.activate()
        still = 1800 <= k < 1950
        cycle(1, by=0.0 if still else chance.gauss(0.0, 1e-4), speed=0.3)
        active.tick()
    write_plugin_bag(tmp_path / "bag", active)
    parameters = tmp_path / "joints.yaml"
    parameters.write_text(controllers_text(LOOPS))
    records, notes = read_records(tmp_path / "bag", parameters)
    verdicts = [replay_joint(each) for each in records]
    assert not notes
    assert [each.joint for each in verdicts] == NAMES
    for each in verdicts:
        assert each.is_the_law, each
        assert each.fallbacks == 1
    assert verdicts[0].zeros == 2
    assert verdicts[1].equal > 2800


def write_plugin_bag(path, plugin):
    """Record what a controller has published until now."""
    sender = "/hpid_controller"
    log = []
    for topic in ("joint_states", "joint_commands"):
        for stamp_ns, rows in plugin.taken(topic):
            columns = [list(each) for each in zip(*rows.values(), strict=True)]
            present = {
                name: column
                for name, column in zip(("position", "velocity", "effort"), columns, strict=True)
                if not any(map(math.isnan, column))
            }
            has = dict.fromkeys(present, True)
            template = JointStateTemplate(list(rows), frame_id=sender, **has)
            log.append((stamp_ns, topic, template.encode(stamp_ns, **present)))
    with BagWriter(path) as bag:
        topics = {
            name: bag.add_topic(f"{sender}/{name}", JOINT_STATE)
            for name in ("joint_states", "joint_commands")
        }
        for stamp_ns, name, raw in sorted(log, key=lambda each: each[0]):
            bag.write(topics[name], stamp_ns, raw)


@pytest.mark.faults
@pytest.mark.parametrize("sanitizer", ["thread", "address,undefined"])
def test_the_sanitizers_find_nothing_while_both_threads_are_busy(exported, parameters, sanitizer):
    found = run_threads(exported, parameters, sanitizer)
    assert (found.returncode, found.stderr) == (0, "")


def test_every_certificate_of_the_package_holds(exported):
    document = json.loads((exported / "config" / "certificates.json").read_text())
    saved = {
        joint: random.Random(1).sample(corners, 6)
        for joint, corners in document[CERTIFICATES].items()
    }
    assert {"elbow", "wrist"} <= set(saved)
    for corners in saved.values():
        assert verify_certificates(corners).text.startswith("all 6 hold, ")
    corners[4]["gains"]["i"] *= 40.0
    assert verify_certificates(corners).text.startswith("certificate 5 of 6 does NOT hold: ")


def test_gains_within_a_box_are_certified_by_its_p_and_far_beyond_it_are_not():
    loop = loop_settings(**WRIST, norm__effort_scale=3.0)
    (found,) = gain_ranges([(loop, (0.045, 0.05))])
    chance = random.Random(4)
    assert found.contains(0.0)
    assert str(found).startswith("mu -0.")
    for box in found.boxes:
        span = box.corners[0].spans[0]
        for _ in range(3):
            gains = Gains(*(chance.uniform(*each) for each in (box.p, box.i, box.d)))
            inside = replace(span, inertia=chance.uniform(0.045, 0.05))
            check_certificate(Certificate(gains, (inside,)))
        far = Gains(0.2 * box.p[0], 3.0 * box.i[1], 0.2 * box.d[0])
        with pytest.raises(GainError):
            check_certificate(Certificate(far, (span,)))


def test_a_box_of_these_gains_alone_holds_them_as_the_plugin_divides_them():
    gains = Gains(39.6, 132.0, 3.96)  # (d / u0) (u0 / p) is not d / p
    loop = loop_settings(gains=gains, norm__effort_scale=3.0, mu=-0.1), (0.1, 0.1)
    (interval,) = certified_degrees([loop])
    alone = [(span, (1.0, np.array(span.shape))) for span in interval.spans]
    box = _range(loop, interval, loop, alone).boxes[0]
    assert box.rate_time == (gains.d / gains.p,) * 2


def test_a_box_of_these_gains_alone_has_a_p_for_both_ends_of_the_inertia():
    gains = Gains(10.1, 52.8, 0.777)
    loop = loop_settings(gains=gains, norm__rate_weight=0.0406, mu=-0.1), (0.00555, 0.0166)
    (interval,) = certified_degrees([loop])
    span = next(each for each in interval.spans if each.lower < -0.07 < each.upper)
    factor, _ = _box((*loop, span))
    assert factor == 1.0


def test_a_loop_that_is_not_certified_is_not_exported():
    loop = loop_settings(**{**ELBOW, "gains__i": 1500.0, "mu": -0.45})
    with pytest.raises(GainError, match=r"elbow is not certified at mu = -0.45"):
        gain_ranges([(loop, (0.1, 0.1))])


@pytest.mark.parametrize("name", ["My_Controller", "9lives", "a", "my__arm", "arm-controller"])
def test_a_folder_that_is_no_package_is_refused(name):
    with pytest.raises(SettingError, match="cannot be the name of a package"):
        require_package(name, NAMES)


def test_a_joint_that_cannot_have_a_node_is_refused():
    with pytest.raises(SettingError, match="'left/elbow' cannot have a node"):
        require_package(PACKAGE, ["left/elbow"])


def test_the_package_says_the_same_of_itself_everywhere(exported):
    assert ElementTree.parse(exported / "package.xml").findtext("name") == PACKAGE
    plugin = ElementTree.parse(exported / f"{PACKAGE}.xml").getroot()
    assert plugin.get("path") == PACKAGE
    controllers = yaml.safe_load((exported / "config" / "controllers.yaml").read_text())
    assert controllers["hpid_controller"]["ros__parameters"]["joints"] == NAMES
    parameters = yaml.safe_load((exported / "src" / "parameters.yaml").read_text())[PACKAGE]
    assert parameters["gains"]["p"]["validation"] == {"bounds<>": [0.0, 1e6]}
    assert parameters["compensation"]["validation"] == {"one_of<>": [["none"]]}
    assert parameters["velocity_source"]["validation"]["one_of<>"][0] == [
        "measured",
        "filtered",
        "homogeneous_differentiator",
    ]
    compile((exported / "launch" / "simulated.launch.py").read_text(), "launch", "exec")
    contents = {path.name: path.read_bytes() for path in exported.rglob("*") if path.is_file()}
    is_text = {name: b"\0" not in content for name, content in contents.items()}
    assert [name for name, raw in contents.items() if is_text[name] and b"{{ " in raw] == []
