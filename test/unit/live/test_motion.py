"""Only the process that moves joints reports that they rest."""

import subprocess

import pytest

from hpid_ros.base.errors import RunError
from hpid_ros.live import motion as watching
from hpid_ros.live.controllers import RunningGraph
from hpid_ros.live.motion import Ending, Mover, carried_out

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
