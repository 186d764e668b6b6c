"""A session does what a person asks for, wholly or not at all, and tells what became of it."""

import asyncio
from concurrent.futures import Future

import pytest
from harness.simulated_graph import SimulatedGraph, arm, loop_settings

from hpid_ros.base.errors import SettingError
from hpid_ros.live.controllers import Answer
from hpid_ros.live.session import LiveSession

NODES = sorted(arm())


class Unasked:
    """Advice that nobody needs."""

    def ask(self, *_):
        pass


@pytest.fixture
def graph():
    return SimulatedGraph(arm())


@pytest.fixture
def session(graph):
    made = LiveSession(graph, Unasked())
    made.pulse()
    return made


def lines(session):
    return [each.text for each in session.log]


def test_nothing_is_sent_by_looking_staging_and_keeping(session, graph):
    session.tuning.stage(NODES, "mu", -0.3)
    session.tuning.keep("a", NODES)
    session.pulse()
    session.pulse(is_seen=False)
    assert graph.sets == []
    assert graph.transitions == []


def test_what_is_staged_on_three_joints_is_one_set_each_and_one_step_to_undo(session, graph):
    session.tuning.stage(NODES, "mu", -0.3)
    session.tuning.stage_factor(NODES, "gains.p", 1.1)
    assert asyncio.run(session.apply(NODES))
    assert [node for node, _ in graph.sets] == NODES
    assert all(set(values) == {"mu", "gains.p"} for _, values in graph.sets)
    assert asyncio.run(session.undo())
    session.pulse()
    assert session.tuning.in_force == session.tuning.first
    assert session.tuning.done == []


def test_where_one_refuses_the_others_get_theirs_back_and_its_own_words_are_shown(session, graph):
    graph.refusals[NODES[1]] = "mu = -0.3 is not certified stable"
    session.tuning.stage(NODES, "mu", -0.3)
    assert not asyncio.run(session.apply(NODES))
    session.pulse()
    assert {node: each["mu"] for node, each in session.tuning.in_force.items()} == dict.fromkeys(
        NODES, -0.2
    )
    assert "arm_joint_2 refused: mu = -0.3 is not certified stable" in lines(session)
    assert session.tuning.done == []


def test_what_the_law_does_not_allow_is_not_even_sent(session, graph):
    session.tuning.stage(NODES[:1], "gains.i", 1e5)
    assert not asyncio.run(session.apply(NODES))
    assert graph.sets == []


def test_a_flood_of_sets_ends_at_the_page(session, graph):
    async def flood():
        for number in range(50):
            session.tuning.stage(NODES[:1], "mu", -0.1 - 1e-3 * number)
            await session.apply(NODES[:1])

    asyncio.run(flood())
    assert len(graph.sets) <= 5 + 1
    assert any("at most 5 a second" in line for line in lines(session))


def test_stop_leaves_no_controller_active(session, graph):
    assert asyncio.run(session.stop())
    assert graph.transitions == [(node, "deactivate") for node in NODES]
    assert not any(each.is_active for each in graph.joints.values())


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


def test_a_change_by_anybody_is_marked_and_told(session, graph):
    graph.set(NODES[0], {"mu": 0.1})
    session.pulse()
    assert session.marks[-1].node == NODES[0]
    assert session.marks[-1].text == "mu 0.1"
    assert session.tuning.in_force[NODES[0]]["mu"] == 0.1


def test_a_controller_that_goes_is_told_and_not_stopped_in_vain(session, graph):
    graph.gone.add(NODES[2])
    session.pulse()
    assert "arm_joint_3: its controller has gone" in lines(session)
    asyncio.run(session.stop())
    assert (NODES[2], "deactivate") not in graph.transitions


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
    made = LiveSession(SlowGraph(arm()), Unasked())
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
    assert slow.tuning.done == []


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
