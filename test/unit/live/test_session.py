"""A session does what the one person with control asks for, wholly or not at all."""

import asyncio
from concurrent.futures import Future

import pytest
from harness.simulated_graph import SimulatedGraph, arm, loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.live.controllers import Answer
from hpid_ros.live.session import ControlLock, Limit, LiveSession

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
    _, (mark,) = session.pulse()
    assert (mark.node, mark.text) == (NODES[0], "mu 0.1")
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
    assert any("arm_joint_2: NOT set back: no answer" in each for each in lines(slow))


def test_what_somebody_else_sets_meanwhile_stays_when_others_refuse(slow):
    def lower():
        slow.graph.joints[NODES[0]].settings = loop_settings("arm_joint_1", 0.4, mu=0.0)

    slow.graph.refusals[NODES[1]] = "no"
    slow.graph.meanwhile = lower
    slow.tuning.stage(NODES, "mu", -0.3)
    assert not asyncio.run(slow.apply(NODES))
    assert slow.graph.degrees() == [0.0, -0.2, -0.2]
