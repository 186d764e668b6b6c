"""The package for ros2_control: its controller is begun, left, chained, frozen and begun again."""

import math

import pytest
from harness.plugins import LOOPS, MS, NO_STOPS, Cycle, reference_of

from hpid_bench.tuning.export import GivenLoop

pytestmark = pytest.mark.slow  # it compiles and certifies


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


def test_states_that_have_ended_give_the_fallback_and_then_a_takeover_as_pythons(active):
    cycle = Cycle(active)
    loop = cycle.given.loop
    cycle.as_python(50)
    cycle.as_python(100, by=0.0)  # within state_timeout
    assert loop.note_timeout() == 0.25
    active.tick()
    for _ in range(1000):
        assert cycle(1, by=0.0)[0] == 0.25
        active.tick()
    assert active.verdict("elbow") == "2 no new state: fallback_effort"
    assert active.set("elbow", fallback_effort=0.5) == ""
    loop.retune(loop.settings.with_parameters({"fallback_effort": 0.5}))
    for _ in range(30):
        assert cycle(1, by=0.0)[0] == 0.5
    cycle.as_python(200)
    for _ in range(100):
        active.tick()
    assert active.verdict("elbow") == "0 active"
    # A joint at rest says the same for ever, and is believed.
    assert cycle(500, by=0.0, speed=0.0)[0] != 0.5


def test_two_sources_of_states_give_the_fallback_and_then_a_takeover_as_pythons(active):
    """As where hardware reads the states of a topic that two nodes publish on."""
    cycle = Cycle(active)
    cycle.as_python(50)
    for _ in range(100):
        cycle.as_python(1, by=0.5)
        cycle.as_python(1, by=-0.5)
    assert cycle(1, by=0.0)[0] == 0.25
    active.tick()
    assert active.verdict("elbow") == "2 states of elbow come from two sources: fallback_effort"
    assert active.health("elbow", "state conflicts") == "1"
    cycle.given.step(cycle.stamp_ns, cycle.held, 0.0, cycle.position, 0.01)
    cycle.as_python(800)
    for _ in range(100):
        active.tick()
    assert active.verdict("elbow") == "0 active"


@pytest.mark.parametrize("speed", [0.0, 0.01])
def test_after_a_standstill_of_the_manager_the_state_from_before_is_none(active, speed):
    """The joint may be elsewhere: a takeover from where it was would become a jump."""
    cycle = Cycle(active)
    cycle.as_python(100)
    cycle.as_python(1, speed=speed)
    cycle.stamp_ns += 600 * MS
    for _ in range(10):
        assert cycle(1, by=0.0, speed=speed)[0] == cycle.given.loop.law.effort
    cycle.position += 0.4
    cycle.as_python(200)
    # It may also be where it was: that is believed in the end.
    cycle(1, speed=0.0)
    cycle.stamp_ns += 600 * MS
    held = cycle(100, by=0.0, speed=0.0)[0]
    assert cycle(300, by=0.0, speed=0.0)[0] != held


@pytest.mark.parametrize("step_ns", [-3600 * 10**9, -MS, 50 * MS, 10**10])
def test_nothing_moves_where_the_computers_clock_is_set(active, step_ns):
    cycle = Cycle(active)
    held = cycle.held
    cycle.as_python(100)
    for _ in range(100):
        cycle.position += 1e-5
        cycle.stamp_ns += MS
        now_ns = 10**13 + cycle.stamp_ns + step_ns
        found = active.update(now_ns, *[(cycle.position, 0.01)] * 2, period_ns=MS)[0]
        assert found == cycle.given.step(cycle.stamp_ns, held, 0.0, cycle.position, 0.01)
    # A trajectory begins when the clock that was set says so.
    active.trajectory("elbow", now_ns + 50 * MS, [0, 100 * MS], [held, 0.4])
    for k in range(1, 200):
        states = [(cycle.position + 1e-5 * k, 0.01)] * 2
        found = reference_of(active, "elbow", now_ns + k * MS, states)[0]
        assert (found != pytest.approx(held, abs=1e-9)) is (k > 50)


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
    assert cycle(3, by=0.0, speed=0.0) == [0.0, 0.0]
    assert all(effort < 0.0 for effort in cycle(1, by=1e-3))
    assert active.deactivate()
    active.tick()
    assert active.lifecycle("elbow") == "inactive"
    assert active.activate()
    active.tick()
    assert active.lifecycle("elbow") == "active"
    cycle.position = 0.7
    assert cycle(1, speed=0.0) == [0.0, 0.0]
    assert cycle(300, by=1e-3)[0] < -1.0
    active.deactivate()
    active.activate()  # at once
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


@pytest.mark.parametrize("ends_at_once", [True, False])
def test_the_last_zero_is_published_whatever_comes_next(active, ends_at_once):
    Cycle(active)(5)
    active.deactivate()
    if ends_at_once:
        active.cleanup()
    else:
        active.set_type(is_double=False)
        assert not active.activate()
        assert "not double" in active.told()
        active.tick()
        active.set_type(is_double=True)
        assert active.activate()
    *before, (_, elbow), (_, wrist) = active.taken("joint_commands")
    assert len(before) == 5
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
    plugin.trajectory("elbow", now_ns - 300 * MS, [MS, 200 * MS], [-3.5, 0.5])  # it is under way
    for k in range(1, 700):
        plugin.update(now_ns + k * MS, *rest)
    assert reference_of(plugin, "elbow", now_ns + 700 * MS, rest)[0] == pytest.approx(0.5)


def test_what_another_controller_asks_of_a_wrapping_joint_takes_the_shorter_way(make):
    plugin = make(is_chained=True, elbow={"angle_wraparound": True, **NO_STOPS})
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


def test_one_joint_is_left_alone_and_the_others_go_on(active):
    cycle = Cycle(active)
    cycle(5)
    active.tick()
    assert active.transition("elbow", "deactivate") == "inactive"
    assert [effort != 0.0 for effort in cycle(1)] == [False, True]
    active.set_busy(True)  # also while its state cannot be read
    assert cycle(1)[0] == 0.0
    active.set_busy(False)
    assert active.transition("elbow", "activate") == "active"
    assert cycle(1, speed=0.0)[0] == 0.0
    active.deactivate()
    active.tick()
    assert active.transition("elbow", "activate") == "inactive"
    assert "cannot be activated" in active.told()
