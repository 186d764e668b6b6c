"""The benchmarks measure what they say: their statistics, their file, their graphs."""

import json
import os
import signal
import subprocess
import sys

import pytest
from harness.places import ROOT
from harness.studies import children_of, is_alive, wait_until

pytest.importorskip("simple_pid", reason="the extra bench is not installed")

from harness.engines import INSTALLED

from benchmarks import __main__ as command
from benchmarks import results
from benchmarks.engine import group as engine_group
from benchmarks.figures import Bound, Figure, Group, Outcome, Source
from benchmarks.loops import run_floor
from benchmarks.measuring import figures_of
from benchmarks.merging import FORMS, Load, measure
from hpid_ros.base.errors import RunError

pytestmark = pytest.mark.repository

RATIO = Bound("ratio", least=2.0)


def figure(name="a.b", bounds=(RATIO,)):
    return Figure(name, "us", Source("ours", "time"), Source("peer", "time"), "a peer", bounds)


def outcome(ours, peer, **options):
    return Outcome.of(figure(**options), [{"time": x} for x in ours], [{"time": x} for x in peer])


def counting(values):
    """Return a measurement that gives one value after the other."""
    rest = iter(values)
    return lambda: {"time": next(rest)}


def test_ratio_is_that_of_each_round_so_a_slow_phase_of_the_machine_cancels():
    found = outcome([2.0, 20.0, 200.0], [1.0, 10.0, 100.0])
    assert found.ratio == (2.0, 2.0, 2.0)
    # Of the medians it would be 0.5: ours 4, the peer's 8.
    assert outcome([4.0, 1.0, 9.0], [1.0, 8.0, 9.0]).ratio.median == 1.0


def test_a_target_is_met_by_the_medians():
    for bound, is_met in (
        (Bound("ratio", least=2.0), True),
        (Bound("ratio", least=2.01), False),
        (Bound("ratio", most=2.0), True),
        (Bound("ours", most=3.9), False),
    ):
        assert outcome([4.0, 4.0, 4.0], [2.0, 2.0, 2.0], bounds=(bound,)).is_met is is_met
    assert outcome([4.0], [2.0], bounds=()).is_met is None


def test_both_sides_alternate_and_none_is_always_first():
    order = []
    contenders = {
        name: lambda name=name: order.append(name) or {"time": 1.0} for name in ("ours", "peer")
    }
    (found,) = figures_of(Group(contenders, (figure(),)), {"a.b"}, 4, lambda line: None)
    assert found.rounds == 4
    assert order == ["ours", "peer", "peer", "ours"] * 2


def test_a_failing_contender_costs_its_own_figures_alone_in_one_line():
    attempts = []

    def fail():
        attempts.append(None)
        raise RunError("nobody\nanswered")

    contenders = {"ours": counting([1.0, 1.0]), "peer": counting([2.0, 2.0]), "broken": fail}
    lost = Figure("a.c", "us", Source("broken", "time"), Source("peer", "time"), "a peer")
    group = Group(contenders, (figure(), lost))
    found, line = figures_of(group, {"a.b", "a.c"}, 2, lambda line: None)
    assert found.ratio.median == 0.5
    assert line == "a.c: not measured: broken: RunError: nobody\\nanswered"
    assert len(attempts) == 1


def test_no_figure_exists_twice():
    names = [each.name for group in command.all_groups(quick=True) for each in group.figures]
    assert len(set(names)) == len(names) > 0


def test_the_file_has_every_field_and_keeps_what_was_not_measured_again(tmp_path):
    file = tmp_path / "deep" / "machine.json"
    results.write(file, [outcome([4.0, 5.0, 6.0], [2.0, 2.0, 2.0], name="one")])
    results.write(file, [outcome([1.0], [1.0], name="two")])
    document = json.loads(file.read_text())
    assert set(document["figures"]) == {"one", "two"}
    entry = document["figures"]["one"]
    assert (entry["ours"], entry["reference"], entry["ratio"]) == (5.0, 2.0, 2.5)
    assert entry["spread"] == {"ours": [4.0, 6.0], "reference": [2.0, 2.0], "ratio": [2.0, 3.0]}
    assert entry["met"] is True

    assert os.uname().nodename not in file.read_text()
    document["versions"]["numpy"] = "0.1"  # figures of other versions do not stay
    found = results.document([outcome([1.0], [1.0], name="new")], document)["figures"]
    assert list(found) == ["new"]


def test_the_command_measures_what_is_named(tmp_path, capsys):
    arguments = ["law.pid", "--quick", "--rounds", "2", "--output", str(tmp_path)]
    assert command.main(arguments) == 0
    (file,) = tmp_path.iterdir()
    assert set(json.loads(file.read_text())["figures"]) == {"law.pid"}
    assert "law.pid" in capsys.readouterr().out


@pytest.mark.parametrize("engine", INSTALLED)
def test_a_bare_engine_makes_the_same_motion_as_the_loop(engine):
    """The contender raises if its motion differs in one bit."""
    name = f"bridge.step.{engine}.steps1"
    (found,) = figures_of(engine_group(quick=True), {name}, 1, lambda line: None)
    assert isinstance(found, Outcome), found


def test_the_echo_graph_completes_its_cycles_and_leaves_nothing():
    joints = [f"joint_{k}" for k in range(8)]
    before = set(children_of())  # of other tests in this process
    found = run_floor(joints, "single", 300)
    assert found["cycles"] == 300
    assert found["rate"] > 10.0
    assert set(children_of()) <= before


def test_an_interrupt_ends_every_process():
    benchmark = subprocess.Popen(
        [sys.executable, "-m", "benchmarks", "idle", "--quick", "--output", os.devnull],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: len(children_of(benchmark.pid)) >= 8)
        children = children_of(benchmark.pid)
        benchmark.send_signal(signal.SIGINT)
        assert benchmark.wait(20.0) == 130
        assert not [pid for pid in children if is_alive(pid)]
    finally:
        benchmark.kill()
        benchmark.wait()


@pytest.mark.parametrize("form", [FORMS["one process"], FORMS["a process each, and a merger"]])
def test_a_merger_makes_one_message_of_the_answers_to_a_state(form):
    found = measure(form, Load(["a", "b", "c", "d"], rate=250.0, seconds=0.5, priority=0))
    assert found["median"] > 0.0
    assert 0.0 < found["answered"] <= 1.0
    # A busy machine may lose states, or send a straggler's answer apart.
    assert (found["messages"] / found["answered"] < 2.5) is form.is_merged
