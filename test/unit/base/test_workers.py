"""Work in other processes of this machine."""

import os
import sys

import pytest
from harness.chores import LOCK, behind_a_lock, deadly, faulty

from hpid_ros.base.errors import RunError
from hpid_ros.base.processes import processors, side_by_side


@pytest.mark.parametrize("jobs", [1, 2, 3, None])
def test_each_task_has_its_result_whatever_the_number_of_processes(jobs):
    tasks = list(range(7))
    results = dict(side_by_side(behind_a_lock, tasks, jobs))
    assert [results[place][0] for place in tasks] == [each**2 for each in tasks]
    others = {process for _, process in results.values()} - {os.getpid()}
    wanted = jobs or processors()
    assert len(others) <= wanted
    assert bool(others) == (wanted > 1)


def test_a_lock_that_a_thread_holds_here_is_free_there():
    with LOCK:  # a fork would inherit it as it stands, and wait for ever
        results = dict(side_by_side(behind_a_lock, [2, 3], 2))
    assert {place: square for place, (square, _) in results.items()} == {0: 4, 1: 9}


def test_one_task_needs_no_other_process():
    assert list(side_by_side(behind_a_lock, [3])) == [(0, (9, os.getpid()))]
    assert list(side_by_side(behind_a_lock, [])) == []


def test_a_process_that_died_is_an_error_that_names_what_it_may_have_had():
    with pytest.raises(RunError, match=r"a process died during one of these: .*<poison>"):
        list(side_by_side(deadly, ["a", "poison", "b"], 2, name="<{}>".format))
    assert dict(side_by_side(deadly, ["a", "b"], 2)) == {0: "A", 1: "B"}


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_task_raises_is_raised_here(jobs):
    with pytest.raises(ValueError, match="not 4"):
        list(side_by_side(faulty, [4, 4], jobs))


def test_without_joblib_all_is_done_here(monkeypatch):
    monkeypatch.setitem(sys.modules, "joblib", None)
    results = dict(side_by_side(behind_a_lock, [1, 2]))
    assert results == {0: (1, os.getpid()), 1: (4, os.getpid())}
