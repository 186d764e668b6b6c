"""The package for ros2_control: its controller answers as Python's loop does."""

import json
import math
import random
from dataclasses import replace
from xml.etree import ElementTree

import pytest
import yaml
from harness.bags import JOINT_STATE
from harness.c_loops import states_by_chance
from harness.loops import loop_settings
from harness.plugins import PACKAGE, Plugin, compile_plugin, export, run_threads

from hpid_ros.base.errors import GainError, SettingError
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings import LARGEST_MOTION
from hpid_ros.experiment.in_process import controllers_document, controllers_text
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.writer import BagWriter
from hpid_ros.motion.joint_trajectory import JointTrajectory, TrajectoryPoint
from hpid_ros.stability.certification import check_certificate
from hpid_ros.stability.closed_loop import Certificate
from hpid_ros.stability.gain_boxes import gain_ranges
from hpid_ros.stability.gain_check import CERTIFICATES, verify
from hpid_ros.tuning.c_export import GivenLoop
from hpid_ros.tuning.plugin_export import require_package
from hpid_ros.tuning.recorded_loops import read_records
from hpid_ros.tuning.replay import replay_joint

pytestmark = pytest.mark.slow  # it compiles and certifies
MS = 1_000_000
ELBOW = {
    "joint": "elbow",
    "gains__p": 39.6,
    "gains__i": 132.0,
    "gains__d": 3.96,
    "mu": -0.1,
    "norm__error_scale": 0.08,
    "norm__rate_weight": 1.2,
    "inertia": 0.1,
    "u_clamp_max": 20.0,
    "u_clamp_min": -20.0,
    "fallback_effort": 0.25,
    "position_max": 1.5,
    "position_min": -1.5,
    "velocity_max": 30.0,
}
WRIST = {
    "joint": "wrist",
    "law": "pid",
    "gains__p": 12.0,
    "gains__i": 5.0,
    "gains__d": 1.5,
    "inertia": 0.05,
    "velocity_source": "filtered",
}
LOOPS = [loop_settings(**ELBOW), loop_settings(**WRIST)]
NO_STOPS = {"position_max": LARGEST_MOTION, "position_min": -LARGEST_MOTION}
NAMES = ["elbow", "wrist"]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plugin")
    export(folder, LOOPS)
    return folder


@pytest.fixture(scope="module")
def library(exported):
    return compile_plugin(exported)


@pytest.fixture
def parameters():
    """What a controller's nodes read from config/joints.yaml."""
    document = controllers_document(LOOPS)
    found = {}
    for joint in NAMES:
        nested = document[f"/**/{joint}_controller"]["ros__parameters"]
        found[joint] = dict(_flat(nested))
    return found


def _flat(values, prefix=""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@pytest.fixture
def make(library, parameters):
    """Return what makes an active controller."""
    made = []

    def start(*, is_chained=False, update_rate=0, **changes):
        own = {joint: {**values, **changes.get(joint, {})} for joint, values in parameters.items()}
        plugin = Plugin(library, NAMES, is_chained=is_chained, update_rate=update_rate, **own)
        made.append(plugin)
        return plugin

    yield start
    for each in made:
        each.__exit__()


@pytest.fixture
def active(make):
    plugin = make()
    assert plugin.is_configured, plugin.log
    assert plugin.activate()
    return plugin


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


class Cycle:
    """A controller that is called each millisecond with a state that moves a little."""

    def __init__(self, plugin):
        self.plugin, self.stamp_ns, self.position = plugin, 1_000_000_000, 0.1

    def __call__(self, count=1, by=1e-5, speed=0.01):
        for _ in range(count):
            self.stamp_ns += MS
            self.position += by
            efforts = self.plugin.update(self.stamp_ns, *[(self.position, speed)] * 2)
        return efforts


def test_updates_that_are_too_rare_are_refused_and_missed_ones_counted(make):
    rare = "control_period 0.001 s is too short: the controller is updated at 500 Hz"
    plugin = make(update_rate=500)
    assert not plugin.is_configured
    assert rare in plugin.log
    plugin = make(update_rate=1000)
    assert "too short" in plugin.set("elbow", control_period=0.0005)
    plugin.activate()
    cycle = Cycle(plugin)
    cycle(10)
    cycle.stamp_ns += 3 * MS
    cycle(10)
    plugin.tick()
    assert plugin.health("elbow", "missed samples") == "3"


def test_a_state_is_published_with_the_effort_that_was_in_force_then(active):
    cycle = Cycle(active)
    efforts = [cycle(1)[0] for _ in range(20)]
    active.tick()
    told = [rows["elbow"][2] for _, rows in active.taken("joint_states")]
    assert told == [0.0, *efforts[:-1]]


def test_the_joints_are_held_where_they_are(active):
    cycle = Cycle(active)
    assert cycle(3, by=0.0, speed=0.0) == [0.0, 0.0]
    assert all(effort < 0.0 for effort in cycle(1, by=1e-3))


def test_states_that_have_ended_give_the_fallback_and_then_a_takeover_as_pythons(active):
    cycle, given = Cycle(active), GivenLoop(LOOPS[0])
    held = cycle.position + 1e-5

    def both(count, by):
        for _ in range(count):
            found = cycle(1, by=by)[0]
            wanted = given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)
            assert found == wanted

    both(50, by=1e-5)
    both(100, by=0.0)  # within state_timeout
    assert given.loop.note_timeout() == 0.25
    active.tick()
    for _ in range(1000):
        assert cycle(1, by=0.0)[0] == 0.25
        active.tick()
    assert active.verdict("elbow") == "2 no new state: fallback_effort"
    assert active.set("elbow", fallback_effort=0.5) == ""
    given.loop.retune(given.loop.settings.with_parameters({"fallback_effort": 0.5}))
    for _ in range(30):
        assert cycle(1, by=0.0)[0] == 0.5
    both(200, by=1e-5)
    for _ in range(100):
        active.tick()
    assert active.verdict("elbow") == "0 active"
    # A joint at rest says the same for ever, and is believed.
    assert cycle(500, by=0.0, speed=0.0)[0] != 0.5


@pytest.mark.parametrize("speed", [0.0, 0.01])
def test_after_a_standstill_of_the_manager_the_state_from_before_is_none(active, speed):
    """The joint may be elsewhere: a takeover from where it was would become a jump."""
    cycle, given = Cycle(active), GivenLoop(LOOPS[0])
    held = cycle.position + 1e-5

    def both(count):
        for _ in range(count):
            found = cycle(1)[0]
            assert found == given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)

    both(100)
    before = cycle(1, speed=speed)[0]
    assert before == given.step(cycle.stamp_ns, held, 0.0, cycle.position, speed)
    cycle.stamp_ns += 600 * MS
    for _ in range(10):
        assert cycle(1, by=0.0, speed=speed)[0] == before
    cycle.position += 0.4
    both(200)
    # It may also be where it was: that is believed in the end.
    cycle(1, speed=0.0)
    cycle.stamp_ns += 600 * MS
    held = cycle(100, by=0.0, speed=0.0)[0]
    assert cycle(300, by=0.0, speed=0.0)[0] != held


@pytest.mark.parametrize("step_ns", [-3600 * 10**9, -MS, 50 * MS, 10**10])
def test_nothing_moves_where_the_computers_clock_is_set(active, step_ns):
    cycle, given = Cycle(active), GivenLoop(LOOPS[0])
    held = cycle.position + 1e-5
    for _ in range(100):
        found = cycle(1)[0]
        assert found == given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)
    for _ in range(100):
        cycle.position += 1e-5
        cycle.stamp_ns += MS
        now_ns = 10**13 + cycle.stamp_ns + step_ns
        found = active.update(now_ns, *[(cycle.position, 0.01)] * 2, period_ns=MS)[0]
        assert found == given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)
    # A trajectory begins when the clock that was set says so.
    active.trajectory("elbow", now_ns + 50 * MS, [0, 100 * MS], [held, 0.4])
    for k in range(1, 200):
        states = [(cycle.position + 1e-5 * k, 0.01)] * 2
        found = reference_of(active, "elbow", now_ns + k * MS, states)[0]
        assert (found != pytest.approx(held, abs=1e-9)) is (k > 50)


def test_what_is_no_number_gives_the_fallback(active):
    cycle = Cycle(active)
    cycle(5)
    assert cycle(1, speed=math.nan)[0] == 0.25
    assert cycle(1, by=math.inf) == [0.25, 0.0]


def test_a_joint_that_begins_with_nonsense_is_held_where_its_first_state_has_it(active):
    rest = [(0.1, 0.0)] * 2
    for k, nonsense in enumerate((math.nan, 2e9)):
        assert active.update(10**9 + k * MS, (nonsense, 0.0), (0.1, 0.0))[0] == 0.25
    assert reference_of(active, "elbow", 10**9 + 2 * MS, rest)[0] == 0.1
    for k in range(1000):
        after = active.update(10**9 + (3 + k) * MS, *rest)[0]
    assert after != 0.25


def test_a_state_that_another_thread_has_for_an_instant_leaves_the_effort(active):
    cycle = Cycle(active)
    before = cycle(5)
    active.set_busy(True)
    after = cycle(1)
    assert after[0] == before[0]
    assert after[1] != before[1]


def test_what_is_left_gets_no_effort_and_is_held_again_where_it_is_then(active):
    cycle = Cycle(active)
    assert cycle(5)[0] != 0.0
    assert active.deactivate()
    active.tick()
    assert active.lifecycle("elbow") == "inactive"
    assert active.activate()
    active.tick()
    assert active.lifecycle("elbow") == "active"
    cycle.position = 0.7
    assert cycle(1, speed=0.0) == [0.0, 0.0]


def test_a_controller_that_is_begun_again_at_once_holds_the_joints_where_they_are_then(active):
    cycle = Cycle(active)
    cycle(20)
    cycle.position = 0.6
    assert cycle(300)[0] < -1.0
    active.deactivate()
    active.activate()
    assert cycle(1, speed=0.0) == [0.0, 0.0]


def test_what_is_asked_for_before_the_first_cycle_is_followed_and_what_is_older_is_not(make):
    plugin = make()
    plugin.activate()
    plugin.setpoint("elbow", 0.4)
    plugin.trajectory("wrist", 0, [MS], [0.3])
    rest = [(0.1, 0.0)] * 2
    for k in range(1000):
        plugin.update(10**9 + k * MS, *rest)
    assert reference_of(plugin, "elbow", 2 * 10**9, rest)[0] == 0.4
    assert reference_of(plugin, "wrist", 2 * 10**9 + MS, rest)[0] == 0.3
    plugin.setpoint("elbow", 0.5)
    plugin.deactivate()
    plugin.tick()
    plugin.activate()
    assert reference_of(plugin, "elbow", 2 * 10**9 + 2 * MS, rest)[0] == 0.1


def test_the_last_zero_is_published_also_where_the_controller_ends_at_once(active):
    cycle = Cycle(active)
    cycle(5)
    active.deactivate()
    active.cleanup()
    *before, (_, elbow), (_, wrist) = active.taken("joint_commands")
    assert len(before) == 5
    assert [elbow["elbow"][2], wrist["wrist"][2]] == [0.0, 0.0]


def test_the_last_zero_is_published_also_where_the_next_activation_fails(active):
    cycle = Cycle(active)
    cycle(5)
    active.deactivate()
    active.set_type(is_double=False)
    assert not active.activate()
    active.tick()
    *_, (_, elbow), (_, wrist) = active.taken("joint_commands")
    assert [elbow["elbow"][2], wrist["wrist"][2]] == [0.0, 0.0]


@pytest.mark.parametrize(("tries", "is_left"), [(5000, True), (20000, False)])
def test_a_zero_is_not_lost_where_another_thread_has_the_command(active, tries, is_left):
    cycle = Cycle(active)
    cycle(5)
    active.told()
    active.keep_command(tries)
    assert active.deactivate()
    assert (cycle(1)[0] == 0.0) is is_left
    assert ("may keep its last effort" in active.told()) is not is_left


def test_a_controller_whose_cycle_threw_can_be_left(active):
    cycle = Cycle(active)
    cycle(5)
    assert active.cannot_read()
    assert active.deactivate()
    assert cycle(1)[0] == 0.0


def test_states_of_another_type_are_refused(active):
    active.deactivate()
    active.tick()
    active.set_type(is_double=False)
    assert not active.activate()
    assert "not double" in active.told()
    active.set_type(is_double=True)
    assert active.activate()


def test_nothing_moves_where_chained_mode_begins_or_ends(make):
    plugin = make()
    plugin.activate()
    cycle, given = Cycle(plugin), GivenLoop(LOOPS[0])

    def both(count):
        """Return what was asked for in the last cycle; each effort is that of one loop."""
        for _ in range(count):
            found = cycle(1)[0]
            plugin.tick()
            *_, (_, rows) = plugin.taken("joint_commands")
            asked, rate, effort = rows["elbow"]
            assert effort == found
            assert effort == given.step(cycle.stamp_ns, asked, rate, cycle.position, 0.01)
        return asked, rate

    plugin.trajectory("elbow", 0, [500 * MS], [0.4])
    before, _ = both(200)
    plugin.set_chained(True)
    assert both(100) == (before, 0.0)
    plugin.ask((0.3, 0.5), (0.1, 0.0))
    assert both(100) == (0.3, 0.5)
    plugin.set_chained(False)
    assert both(100) == (0.3, 0.0)
    plugin.set_chained(True)
    assert both(100) == (0.3, 0.0)


@pytest.mark.parametrize(
    ("skipped", "first_ns", "step_ns"),
    [(0, 0, MS), (0, MS, MS), (3, MS, MS), (12, MS, MS), (1, 20 * MS, 20 * MS)],
)
@pytest.mark.parametrize("ticks", [1, 0])
def test_no_time_is_lost_while_chained_mode_begins(make, skipped, first_ns, step_ns, ticks):
    """The first period after an activation is nominal or 0, whatever cycles were skipped."""
    plugin, given = make(), [GivenLoop(each) for each in LOOPS]
    plugin.activate()
    stamp_ns, position = 10**9, 0.1

    def cycle(count=1, period_ns=step_ns):
        nonlocal stamp_ns, position
        for _ in range(count):
            stamp_ns += step_ns
            position += 1e-3
            found = plugin.update(stamp_ns, *[(position, 1.0)] * 2, period_ns=period_ns)
            wanted = [each.step(stamp_ns, 0.101, 0.0, position, 1.0) for each in given]
            assert found == wanted

    for _ in range(5000 if not ticks else 200):  # without a tick there is no room for more
        cycle()
        for _ in range(ticks):
            plugin.tick()
    plugin.set_chained(True)
    stamp_ns += skipped * step_ns
    position += skipped * 1e-3
    cycle(period_ns=first_ns)
    cycle(100)


def test_chained_mode_that_begins_before_the_first_cycle_is_a_beginning(make):
    plugin = make()
    plugin.activate()
    plugin.set_chained(True)
    assert plugin.update(10**9, *[(0.1, 0.0)] * 2, period_ns=MS) == [0.0, 0.0]
    plugin.tick()
    ((stamp_ns, _),) = plugin.taken("joint_states")
    assert stamp_ns == 10**9


def test_a_joint_that_is_left_while_chained_mode_begins_is_left_with_a_zero(active):
    cycle = Cycle(active)
    cycle(5)
    active.tick()
    active.transition("elbow", "deactivate")
    active.set_chained(True)
    assert cycle(1)[0] == 0.0
    active.tick()
    zeros = [rows["elbow"][2] for _, rows in active.taken("joint_commands") if "elbow" in rows]
    assert zeros[-1] == 0.0


def test_turns_that_are_counted_are_kept_where_chained_mode_begins(make):
    plugin = make(elbow={"encoder_wrap": 2.0 * math.pi, "multi_turn": True, **NO_STOPS})
    plugin.activate()
    rest = [(0.1, 0.0)] * 2
    plugin.update(10**9, *rest)
    plugin.trajectory("elbow", 0, [MS], [4.0])
    for k in range(1, 700):
        plugin.update(10**9 + k * MS, *rest)
    plugin.set_chained(True)
    plugin.set_chained(False)
    now_ns = 10**9 + 700 * MS
    plugin.update(now_ns, *rest)
    plugin.trajectory("elbow", now_ns - 300 * MS, [MS, 200 * MS], [0.4, 0.5])  # it is under way
    for k in range(1, 700):
        plugin.update(now_ns + k * MS, *rest)
    assert reference_of(plugin, "elbow", now_ns + 700 * MS, rest)[0] == pytest.approx(0.5)


def test_what_another_controller_asks_of_a_wrapping_joint_takes_the_shorter_way(make):
    plugin = make(
        is_chained=True,
        elbow={"angle_wraparound": True, **NO_STOPS},
    )
    plugin.activate()
    plugin.update(10**9, (3.0, 0.0), (0.0, 0.0))
    for k in range(1, 200):
        wanted = 3.0 + 0.01 * k
        plugin.ask((math.remainder(wanted, 2.0 * math.pi), 1.0), (0.0, 0.0))
        plugin.update(10**9 + k * MS, (wanted, 1.0), (0.0, 0.0))
        plugin.tick()
        *_, (_, rows) = plugin.taken("joint_commands")
        assert rows["elbow"][0] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("way", ["cleanup", "shutdown"])
def test_a_joint_whose_node_has_ended_gets_no_effort(active, way):
    cycle = Cycle(active)
    cycle(5)
    active.tick()
    if way == "cleanup":
        active.deactivate()
        active.tick()
    assert active.transition("elbow", way) == {"cleanup": "unconfigured"}.get(way, "finalized")
    if way == "cleanup":
        active.activate()
    assert [effort != 0.0 for effort in cycle(2)] == [False, True]


def test_a_joint_that_a_person_left_stays_so_until_a_person_has_it_controlled(active):
    cycle = Cycle(active)
    active.tick()
    active.transition("elbow", "deactivate")
    for begin in (active.activate, lambda: active.set_chained(False)):
        active.deactivate()
        active.tick()
        begin()
        active.tick()
        assert active.lifecycle("elbow") == "inactive"
        assert active.lifecycle("wrist") == "active"
        assert [effort != 0.0 for effort in cycle(2)] == [False, True]
    assert active.transition("elbow", "activate") == "active"
    assert cycle(2)[0] != 0.0


def test_a_joint_that_is_left_gets_no_effort_also_while_its_state_cannot_be_read(active):
    cycle = Cycle(active)
    cycle(5)
    active.tick()
    active.transition("elbow", "deactivate")
    active.set_busy(True)
    assert cycle(1)[0] == 0.0


def test_one_joint_is_left_alone_and_the_others_go_on(active):
    cycle = Cycle(active)
    cycle(5)
    active.tick()
    assert active.transition("elbow", "deactivate") == "inactive"
    elbow, wrist = cycle(1)
    assert elbow == 0.0
    assert wrist != 0.0
    assert active.transition("elbow", "activate") == "active"
    assert cycle(1, speed=0.0)[0] == 0.0
    active.deactivate()
    active.tick()
    assert active.transition("elbow", "activate") == "inactive"
    assert "cannot be activated" in active.told()


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
    cycle, given = Cycle(active), GivenLoop(LOOPS[0])
    assert reason in active.set("elbow", **changes, fallback_effort=0.5)
    held = cycle.position + 1e-5
    for _ in range(20):
        found = cycle(1)[0]
        assert found == given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)
    assert cycle(1, speed=math.nan)[0] == 0.25


def test_more_sets_than_wait_for_an_inactive_controller_are_refused_with_the_reason(make):
    plugin = make()
    for k in range(16):
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


def reference_of(plugin, joint, stamp_ns, states):
    """Return what a joint's loop followed in a cycle."""
    plugin.update(stamp_ns, *states)
    plugin.tick()
    *_, (_, rows) = plugin.taken(f"{joint}_controller/reference")
    return rows[joint][:2]


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
    loop = GivenLoop(LOOPS[0]).loop.__class__(LOOPS[0])
    active.update(start_ns, *rest)
    loop.step(start_ns, 0.1, 0.0)
    active.trajectory("elbow", own, times_ns, *columns)
    loop.follow(JointTrajectory(("elbow",), tuple(points), own).column("elbow"))
    for k in range(1, 1200):
        now_ns = start_ns + k * MS
        found = reference_of(active, "elbow", now_ns, rest)
        loop.step(now_ns, 0.1, 0.0)
        assert found == pytest.approx(loop.reference, abs=1e-12)


def test_a_new_trajectory_begins_where_the_reference_is(active):
    rest, now_ns = [(0.1, 0.0)] * 2, 10**9
    before = reference_of(active, "elbow", now_ns, rest)
    active.trajectory("elbow", 0, [500 * MS], [1.0], [0.0])
    for k in range(1, 900):
        if k == 300:
            active.trajectory("elbow", 0, [400 * MS], [-0.4], [0.0])
        found = reference_of(active, "elbow", now_ns + k * MS, rest)
        assert found[0] == pytest.approx(before[0] + 1e-3 * before[1], abs=5e-5)
        before = found
    assert found == (-0.4, 0.0)


def test_a_setpoint_is_a_step(active):
    rest = [(0.1, 0.0)] * 2
    assert reference_of(active, "elbow", 10**9, rest) == (0.1, 0.0)
    active.setpoint("elbow", 0.4)
    assert reference_of(active, "elbow", 10**9 + MS, rest) == (0.4, 0.0)


@pytest.mark.parametrize(
    ("times_ns", "columns", "reason"),
    [
        ([], [[]], "0 points"),
        ([MS, MS], [[0.1, 0.2]], "times must increase; point 1"),
        ([MS], [[math.nan]], "not finite"),
        ([MS], [[2.0 * LARGEST_POSITION]], "beyond 1e9"),
        ([MS], [[0.1], [math.inf]], "not finite"),
    ],
)
def test_a_trajectory_that_is_none_is_refused_and_the_joint_is_held(
    active, times_ns, columns, reason
):
    rest = [(0.1, 0.0)] * 2
    active.update(10**9, *rest)
    active.trajectory("elbow", 0, times_ns, *columns)
    assert reason in active.told()
    assert reference_of(active, "elbow", 10**9 + MS, rest) == (0.1, 0.0)


def test_a_trajectory_before_all_time_is_refused(active):
    active.update(10**9, *[(0.1, 0.0)] * 2)
    active.trajectory("elbow", -(10**9), [MS], [0.2])
    assert "its stamp is negative" in active.told()


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
        assert verify(corners).text.startswith("all 6 hold, ")
    corners[4]["gains"]["i"] *= 40.0
    assert verify(corners).text.startswith("certificate 5 of 6 does NOT hold: ")


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
        *("measured", "filtered", "homogeneous_differentiator")
    ]
    compile((exported / "launch" / "simulated.launch.py").read_text(), "launch", "exec")
    contents = {path.name: path.read_bytes() for path in exported.rglob("*") if path.is_file()}
    is_text = {name: b"\0" not in content for name, content in contents.items()}
    assert [name for name, raw in contents.items() if is_text[name] and b"{{ " in raw] == []
