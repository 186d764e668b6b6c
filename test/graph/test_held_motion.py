"""A motion that goes on while a button is held: whatever ends the holding ends the motion."""

import os
import pickle
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from harness.graph import change, state
from harness.turntable import INERTIA, positions, start_turntable, wait_for_rest

from hpid_bench.live.exciter import DeadMan
from hpid_bench.live.motion import HELD_WITHIN, Button, HeldMotion, bounds_of, chosen_controllers
from hpid_bench.live.running_controllers import running_graph
from hpid_ros.base.errors import RunError
from hpid_ros.motion.excitation import Design, Wish, plan

NODE = "/turn_controller"

PARENT = """
import pickle, sys, time
from hpid_bench.live.motion import HeldMotion
motion = HeldMotion(*pickle.load(open(sys.argv[1], "rb")))
while motion.stage != "ended":
    motion.press()
    print(motion.seconds, flush=True)
    time.sleep(0.05)
"""


@pytest.fixture(scope="module")
def turntable(module_harness, tmp_path_factory):
    start_turntable(module_harness, tmp_path_factory.mktemp("turntable"), pace=0.5)
    return module_harness, running_graph()


@pytest.fixture
def bench(turntable, tmp_path):
    """Return the bench, whose controller is active again when a test has ended, however."""
    bench = Bench(*turntable, tmp_path)
    yield bench
    if state(bench.harness, NODE) != "active":
        assert change(bench.harness, "activate", NODE)


class Bench:
    """Slow motions of the turntable, and a thumb on the button."""

    def __init__(self, harness, graph, folder):
        self.harness, self.graph, self.folder = harness, graph, folder
        self.controllers = chosen_controllers(graph, [])

    def order(self, name):
        """Return what a motion from where the joint rests is made of."""
        position = wait_for_rest(self.harness)
        (bounds,) = [bounds_of(each, INERTIA) for each in self.controllers]
        design = Design(kind="minimum_jerk", duration=8.0)
        made = plan([replace(bounds, position=position)], Wish(amplitude=0.4), design)
        return made, self.controllers, self.graph, self.folder / name

    def stop_the_joint(self):
        """Deactivate its controller, and return when its last command, a zero, has come."""
        assert change(self.harness, "deactivate", NODE)
        commands = self.harness.commands

        def is_left():
            before, last = commands[-2:]
            return last.effort == (0.0,) and last.stamp_ns == before.stamp_ns  # a second answer

        self.harness.wait(is_left, what="the last command")
        self.harness.seen.clear()
        commands.clear()

    def reach(self, motion, condition, press=False):
        def is_there():
            if press:
                motion.press()
            return motion.stage == "ended" or condition()

        self.harness.wait(is_there, what="the motion")

    def ending(self, motion):
        self.reach(motion, lambda: False)
        return motion.ending


@pytest.fixture
def pipe(monkeypatch):
    """Return a process's end of a pipe whose other end is this one's standard input."""
    reader, writer = os.pipe()
    with os.fdopen(reader) as source, os.fdopen(writer, "wb", 0) as sink:
        monkeypatch.setattr(sys, "stdin", source)
        yield SimpleNamespace(stdin=sink)


def test_a_button_is_held_as_long_as_presses_come_and_not_after_its_release(pipe, monkeypatch):
    button, dead_man = Button(), DeadMan(HELD_WITHIN)
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    button.press()  # there is nobody yet
    assert not dead_man.is_held()
    with button.held_for(pipe):
        for _ in range(20):
            button.press()
            assert dead_man.is_held()
            now[0] += 0.9 * HELD_WITHIN
            assert dead_man.is_held()
        button.press()
        now[0] += 1e9  # the process stood still, and cannot know when it was pressed
        assert dead_man.is_held()
        dead_man.forget()
        assert not dead_man.is_held()
        button.press()
        now[0] += 0.1
        assert dead_man.is_held()
        now[0] += 1.1 * HELD_WITHIN
        assert not dead_man.is_held()
        assert not dead_man.is_gone
        button.press()
        assert dead_man.is_held()
        button.release()
        button.press()
        assert not dead_man.is_held()
        assert dead_man.is_gone
        assert not button.is_overdue()
        now[0] += 60.0
        assert button.is_overdue()


def test_a_button_that_was_released_before_there_is_a_process_is_gone_at_once(pipe):
    button, dead_man = Button(), DeadMan(HELD_WITHIN)
    button.release()
    with button.held_for(pipe):
        assert not dead_man.is_held()
        assert dead_man.is_gone


@pytest.mark.faults
def test_joints_move_while_the_button_is_held_and_rest_when_it_is_not(bench):
    order = bench.order("held")
    began = wait_for_rest(bench.harness)
    motion = HeldMotion(*order, within=10.0 * HELD_WITHIN)
    bench.reach(motion, lambda: motion.stage == "ready")
    assert np.ptp(positions(bench.harness)) < 1e-3  # nobody has pressed
    assert motion.ending is None
    bench.reach(motion, lambda: motion.seconds > 0.5, press=True)
    pressed = time.monotonic()  # whoever allows a longer time may press less often
    bench.reach(motion, lambda: time.monotonic() > pressed + 3.0 * HELD_WITHIN)
    assert motion.stage == "moving", motion.ending
    ending = bench.ending(motion)  # nobody presses, nobody releases
    assert ending.reason == "the button was released"
    assert ending.is_at_rest
    assert motion.seconds < 8.0  # its end
    rests = wait_for_rest(bench.harness)
    assert abs(rests - began) > 0.01  # at its end it would be back
    assert (motion.bag / "metadata.yaml").exists()

    # Whoever holds the button is killed.
    file = bench.folder / "order"
    file.write_bytes(pickle.dumps((*bench.order("killed"), 10.0 * HELD_WITHIN)))
    bench.harness.seen.clear()
    holding = threading.Thread(target=hold_until_killed, args=(file, 1.0), daemon=True)
    holding.start()
    bench.harness.wait(lambda: not holding.is_alive(), what="the button's holder")
    bench.harness.wait(lambda: not bench.harness.is_there("hpid_exciter"), what="its end")
    # By little, where the first motion ended near a stop of the joint.
    assert np.ptp([each.position[0] for each in bench.harness.seen]) > 1e-4
    wait_for_rest(bench.harness)


@pytest.mark.faults
def test_a_press_cannot_move_a_stopped_joint(bench):
    motion = HeldMotion(*bench.order("pressed"))
    bench.reach(motion, lambda: motion.stage == "ready")
    bench.stop_the_joint()
    with suppress(
        RunError
    ):  # where nothing was heard of the joint any more, before the first press
        bench.reach(motion, lambda: False, press=True)  # until it ends by itself
        assert motion.ending.reason
    assert not bench.harness.commands
    # It may have crept on the way to its target when it was left.
    assert np.ptp([each.position[0] for each in bench.harness.seen]) < 1e-3

    # Nor does what was told meanwhile move it when it is active again.
    assert change(bench.harness, "activate", NODE)
    assert np.ptp(positions(bench.harness, 1.0)) < 1e-3


@pytest.mark.faults
def test_a_motion_that_is_let_go_after_its_joint_was_stopped_ends_at_once(bench):
    motion = HeldMotion(*bench.order("released"))
    bench.reach(motion, lambda: motion.stage == "ready")
    bench.stop_the_joint()
    positions(bench.harness)  # until the motion knows that nobody tells a reference
    motion.release()
    # Not what it says where it has waited in vain for what it lacks.
    assert bench.ending(motion).reason == "the button was released before anything moved"
    assert not bench.harness.is_there("hpid_exciter")


def hold_until_killed(file, seconds):
    """Have a process of its own hold the button for so long."""
    command = [sys.executable, "-c", PARENT, str(file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        try:
            for line in parent.stdout:
                if float(line) > seconds:
                    break
        finally:
            parent.kill()
