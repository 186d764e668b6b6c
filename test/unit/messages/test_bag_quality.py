"""What a bag lacks, repeats and confuses, and what is left of it."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from harness.bags import (
    JOINT_STATE,
    MS,
    S,
    command,
    state,
    write_bag,
)
from harness.foreign_bags import (
    commands,
    in_order,
    read,
    states,
    write,
)
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import BagError
from hpid_ros.cli.main import main
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics import run_indices
from hpid_ros.metrics.quantities import find_quantities


def test_a_joint_that_is_there_for_a_while_says_so(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = []
    for k in range(100):
        joints = {"a": 0.0, "late": 1.0} if 40 <= k < 60 else {"a": 0.0}
        log += [("/joint_states", k * MS, state(k * MS, **joints)[2])]
        log += [("/joint_commands", k * MS, command(k * MS, **joints)[2])]
    path = write(tmp_path / "bag", types, log)
    late = read_run(path, "run").quality.joints["late"].states
    assert (late.count, late.begin, late.end, late.lost) == (20, 0.04, 0.059, 0)
    run = read(path, start=0.07)
    assert run.joint_names == ("a",)
    assert "'late' is left out: it has no state in the window" in run.quality.notes[0]


@given(st.sets(st.integers(1, 998), min_size=1, max_size=60))
def test_every_message_that_was_removed_is_counted_as_lost(removed):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    kept = [k for k in range(1000) if k not in removed]
    log = [("/joint_states", k * MS, state(k * MS, a=0.0)[2]) for k in kept]
    log += [("/joint_commands", k * MS + 1, command(k * MS, a=1.0)[2]) for k in range(1000)]
    with tempfile.TemporaryDirectory() as folder:
        run = read_run(write(Path(folder) / "bag", types, in_order(log)), "run")
    quality = run.quality.joints["a"]
    assert quality.states.lost == len(removed)
    assert quality.states.gaps == int(np.count_nonzero(np.diff(kept) > 1))
    assert quality.states.longest_gap == pytest.approx(float(np.diff(kept).max()) * 1e-3)
    longest = kept[int(np.argmax(np.diff(kept)))]
    assert quality.states.longest_gap_at == pytest.approx((longest - kept[0]) * 1e-3)
    assert quality.commands.is_complete
    assert not run.quality.is_complete


def test_repeats_disorder_and_numbers_that_are_none_are_counted(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    nan, infinite, huge = float("nan"), float("inf"), -1e50
    stamps = [(1, 0.5), (3, 0.5), (2, 0.5), (3, 0.5), (4, nan), (5, infinite), (6, 0.5), (7, huge)]
    log = [("/joint_states", k, state(t, a=x)[2]) for k, (t, x) in enumerate(stamps)]
    log += [("/joint_commands", 9, command(t, a=x)[2]) for t, x in ((1, 1.0), (2, nan))]
    run = read_run(write(tmp_path / "bag", types, log), "run")
    assert run.joints[0].state_stamps_ns.tolist() == [1, 2, 3, 6]
    found = run.quality.joints["a"].states
    assert (found.count, found.repeated, found.out_of_order, found.not_finite) == (4, 1, 1, 3)
    assert run.quality.joints["a"].commands.not_finite == 1


def test_messages_that_were_logged_out_of_order_are_put_in_order(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [("/joint_states", 1, state(1, a=0.0)[2])]
    log += [("/joint_commands", t, command(1, a=float(t))[2]) for t in (5, 9, 7)]
    run = read_run(write(tmp_path / "bag", types, log), "run")
    assert run.joints[0].effort.tolist() == [9.0]
    log = [("/joint_states", 1, state(1, a=0.0)[2])]
    framed = JointStateTemplate(["a"], "a frame of its own", effort=True)
    for t in range(10):
        raw = framed.encode(1, effort=[t]) if t % 3 else command(1, a=float(t))[2]
        log += [("/joint_commands", t, raw)]
    run = read_run(write(tmp_path / "turns", types, log), "run")
    assert run.joints[0].effort.tolist() == [9.0]
    assert run.losses["a"].repeated_commands == 9


def test_states_without_stamps_need_the_receive_time(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [("/joint_states", k * MS, state(0, a=1.0 * k)[2]) for k in (1, 2, 3)]
    log += [("/joint_commands", 4 * MS, command(0, a=1.0)[2])]
    path = write(tmp_path / "bag", types, log)
    with pytest.raises(BagError, match="carry no stamps; read them with clock 'receive'"):
        read_run(path, "run")
    run = read(path, clock="receive")
    assert run.joints[0].position.tolist() == [1.0, 2.0, 3.0]
    assert run.joints[0].command_stamps_ns.tolist() == [4 * MS]


def test_messages_that_are_not_of_their_type_are_left_out_and_reported(tmp_path):
    types = {"/joint_states": JOINT_STATE, "/joint_commands": JOINT_STATE}
    log = [*states(), ("/joint_states", 9 * S, b"\x00\x01\x00\x00junk"), *commands()]
    run = read_run(write(tmp_path / "bag", types, in_order(log)), "run")
    assert len(run.joints[0].position) == 5
    (line,) = run.quality.unreadable
    assert line.startswith("1 messages on /joint_states are left out: a JointState of 8 bytes")


def test_states_and_commands_without_common_time_give_one_warning_and_no_energy(tmp_path, capsys):
    log = []
    for k in range(100):
        log += [state(k * MS, a=0.01 * k, b=0.0)]
        log += [("joint_commands", k * MS + 5, command(S * 10**9 + k * MS, a=1.0 + k, b=1.0)[2])]
    bag = write_bag(tmp_path / "bag", log)
    run = read(bag)
    (line,) = run.quality.notes
    assert "states and commands of a, b are on clocks that do not overlap" in line
    assert "0.000 s to 0.099 s and 1000000000.000 s to 1000000000.099 s" in line
    assert main(["metrics", str(bag), "--indices", "energy"]) == 0
    numbers = run_indices(run)
    energy = find_quantities(["energy"])[0]
    assert all(math.isnan(numbers.value(energy, joint)) for joint in (None, "a", "b"))
    assert numbers.joints["a"].ivc == 99.0
    assert "are on clocks that do not overlap" in capsys.readouterr().err
    both = run_indices(read(bag, clock="receive"))
    assert both.value(energy) > 0.0


def test_one_joint_without_energy_leaves_no_sum(tmp_path):
    shared = JointSeries("a", *_series(0), *_series(0)[:2])
    foreign = JointSeries("b", *_series(0), *_series(S)[:2])
    energy = find_quantities(["energy"])[0]
    numbers = run_indices(RunSeries("run", (shared, foreign)))
    assert numbers.value(energy, "a") > 0.0
    assert math.isnan(numbers.value(energy))


def _series(start_ns):
    numbers = np.arange(10.0)
    return start_ns + MS * np.arange(10), numbers, numbers
