"""Interrupts are postponed while a new process is written down; work in other processes."""

import os
import signal
import sys

import pytest
from harness.chores import LOCK, behind_a_lock, deadly, faulty, heeded_interrupts

from hpid_ros.base.errors import RunError
from hpid_ros.base.processes import processors, raise_if_interrupted, side_by_side, uninterrupted


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_for_the_end_of_the_block(number):
    done = []

    def start():
        with uninterrupted():
            os.kill(os.getpid(), number)
            done.append("written down")
        done.append("not reached")

    with heeded_interrupts(), pytest.raises(KeyboardInterrupt):
        start()
    assert done == ["written down"]


def test_outside_it_comes_at_once_and_is_remembered():
    with heeded_interrupts():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            raise_if_interrupted()
        with uninterrupted():  # cleaning up may start what it needs
            pass


def squares(tasks, *jobs):
    """Return the squares of tasks in their order, and which other processes worked on them."""
    results = dict(side_by_side(behind_a_lock, tasks, *jobs))
    others = {process for _, process in results.values()} - {os.getpid()}
    return [results[place][0] for place in range(len(tasks))], len(others)


@pytest.mark.parametrize("jobs", [1, None])
def test_each_task_has_its_result_whatever_the_number_of_processes(jobs):
    found, others = squares(range(7), jobs)
    assert found == [each**2 for each in range(7)]
    assert others <= (jobs or processors())
    assert bool(others) == (jobs is None and processors() > 1)


def test_a_lock_that_a_thread_holds_here_is_free_there():
    with LOCK:  # a fork would inherit it as it stands, and wait for ever
        assert squares([2, 3], 2)[0] == [4, 9]


def test_one_task_or_no_joblib_needs_no_other_process(monkeypatch):
    assert squares([3]) == ([9], 0)
    assert squares([]) == ([], 0)
    monkeypatch.setitem(sys.modules, "joblib", None)
    assert squares([1, 2]) == ([1, 4], 0)


def test_a_process_that_died_is_an_error_that_names_what_it_may_have_had():
    with pytest.raises(RunError, match=r"a process died during one of these: .*<poison>"):
        list(side_by_side(deadly, ["a", "poison", "b"], 2, name="<{}>".format))
    assert dict(side_by_side(deadly, ["a", "b"], 2)) == {0: "A", 1: "B"}


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_task_raises_is_raised_here(jobs):
    with pytest.raises(ValueError, match="not 4"):
        list(side_by_side(faulty, [4, 4], jobs))
