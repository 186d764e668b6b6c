"""Interrupts are postponed where a new process is written down, and never lost."""

import os
import signal

import pytest
from harness.interrupts import heeded_interrupts

from hpid_ros.base.processes import raise_if_interrupted, uninterrupted


@pytest.fixture(autouse=True)
def handlers():
    with heeded_interrupts():
        yield


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_for_the_end_of_the_block(number):
    done = []

    def start():
        with uninterrupted():
            os.kill(os.getpid(), number)
            done.append("written down")
        done.append("not reached")

    with pytest.raises(KeyboardInterrupt):
        start()
    assert done == ["written down"]


def test_outside_it_comes_at_once_and_is_remembered():
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        raise_if_interrupted()
    with uninterrupted():  # cleaning up may start what it needs
        pass
