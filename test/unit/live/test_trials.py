"""Test motions of the live page: to an end whatever a person, a page or their processes do."""

import asyncio
import subprocess
import threading

import numpy as np
import pytest
from harness.simulated_graph import SimulatedGraph, arm

from hpid_bench.live import motion as watching
from hpid_bench.live import trials as module
from hpid_bench.live.known_controllers import RunningGraph, Samples
from hpid_bench.live.motion import BUTTON_RELEASED, Ending, Mover, carried_out
from hpid_bench.live.session import LiveSession
from hpid_bench.live.trials import MotionWish, Trials, TrialStage, Tried, Variant
from hpid_ros.base.errors import HpidError, RunError

NODE, OTHER, *_ = arm()
PAGE = "page"
IN_FORCE, CHOSEN = Variant("in force"), Variant("chosen", {NODE: {"gains.p": 99.0}})


class Motion:
    """Is soon ready, moves when it is pressed, and ends for a reason or when it is released."""

    def __init__(self, bag, reason=None):
        self.bag, self.stage, self.ending = bag, "preparing", None
        self._reason, self.presses = reason, 0
        asyncio.get_running_loop().call_later(0.1, self._be_ready)

    def _be_ready(self):
        if self.stage == "preparing":
            self.stage = "ready"

    def press(self):
        self.presses += 1
        if self.stage == "ready":
            self.stage = "moving"
        elif self._reason is not None:
            self._end(self._reason)

    def release(self):
        if self.stage != "ended":
            self._end(BUTTON_RELEASED)

    def _end(self, reason):
        began_at = () if self.stage == "preparing" else tuple(self.began_at)
        self.ending = Ending(reason, is_interrupted=False, is_at_rest=True, began_at=began_at)
        self.stage = "ended"


class Bench:
    """Trials of one joint, and the motions that were begun."""

    def __init__(self, reason=None, motion=Motion):
        self.graph = SimulatedGraph(arm())
        self.session = LiveSession(self.graph, None)
        self.session.pulse()
        self.session.control_lock.join(PAGE)
        self.before = self.gain
        self.motions = []
        self.trials = Trials(self.session)
        module.HeldMotion = self._start
        self._reason, self._motion = reason, motion

    def _start(self, planned, controllers, graph, bag, within, ends_at=None):
        self.motions.append(motion := self._motion(bag, self._reason))
        motion.planned, motion.ends_at = planned, ends_at
        motion.began_at = [
            self.session.history(each.node).reference or 0.0 for each in controllers
        ]
        return motion

    def stand(self, place):
        """Have the joint and its reference stand somewhere."""
        now = self.session.history(NODE).now + 1.0
        row = np.array([[now if np.isfinite(now) else 0.0, place, 0.0]])
        self.session.history(NODE).append(Samples(row, row[:0, :2], row))

    def run(self, course, variants=(IN_FORCE,), nodes=(NODE,)):
        """Carry a trial out while somebody does something."""

        async def both():
            trial = self.trials.run(PAGE, list(nodes), MotionWish(), variants, is_kept=False)
            await asyncio.wait_for(asyncio.gather(trial, course(self)), 20.0)

        asyncio.run(both())
        assert self.trials.stage is TrialStage.IDLE
        return self.trials.said

    @property
    def gain(self):
        return self.graph.joints[NODE].settings.gains.p

    async def move(self, motion=1):
        """Press the button of a motion that becomes ready."""
        await self.reach(TrialStage.READY, motion)
        self.trials.release(PAGE)  # of the motion before
        self.trials.press(PAGE)
        await self.reach(TrialStage.MOVING, motion)

    async def hold(self, motions=1):
        """Hold the button of each motion until it ends."""
        for motion in range(1, motions + 1):
            await self.move(motion)
            self.trials.press(PAGE)

    async def reach(self, stage, motions=1):
        while self.trials.stage is not stage or len(self.motions) < motions:
            await asyncio.sleep(0)  # what it waits for lasts no longer than a timer


@pytest.fixture(autouse=True)
def no_process(monkeypatch, tmp_path):
    """Have what a bench puts in the place of motions removed with the test, and its folders."""
    monkeypatch.setattr(module, "HeldMotion", None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


@pytest.fixture
def measuring(monkeypatch):
    """Return a function that says what is done in the place of measuring, and of comparing."""

    def put(measure=lambda *_: None, compare=lambda *_: None):
        def compared(*given):
            compare(*given)
            return "what was found"

        monkeypatch.setattr(module, "measure_motion", measure)
        monkeypatch.setattr(module.TrialResult, "of", compared)

    return put


@pytest.mark.parametrize(
    ("stage", "motions"),
    [(TrialStage.PREPARING, 0), (TrialStage.PREPARING, 1), (TrialStage.READY, 1)],
)
@pytest.mark.parametrize("variants", [(CHOSEN, IN_FORCE), (CHOSEN,)])
def test_a_trial_that_is_cancelled_sets_back_and_does_not_become_ready(variants, stage, motions):
    async def cancel(bench):
        await bench.reach(stage, motions)
        assert len(bench.motions) == motions
        if motions:
            assert bench.gain == 99.0
            assert bench.trials.unfinished() == [bench.session.label(NODE)]
        bench.trials.cancel()

    bench = Bench()
    assert bench.run(cancel, variants) == "cancelled"
    assert bench.trials.unfinished() == []
    assert bench.gain == bench.before
    called = any("hold the button" in each.text for each in bench.session.log)
    assert called == (stage is TrialStage.READY)


@pytest.mark.parametrize("place", ["measure", "compare"])
def test_a_trial_that_is_cancelled_while_its_last_motion_is_measured_sets_back(place, measuring):
    bench = Bench("")  # a motion that is pressed twice comes to its end
    in_force = Variant("in force", {NODE: bench.graph.joints[NODE].settings.to_parameters()})

    def cancel(*_):
        if len(bench.motions) == 2:
            bench.trials.cancel()

    measuring(**{place: cancel})
    assert bench.run(lambda bench: bench.hold(2), (in_force, CHOSEN)) == "cancelled"
    assert bench.trials.result == "what was found"
    assert bench.gain == bench.before


def test_what_is_chosen_during_a_trial_is_not_what_was_chosen_before_it():
    async def choose(bench):
        await bench.reach(TrialStage.READY)
        bench.session.tuning.stage([NODE], "gains.p", 60.0)
        bench.trials.cancel()

    bench = Bench()
    bench.session.tuning.stage([NODE], "gains.p", 99.0)
    bench.session.tuning.stage([NODE], "gains.d", 9.0)
    chosen = Variant("chosen", {NODE: bench.session.tuning.chosen(NODE)})
    bench.run(choose, (chosen,))
    assert bench.session.tuning.staged[NODE] == {"gains.p": 60.0, "gains.d": 9.0}


def take_control(bench):
    bench.session.control_lock.join("another", "192.0.2.7")
    bench.session.take_control("another")


@pytest.mark.parametrize("motion", [1, 2])
def test_a_page_that_loses_control_while_a_motion_is_measured_has_nothing_more_set(
    motion, measuring, monkeypatch
):
    bench = Bench("")
    cancel, is_cancelled = bench.trials.cancel, threading.Event()

    def noted(*why):
        cancel(*why)
        is_cancelled.set()

    def measured(*_):
        if len(bench.motions) == motion:
            take_control(bench)
            assert is_cancelled.wait(10.0)  # beside it: it cannot be cancelled itself

    monkeypatch.setattr(bench.trials, "cancel", noted)
    measuring(measured)
    line = "ended: page 2 at 192.0.2.7 has taken control"
    assert bench.run(lambda bench: bench.hold(motion), (IN_FORCE, CHOSEN)) == line
    assert bench.session.log[-1].text != line
    assert "page 2 at 192.0.2.7 has taken control from page 1" in [
        each.text for each in bench.session.log
    ]
    assert len(bench.motions) == motion
    assert bench.gain == bench.before


def test_what_is_kept_of_a_trial_is_what_was_tried_alone(measuring):
    """A snapshot is of all joints, and has what nobody wanted to try."""
    bench = Bench("")
    everything = {
        node: each.settings.to_parameters() | {"gains.p": 99.0}
        for node, each in bench.graph.joints.items()
    }
    shown = []
    measuring(compare=lambda variants, _: shown.extend(variants))
    bench.run(Bench.hold, (Variant("a", everything),))
    (variant,) = shown
    assert set(variant.values) == {NODE}


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (take_control, "ended: page 2 at 192.0.2.7 has taken control"),
        (
            lambda bench: bench.session.control_lock.leave(PAGE),
            "ended: its page has been gone for 0.2 s",
        ),
        (
            lambda bench: bench.graph.change_state(NODE, "deactivate"),
            "arm_joint_1 is inactive: activate it first",
        ),
    ],
)
def test_what_others_do_ends_a_trial_before_it_is_pressed(act, said, monkeypatch):
    async def meanwhile(bench):
        await bench.reach(TrialStage.READY)
        act(bench)

    monkeypatch.setattr(module, "_GONE_FOR", 0.2)
    assert Bench().run(meanwhile) == said


def test_a_motion_that_a_limit_stopped_is_not_tried_again():
    left = []

    async def hold(bench):
        await bench.reach(TrialStage.READY)
        left.append(bench.trials.seconds_left)
        await bench.move()
        left.append(bench.trials.seconds_left)
        await asyncio.sleep(0.1)
        left.append(bench.trials.seconds_left)
        bench.trials.press(PAGE)

    bench = Bench("joint 1 is too fast")
    assert bench.run(hold) == "stopped: joint 1 is too fast"
    assert len(bench.motions) == 1
    before, begun, later = left  # for how long the button has to be held
    assert before is bench.trials.seconds_left is None
    assert 0.0 < later <= begun - 0.1
    assert begun <= bench.trials.plan([NODE], MotionWish()).duration


def test_who_is_left_is_set_back_where_the_controller_of_another_joint_ends_in_the_motion():
    async def end_one(bench):
        await bench.move()
        bench.graph.gone.add(OTHER)
        bench.graph.refusals[OTHER] = "no answer within 2 s: it may have been taken"
        bench.motions[0].press()

    bench = Bench(f"the controller of {OTHER} has published no reference for 0.5 s")
    both = Variant("chosen", {NODE: {"gains.p": 99.0}, OTHER: {"gains.p": 49.0}})
    said = bench.run(end_one, (both, IN_FORCE), [NODE, OTHER])
    assert bench.gain == bench.before
    assert "NOT every controller was restored" in said


def test_a_trial_leaves_alone_what_somebody_else_sets_meanwhile():
    async def lower_the_effort(bench):
        await bench.reach(TrialStage.READY)
        bench.graph.set(NODE, {"u_clamp_max": 5.0, "gains.d": 9.0})
        bench.session.pulse()
        await bench.move()
        bench.motions[0].press()
        await bench.reach(TrialStage.IDLE)

    bench = Bench("a limit was reached")
    before = bench.graph.joints[NODE].settings.to_parameters()
    chosen = Variant("chosen", {NODE: {**before, "gains.p": 99.0, "gains.d": 8.5}})
    bench.run(lower_the_effort, (chosen, Variant("in force", {NODE: before})))
    settings = bench.graph.joints[NODE].settings
    assert (settings.effort.u_clamp_max, settings.gains.d) == (5.0, 9.0)
    assert settings.gains.p == before["gains.p"]


def test_what_a_trial_sets_for_its_next_motion_is_only_what_its_motions_differ_in():
    before = {NODE: {"gains.p": 80.0, "gains.d": 8.0, "u_clamp_max": 50.0}}
    first, then = ({NODE: {**before[NODE], "gains.p": p}} for p in (80.0, 99.0))
    tried = Tried(before, (Variant("in force", first), Variant("chosen", then)))
    assert tried.wanted(Variant("chosen", then)) == {NODE: {"gains.p": 99.0}}
    assert tried.wanted(Variant("in force", first)) == {NODE: {"gains.p": 80.0}}


def test_an_interrupted_trial_goes_back_and_begins_again_where_it_began_first():
    """It walked on: each attempt began where the one before had stopped."""

    async def let_go_twice(bench):
        begins = []
        for attempt in (1, 3, 5):
            await bench.move(attempt)
            begins.append(bench.session.history(NODE).reference)
            if attempt == 5:
                break
            bench.stand(0.6 + 0.02 * attempt)
            bench.trials.release(PAGE)
            await bench.move(attempt + 1)  # back, while it is held
            back = bench.motions[attempt]
            assert back.ends_at == [0.6]
            assert back.planned.positions[-1] == pytest.approx([-0.02 * attempt])
            bench.stand(0.6)
            bench.trials.press(PAGE)
        bench.trials.cancel()
        return begins

    bench = Bench("")
    bench.stand(0.6)
    begun = []

    async def course(bench):
        begun.extend(await let_go_twice(bench))

    bench.run(course)
    assert begun == [0.6, 0.6, 0.6]
    line = "trial: in force, back to where the motion began: hold the button"
    assert any(each.text.startswith(line) for each in bench.session.log)


def test_a_way_back_that_is_let_go_is_asked_for_again():
    async def let_go(bench):
        await bench.move()
        bench.stand(0.5)
        bench.trials.release(PAGE)
        await bench.move(2)
        bench.stand(0.55)
        bench.trials.release(PAGE)
        await bench.move(3)
        assert bench.motions[2].planned.positions[-1] == pytest.approx([0.05])
        bench.trials.cancel()

    bench = Bench("")
    bench.stand(0.6)
    assert bench.run(let_go) == "cancelled"
    assert [each.ends_at for each in bench.motions] == [None, [0.6], [0.6]]


def test_a_trial_that_is_cancelled_elsewhere_offers_to_go_back_and_one_that_is_done_does_not():
    async def cancel(bench):
        await bench.move()
        bench.stand(0.65)
        bench.trials.cancel()

    async def come_back(bench):
        await bench.move(2)
        bench.stand(0.6)
        bench.trials.press(PAGE)

    bench = Bench("")
    bench.stand(0.6)
    assert bench.run(cancel) == "cancelled"
    assert bench.trials.away([NODE]) == "arm_joint_1 is 0.05 rad from where the motion began"
    assert bench.trials.away([OTHER]) == ""

    async def both():
        going = bench.trials.go_back(PAGE, [NODE], MotionWish())
        await asyncio.wait_for(asyncio.gather(going, come_back(bench)), 20.0)

    asyncio.run(both())
    assert bench.motions[1].ends_at == [0.6]
    assert bench.trials.said == "done"
    bench.stand(0.9)  # somebody else has moved it
    assert bench.trials.away([NODE]) == ""


class Tapped(Motion):
    """Has not said yet that it moves when the button is let go."""

    def press(self):
        self.presses += 1


@pytest.mark.parametrize("motion", [Motion, Tapped])
def test_a_motion_whose_button_was_let_go_is_prepared_once_more_until_it_is_cancelled(motion):
    async def let_go(bench):
        await bench.reach(TrialStage.READY)
        bench.trials.press(PAGE)
        if motion is Motion:
            await bench.reach(TrialStage.MOVING)
        bench.trials.release(PAGE)
        assert bench.motions[0].stage == "ended"
        await bench.reach(TrialStage.READY, motions=2)
        bench.trials.release(PAGE)  # nobody has pressed it
        assert bench.motions[1].stage == "ready"
        bench.trials.cancel()

    bench = Bench(motion=motion)
    assert bench.run(let_go) == "cancelled"
    assert len({each.bag for each in bench.motions}) == 2
    assert any(BUTTON_RELEASED in each.text for each in bench.session.log)


@pytest.mark.parametrize("stage", [TrialStage.PREPARING, TrialStage.READY, TrialStage.MOVING])
def test_stop_ends_a_trial_at_once_and_no_press_moves_anything_afterwards(stage):
    async def stop(bench):
        await bench.reach(TrialStage.PREPARING, motions=1)
        if stage is TrialStage.READY:
            await bench.reach(stage)
        elif stage is TrialStage.MOVING:
            await bench.move()
        stopping = asyncio.ensure_future(bench.trials.stop())
        await asyncio.sleep(0)
        assert bench.trials.stage is TrialStage.ENDING  # nothing has been waited for
        assert bench.trials.said.startswith("ended by Stop")
        (motion,) = bench.motions
        assert motion.stage == "ended"
        for _ in range(3):
            bench.trials.press(PAGE)
            await asyncio.sleep(0.02)
            assert motion.presses == (stage is TrialStage.MOVING)
        assert await stopping

    bench = Bench()
    assert asyncio.run(bench.trials.stop())  # of nothing: nothing is said
    assert (bench.trials.stage, bench.trials.said) == (TrialStage.IDLE, "")
    asyncio.run(bench.session.transit([NODE], "activate"))
    assert bench.run(stop).startswith("ended by Stop: activate the joints")
    assert len(bench.motions) == 1
    assert not any(each.is_active for each in bench.graph.joints.values())
    bench.trials.press(PAGE)
    assert bench.trials.said.startswith("ended by Stop")
    with pytest.raises(HpidError, match="is inactive: activate it first"):
        bench.trials.plan([NODE], MotionWish())


@pytest.mark.parametrize("is_held_on", [True, False])
def test_a_press_that_is_too_early_is_answered_and_does_not_count_until_it_is_let_go(is_held_on):
    async def press_early(bench):
        trials = bench.trials
        await bench.reach(TrialStage.PREPARING, motions=1)
        trials.press(PAGE)
        assert trials.said.startswith("not ready yet: let go, and press again")
        if not is_held_on:
            trials.release(PAGE)
        while trials.stage is not TrialStage.READY:
            if is_held_on:
                trials.press(PAGE)
            await asyncio.sleep(0.02)
        if is_held_on:
            assert trials.said == "in force: ready: let go, then hold the button"
            trials.press(PAGE)
            assert bench.motions[0].stage == "ready"
            trials.release(PAGE)
        assert trials.said.startswith("in force: hold the button")
        await bench.move()
        trials.cancel()

    bench = Bench()
    bench.run(press_early)
    early = [each for each in bench.session.log if "not ready yet" in each.text]
    assert len(early) == 1  # however long it is held


# --- only the process that moves joints reports that they rest

MOVER = Mover("mover", "live.exciter", "joints go on", ())


class Process:
    """A process that says something, and that signals end."""

    def __init__(self, seconds, events=()):
        self.process = subprocess.Popen(["sleep", str(seconds)], stdin=subprocess.PIPE)
        self._events = list(events)

    def read_events(self):
        events, self._events = self._events, []
        return events

    def last_words(self):
        return "it printed nothing"


class Group:
    """Two processes in the place of nodes."""

    def __init__(self, mover, recorder):
        self.nodes = {MOVER.name: mover, watching.RECORDER: recorder}

    def start(self, name, *_, **__):
        return self.nodes[name]

    def stop(self, names, patience):
        for name in names:
            self.nodes[name].process.terminate()
            self.nodes[name].process.wait()
            self.nodes[name].process.returncode = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop(list(self.nodes), 0.0)


@pytest.fixture
def ending(tmp_path, monkeypatch):
    """Return how it ends with these two processes."""

    def carry_out(mover, recorder):
        monkeypatch.setattr(watching, "NodeGroup", lambda *_: Group(mover, recorder))
        graph = RunningGraph({}, has_commands=True)
        return carried_out(MOVER, {}, graph, "/", tmp_path / "bag", lambda *_: None)

    return carry_out


def test_who_ends_without_a_word_is_not_taken_to_have_stopped_the_joints(ending):
    with pytest.raises(RunError, match=r"recorder has ended.*mover has ended.*joints go on"):
        ending(Process(60), Process(0))


@pytest.mark.parametrize("is_at_rest", [True, False])
def test_who_is_asked_to_stop_says_whether_the_joints_rest(ending, is_at_rest):
    stopped = {"event": "stopped", "reason": "it was interrupted", "is_at_rest": is_at_rest}

    class Told(Process):
        def read_events(self):
            return [stopped] if self.process.poll() is not None else []

    found = ending(Told(60), Process(0))
    assert found.is_at_rest is is_at_rest
    assert "the recorder has ended" in found.reason


def test_who_says_that_it_is_done_and_does_not_end_has_done_it(ending, monkeypatch):
    monkeypatch.setattr(watching, "_ENDS_WITHIN", 0.1)
    done = {"event": "done", "reason": "", "is_at_rest": True}
    assert ending(Process(60, [done]), Process(60)) == Ending("")
