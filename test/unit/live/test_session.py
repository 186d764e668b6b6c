"""A session does what the one person with control asks for, wholly or not at all.

What is staged is sent as it was chosen, comes back by undo, and nothing is sent by itself.
"""

import asyncio
from concurrent.futures import Future

import pytest
from harness.simulated_graph import SimulatedGraph, arm, loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.live.known_controllers import Answer
from hpid_bench.live.page.server import Frames
from hpid_bench.live.session import (
    BANDWIDTH,
    ControlLock,
    Limit,
    LiveSession,
    Tuning,
    slider_range,
)
from hpid_ros.base.errors import SettingError

NODES = sorted(arm())


@pytest.fixture
def graph():
    return SimulatedGraph(arm())


@pytest.fixture
def session(graph):
    made = LiveSession(graph, None)
    made.pulse()
    return made


def lines(session):
    return [each.text for each in session.log]


@pytest.mark.parametrize(
    ("acts", "holder", "pages"),
    [
        ("join a, join b", "a", 2),
        ("join a, join b, take b", "b", 2),
        ("join a, join b, leave a", None, 1),  # nobody gets it by itself
        ("join a, join b, leave a, take a", None, 1),  # who is gone takes nothing
        ("join a, join b, leave a, join a", "a", 2),  # it was cut off for a moment
        ("join a, join b, leave a, take b, join a", "b", 2),
        ("join a, join b, join a, leave a", "a", 2),  # back before the old socket has died
        ("join a, join b, join a, leave a, leave a", None, 1),
        ("join a, leave a, join b", "b", 1),
    ],
)
def test_one_page_has_control(acts, holder, pages):
    lock = ControlLock()
    for act in acts.split(", "):
        name, page = act.split()
        getattr(lock, name)(page)
    assert (lock.holder, lock.pages) == (holder, pages)


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=60))
def test_in_no_window_are_there_more_acts_than_allowed(gaps):
    now, acts = 0.0, []
    limit = Limit(5, 1.0, clock=lambda: now)
    for gap in gaps:
        now += gap
        if limit.allows():
            acts.append(now)
    assert all(later - sooner >= 1.0 for sooner, later in zip(acts, acts[5:], strict=False))
    assert acts[0] == gaps[0]


def test_what_is_staged_on_three_joints_is_one_set_each_and_one_step_to_undo(session, graph):
    session.tuning.stage(NODES, "mu", -0.3)
    session.tuning.stage_factor(NODES, "gains.p", 1.1)
    session.tuning.keep("a", NODES)
    session.pulse()
    session.pulse(is_seen=False)
    session.tuning.stage(NODES[:1], "gains.i", 1e5)  # which the law forbids
    assert not asyncio.run(session.apply(NODES))
    assert graph.sets == graph.transitions == []
    session.tuning.stage(NODES[:1], "gains.i", session.tuning.in_force[NODES[0]]["gains.i"])
    assert asyncio.run(session.apply(NODES))
    assert [node for node, _ in graph.sets] == NODES
    assert all(set(values) == {"mu", "gains.p"} for _, values in graph.sets)
    assert asyncio.run(session.undo())
    session.pulse()
    assert session.tuning.in_force == session.tuning.first
    assert not session.tuning.done


def test_where_one_refuses_the_others_get_theirs_back_and_its_own_words_are_shown(session, graph):
    graph.refusals[NODES[1]] = "mu = -0.3 is not certified stable"
    session.tuning.stage(NODES, "mu", -0.3)
    assert not asyncio.run(session.apply(NODES))
    session.pulse()
    assert {each["mu"] for each in session.tuning.in_force.values()} == {-0.2}
    assert "arm_joint_2 refused: mu = -0.3 is not certified stable" in lines(session)
    assert not session.tuning.done


def test_a_flood_of_sets_ends_at_the_page(session, graph):
    session._limit = Limit(5, 1.0, clock=lambda: 0.0)  # all within one second

    async def flood():
        for number in range(50):
            session.tuning.stage(NODES[:1], "mu", -0.1 - 1e-3 * number)
            await session.apply(NODES[:1])

    asyncio.run(flood())
    assert len(graph.sets) <= 5 + 1
    assert any("at most 5 a second" in line for line in lines(session))


def test_who_has_gone_keeps_nobody_else_from_a_set_and_from_undoing_it(session, graph):
    session.tuning.stage(NODES, "mu", -0.3)
    assert asyncio.run(session.apply(NODES))
    session.tuning.stage(NODES, "mu", -0.4)
    graph.gone.add(NODES[2])
    graph.refusals[NODES[2]] = "it has gone"
    session.pulse()
    assert asyncio.run(session.apply(NODES))
    assert asyncio.run(session.undo())
    assert asyncio.run(session.undo())
    assert [joint.settings.mu for joint in graph.joints.values()] == [-0.2, -0.2, -0.3]
    session.tuning.note("alone", {NODES[2]: {"mu": -0.3}}, {NODES[2]: {"mu": -0.2}})
    assert not asyncio.run(session.undo())
    assert lines(session)[-1] == "alone: not undone: its controllers have gone"
    assert not session.tuning.done


def test_frames_go_on_where_nothing_can_be_drawn(session, monkeypatch):
    def fail(*_):
        raise SettingError("no norm")

    monkeypatch.setattr(session, "pulse", fail)
    frames, queue = Frames(session, None, 1e-3), asyncio.Queue()
    frames._viewers[queue] = "page"

    async def two_frames():
        running = asyncio.ensure_future(frames.run())
        await asyncio.wait_for(asyncio.gather(queue.get(), queue.get()), 10.0)
        running.cancel()

    asyncio.run(two_frames())
    assert lines(session)[-1] == "nothing can be drawn: SettingError('no norm')"
    assert lines(session).count(lines(session)[-1]) == 1


def test_samples_of_before_nobody_looked_are_not_mixed_with_those_of_now(session, graph):
    graph.joints[NODES[0]].stamp_ns = 10**12  # far ahead
    graph._began -= 1001.0
    session.pulse()
    assert session.history(NODES[0]).now > 1000.0
    session.pulse(is_seen=False)
    for joint in graph.joints.values():  # the graph's clock begins anew with the next look
        joint.stamp_ns = 0
    graph._began += 1001.0
    session.pulse()
    assert 0.0 < session.history(NODES[0]).now < 1000.0


def test_a_change_by_anybody_is_marked_and_who_is_there_is_stopped(session, graph):
    graph.set(NODES[0], {"mu": 0.1})
    graph.gone.add(NODES[2])
    _, (change,) = session.pulse()
    assert (change.node, change.values) == (NODES[0], {"mu": 0.1})
    assert "arm_joint_1: mu 0.1" in lines(session)
    assert session.tuning.in_force[NODES[0]]["mu"] == 0.1
    assert "arm_joint_3: its controller has gone" in lines(session)
    assert not asyncio.run(session.stop())  # it may still drive its joint
    assert graph.transitions == [(node, "deactivate") for node in NODES[:2]]
    assert any("arm_joint_3: NOT stopped: out of reach" in line for line in lines(session))


def test_a_file_that_is_saved_is_a_file_that_can_be_loaded(session, graph):
    text = session.document()
    session.tuning.stage(NODES, "mu", 0.1)
    asyncio.run(session.apply(NODES))
    session.pulse()
    session.load(text, "controllers.yaml")
    assert session.tuning.staged_sets(NODES) == {node: {"mu": -0.2} for node in NODES}


def test_what_a_file_does_not_say_stays(session):
    session.load(
        "/**/arm_joint_1_controller: {ros__parameters: {joint: elbow, mu: 0.1}}", "a.yaml"
    )
    assert session.tuning.staged_sets(NODES) == {NODES[0]: {"mu": 0.1}}


@pytest.mark.parametrize("text", ["a: [", "nothing", "x: {y: 1}", "\x00"])
def test_a_file_that_is_none_is_refused_in_one_line(session, text):
    with pytest.raises(SettingError) as error:
        session.load(text, "my/own.yaml")
    assert "\n" not in str(error.value)
    assert session.tuning.staged_sets(NODES) == {}


class SlowGraph(SimulatedGraph):
    """Answers after a moment; who is frozen does not, and does everything when it is thawed."""

    def __init__(self, joints):
        super().__init__(joints)
        self.frozen = {}
        self.meanwhile = lambda: None

    def set(self, node, values):
        answer = Future()
        if node in self.frozen:
            self.sets.append((node, dict(values)))
            self.frozen[node].append(dict(values))
            told = Answer(False, "no answer within 2 s: it may have been taken", is_certain=False)
        else:
            told = super().set(node, values).result()
        asyncio.get_running_loop().call_later(0.05, self._tell, answer, told)
        return answer

    def _tell(self, answer, told):
        once, self.meanwhile = self.meanwhile, lambda: None
        once()
        answer.set_result(told)

    def thaw(self, node):
        for values in self.frozen.pop(node):
            super().set(node, values)

    def degrees(self):
        return [joint.settings.mu for joint in self.joints.values()]


@pytest.fixture
def slow():
    made = LiveSession(SlowGraph(arm()), None)
    made.pulse()
    return made


def test_two_acts_at_once_are_done_one_after_the_other(slow):
    async def act():
        for mu in (-0.3, -0.4):
            slow.tuning.stage(NODES, "mu", mu)
            await asyncio.gather(slow.apply(NODES), slow.apply(NODES))  # a double click
        assert len(slow.tuning.done) == 2
        await asyncio.gather(slow.undo(), slow.undo())

    asyncio.run(act())
    assert slow.graph.degrees() == [-0.2] * 3
    assert not slow.tuning.done


def test_who_was_frozen_does_not_take_alone_what_the_others_gave_back(slow):
    slow.graph.frozen[NODES[1]] = []
    slow.tuning.stage(NODES, "mu", -0.3)
    assert not asyncio.run(slow.apply(NODES))
    assert slow.graph.degrees() == [-0.2] * 3
    slow.graph.thaw(NODES[1])
    assert slow.graph.degrees() == [-0.2] * 3
    assert any("arm_joint_2: NOT restored: no answer" in each for each in lines(slow))


def test_what_somebody_else_sets_meanwhile_stays_when_others_refuse(slow):
    def lower():
        slow.graph.joints[NODES[0]].settings = loop_settings("arm_joint_1", 0.4, mu=0.0)

    slow.graph.refusals[NODES[1]] = "no"
    slow.graph.meanwhile = lower
    slow.tuning.stage(NODES, "mu", -0.3)
    assert not asyncio.run(slow.apply(NODES))
    assert slow.graph.degrees() == [0.0, -0.2, -0.2]


def seen_arm():
    made = Tuning()
    for node, settings in arm().items():
        made.see(node, settings.to_parameters())
    return made


@pytest.fixture
def tuning():
    return seen_arm()


def take(tuning, sets, what="a step"):
    """Do as if controllers had taken sets."""
    before = {node: dict(tuning.in_force[node]) for node in sets}
    for node, values in sets.items():
        tuning.see(node, {**before[node], **values})
    tuning.note(what, sets, before)


def test_what_is_in_force_already_is_not_staged(tuning):
    for mu, staged in ((-0.2, {}), (-0.1, {NODES[0]: {"mu": -0.1}}), (-0.2, {})):
        tuning.stage(NODES[:1], "mu", mu)
        assert tuning.staged_sets(NODES) == staged
    tuning.stage(NODES[:1], "gains.p", 90)  # an integer is a number, too
    assert type(tuning.value(NODES[0], "gains.p")) is float
    tuning.unstage()
    tuning.stage(NODES[:1], "mu", -0.1)
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "mu": -0.1})  # by somebody else
    assert tuning.staged_sets(NODES) == {}


def test_a_factor_is_of_what_each_has_in_force_however_often_it_is_turned(tuning):
    assert [tuning.factor(node, BANDWIDTH) for node in NODES] == pytest.approx([1.0] * len(NODES))
    for factor in (3.0, 0.7, 1.5):
        tuning.stage_factor(NODES, BANDWIDTH, factor)
    for node in NODES:
        before, after = tuning.in_force[node], tuning.chosen(node)
        ratios = [after[f"gains.{each}"] / before[f"gains.{each}"] for each in "pid"]
        assert ratios == pytest.approx([1.5**2, 1.5**3, 1.5])
        assert tuning.factor(node, BANDWIDTH) == pytest.approx(1.5)
    tuning.stage(NODES, "gains.d", 1.0)
    assert tuning.factor(NODES[0], BANDWIDTH) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((BANDWIDTH, each) for each in (0.0, -1.0, float("nan"), float("inf"), 1e200)),
        *(("mu", each) for each in (0.6, float("nan"), "fast", None, True)),
    ],
)
def test_a_value_that_cannot_be_stages_nothing(tuning, name, value):
    stage = tuning.stage_factor if name == BANDWIDTH else tuning.stage
    with pytest.raises(SettingError):
        stage(NODES, name, value)
    assert tuning.staged_sets(NODES) == {}


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(-0.45, 0.45)), min_size=1, max_size=8))
def test_undoing_every_step_leads_back_to_the_start(steps):
    tuning = seen_arm()
    for number, mu in steps:
        tuning.stage([NODES[number]], "mu", mu)
        take(tuning, tuning.staged_sets(NODES))
    while tuning.done:
        sets = tuning.undoing()
        for node, values in sets.items():
            tuning.see(node, {**tuning.in_force[node], **values})
        tuning.done.pop()
    assert tuning.in_force == tuning.first


def test_what_somebody_has_changed_since_is_not_undone(tuning):
    take(tuning, {NODES[0]: {"mu": -0.1, "gains.p": 50.0}})
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "mu": 0.1})
    assert tuning.undoing() == {NODES[0]: {"gains.p": 80.0}}
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "gains.p": 60.0})
    with pytest.raises(SettingError, match="somebody"):
        tuning.undoing()
    assert not tuning.done


def test_a_snapshot_is_come_back_to_from_anywhere(tuning):
    tuning.keep(" good ", NODES)
    take(tuning, {NODES[0]: {"mu": 0.3}, NODES[1]: {"gains.p": 3.0}})
    back = tuning.towards(tuning.snapshots["good"])
    assert back == {NODES[0]: {"mu": -0.2}, NODES[1]: {"gains.p": 40.0}}
    with pytest.raises(SettingError, match="name"):
        tuning.keep("  ", NODES)


def test_a_file_is_staged_for_the_controllers_that_it_names_or_whose_joints_it_has(tuning):
    loops = {
        "arm_joint_1_controller": {"joint": "arm_joint_1", "mu": 0.1},
        "of_another_name": {"joint": "arm_joint_2", "mu": 0.2},
    }
    assert tuning.stage_loops(loops) == NODES[:2]
    assert tuning.staged_sets(NODES) == {NODES[0]: {"mu": 0.1}, NODES[1]: {"mu": 0.2}}
    for name, joint in (("nobody", "nobody"), ("/right/arm_joint_1_controller", "arm_joint_1")):
        with pytest.raises(SettingError, match="no controller of this file is here"):
            tuning.stage_loops({name: {"joint": joint, "mu": 0.3}})


def test_sliders_reach_a_decade_to_either_side():
    assert slider_range("gains.p", 40.0) == pytest.approx((4.0, 400.0, True))
    assert slider_range("gains.i", 0.0) == (0.0, 10.0, False)
    low, high, _ = slider_range("mu", 0.0)
    assert -0.5 < low < 0 < high < 0.5
