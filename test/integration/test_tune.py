"""Searches: the same every time, never unstable, never uncertified unasked, nothing lost."""

import csv
import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml

from hpid_bench.cli.commands import DONE, FAILED, INTERRUPTED
from hpid_bench.cli.main import main
from hpid_bench.experiment import batch
from hpid_bench.experiment.batch import run_batch, simulated
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.search import (
    Cost,
    Evaluation,
    Search,
    SearchPlan,
    SearchResult,
    SearchSpace,
    compare_entry,
)
from hpid_ros.base.errors import GainError
from hpid_ros.control.homogeneous_pid import is_hurwitz
from hpid_ros.stability import gain_check as degree_check

ARM = ["arm_joint_1", "arm_joint_2"]
ONE = partial(run_batch, jobs=1)


@pytest.fixture
def path(experiment_file):
    """Return an experiment of a twentieth of a second that judges two joints."""
    return experiment_file(duration=0.05, judge={"joints": ARM})


@pytest.fixture
def experiment(path):
    return load_experiment(path)


def planned(experiment, law, **options):
    defaults = {"evaluations": 12, "seeds": 1}
    space = SearchSpace.of(experiment, law, options.pop("bounds", None))
    return SearchPlan(experiment, space, Cost.even(), experiment.judged, **{**defaults, **options})


def tune(path, tmp_path, *options, folder="t"):
    few = ("--evaluations", 12, "--seeds", 1)
    code = main([*map(str, ("tune", path, "-o", tmp_path / folder, *few, *options))])
    return code, tmp_path / folder


def test_a_distribution_gives_heavy_joints_what_it_takes_from_light_ones(experiment):
    space, baseline = SearchSpace.of(experiment, "pid"), experiment.controllers["PID"]
    found = space.controller([1.0, 1.0, 1.0, -0.25])
    factors = []
    for before, after in zip(baseline, found, strict=True):
        factors.append(np.cbrt(after.gains.i / before.gains.i))
        assert after.gains.p == pytest.approx(before.gains.p * factors[-1] ** 2, rel=1e-4)
        assert after.gains.d == pytest.approx(before.gains.d * factors[-1], rel=1e-4)
    assert np.prod(factors) == pytest.approx(1.0, rel=1e-4)
    stiffness = [each.gains.p for each in baseline]
    assert sorted(stiffness) == [p for _, p in sorted(zip(factors, stiffness, strict=True))][::-1]
    one = space.narrowed("arm_joint_1", found)
    assert [each.name for each in one.parameters] == ["bandwidth", "damping", "integral"]
    assert one.controller([1.0, 1.0, 1.0]) == found


def test_the_pid_s_scales_are_what_they_are_called(experiment):
    space = SearchSpace.of(experiment, "pid")
    baseline = experiment.controllers["PID"]
    assert space.controller([1.0, 1.0, 1.0, 0.0]) == baseline
    for before, after in zip(baseline, space.controller([2.0, 1.0, 1.0, 0.0]), strict=True):
        old, new = (
            np.sort_complex(np.roots([m.inertia, m.gains.d, m.gains.p, m.gains.i]))
            for m in (before, after)
        )
        assert new.mean() == pytest.approx(2.0 * old.mean())
        assert new.prod() == pytest.approx(8.0 * old.prod(), rel=1e-5)
    changed = space.controller([1.0, 1.5, 0.5, 0.0])[0].gains
    base = baseline[0].gains
    assert (changed.p, changed.i, changed.d) == pytest.approx((base.p, 0.5 * base.i, 1.5 * base.d))


def test_the_homogeneous_search_leaves_the_gains_alone(experiment):
    space = SearchSpace.of(experiment, "hpid")
    found = space.controller([-0.2, 2.0, 0.5])
    for before, after in zip(experiment.controllers["PID"], found, strict=True):
        assert after.gains == before.gains
        assert (after.law, after.mu) == ("hpid", -0.2)
        assert after.norm.error_scale == pytest.approx(2.0 * before.norm.error_scale)
        assert after.norm.rate_weight == 0.5
    start = space.controller([each.start for each in space.parameters])
    assert {each.mu for each in start} == {0.0}


def test_a_norm_in_units_of_effort_has_one_scale_for_all_joints(experiment):
    own = {"norm.error_scale": 1.0, "norm.rate_weight": 0.1, "norm.effort_scale": 3.0}
    loops = tuple(each.with_parameters(own) for each in experiment.controllers["hPID"])
    controllers = {**experiment.controllers, "hPID": loops}
    space = SearchSpace.of(replace(experiment, controllers=controllers), "hpid")
    assert [each.name for each in space.parameters] == ["mu", "effort_scale", "floor"]
    found = space.controller([-0.2, 0.5, 0.03])
    norms = {(each.mu, each.norm.effort_scale, each.norm.floor) for each in found}
    assert norms == {(-0.2, 1.5, 0.03)}
    assert [each.gains for each in found] == [each.gains for each in space.start]


class Known(Search):
    """A search whose costs are a formula: least at these shares."""

    LEAST = (0.3, 0.7, 0.55)

    def run(self):
        self._minimise(self.plan.space, "all")

    def _evaluated(self, space, stage, shares):
        found = []
        for row in shares:
            values = {p.name: p.value(s) for p, s in zip(space.parameters, row, strict=True)}
            cost = 1.0 + sum((a - b) ** 2 for a, b in zip(row, self.LEAST, strict=True))
            cost = math.inf if row[0] > 0.9 else cost
            found.append(Evaluation(len(self.evaluations), stage, values, (), cost))
            self.evaluations.append(found[-1])
        return found


@pytest.mark.parametrize("evaluations", [10, 47, 150])
def test_a_search_uses_its_budget_and_finds_what_is_there(experiment, evaluations):
    search = Known(planned(experiment, "hpid", evaluations=evaluations))
    search.run()
    assert len(search.evaluations) == evaluations
    again = Known(planned(experiment, "hpid", evaluations=evaluations, search_seed=2))
    again.run()
    assert again.evaluations != search.evaluations
    assert search.best.cost < 1.0 + 3.0 / evaluations
    if evaluations == 150:
        found = [p.share(search.best.values[p.name]) for p in search.plan.space.parameters]
        assert found == pytest.approx(Known.LEAST, abs=0.05)


def test_the_search_begins_at_the_baseline_and_never_ends_above_it(experiment):
    plan = planned(experiment, "hpid")
    seeds = list(plan.training_seeds)
    assert not set(seeds) & {experiment.seed + k for k in range(1000)}  # those of studies
    assert [task.world.seed for task in plan.tasks("x", ()).values()] == seeds
    search = Search(plan, ONE)
    search.run()
    assert len(search.evaluations) == 12
    (start,) = [each for each in search.evaluations if each.values["mu"] == 0.0]
    assert start.cost == 1.0
    assert set(start.ratios.values()) == {1.0}
    assert search.best.cost == min(each.cost for each in search.evaluations) <= 1.0


def test_unstable_gains_are_refused_and_never_run(experiment):
    ran = []

    def watched(tasks):
        ran.extend(tasks.values())
        return run_batch(tasks, 1)

    bounds = {"integral": (1.0, 100.0)}
    search = Search(planned(experiment, "pid", bounds=bounds, settle=1e-6), watched)
    search.run()
    refused = [each for each in search.evaluations if each.note.startswith("refused")]
    unstable = [each for each in refused if "unstable" in each.note]
    assert unstable
    assert all(each.cost == math.inf and not each.ratios for each in unstable)
    assert ran
    assert all(is_hurwitz(loop.gains, loop.inertia) for task in ran for loop in task.loops)
    # What ran did not settle as was asked.
    assert search.best is None
    assert all("rad in the last second" in e.note for e in search.evaluations if e.ratios)


@pytest.mark.parametrize("must_be_certified", [True, False])
def test_uncertified_degrees_are_refused_unless_they_are_asked_for(
    experiment, monkeypatch, must_be_certified
):
    def only_positive(gains, norm, inertia):
        if norm.degree < 0.0:
            raise GainError("no certificate was found")

    monkeypatch.setattr(degree_check, "certify_degree", only_positive)
    plan = planned(experiment, "hpid", must_be_certified=must_be_certified)
    search = Search(plan, ONE)
    search.run()
    negative = [each for each in search.evaluations if each.values["mu"] < 0.0]
    assert negative
    for each in negative:
        assert ("not certified at mu" in each.note) == must_be_certified
        assert math.isfinite(each.cost) != must_be_certified


def test_joints_of_one_rule_are_certified_once(experiment, monkeypatch):
    calls = []
    monkeypatch.setattr(degree_check, "certify_degree", lambda *loop: calls.append(loop))
    checker = degree_check.DegreeChecker()
    loops = [e.with_parameters({"norm.error_scale": 0.3}) for e in experiment.controllers["hPID"]]
    for each in loops:
        assert checker.refusal(each) == ""
    assert len(calls) == 1
    assert checker.refusal(loops[0].with_parameters({"norm.rate_weight": 0.7})) == ""
    assert len(calls) == 2


def test_refining_a_joint_changes_no_other(experiment):
    search = Search(planned(experiment, "pid", evaluations=10, per_joint=True), ONE)
    search.run()
    assert [each.stage for each in search.evaluations[::10]] == ["all", *ARM]
    first = min(search.evaluations[:10], key=lambda each: each.cost)
    for each in search.evaluations[10:20]:
        for before, after in zip(first.loops, each.loops, strict=False):
            assert before == after or after.joint == ARM[0]
    assert search.best.cost <= first.cost
    assert len(list(csv.DictReader(SearchResult(search, "best").points_csv().splitlines()))) == 30


def test_what_is_saved_depends_neither_on_the_jobs_nor_on_the_day(path, tmp_path, capsys):
    folders = []
    for jobs in (1, 2):
        code, folder = tune(path, tmp_path, "--law", "pid", "--jobs", jobs, folder=f"of {jobs}")
        assert code == DONE
        assert capsys.readouterr().out == (folder / "best.yaml").read_text()
        folders.append({each.name: each.read_bytes() for each in folder.iterdir()})
    one, two = folders
    assert set(one) == {
        "best.yaml",
        "experiment.yaml",
        "points.csv",
        "table.txt",
        "tune.json",
        "trade_off.png",
        "hpid_result.json",
    }
    assert one == two


@pytest.mark.parametrize("law", ["pid", "hpid"])
def test_the_snippet_is_the_best_controller_in_an_experiment_file(path, tmp_path, capsys, law):
    code, folder = tune(path, tmp_path, "--law", law, "-j", 1, "--label", "found")
    assert code == DONE
    own = path.with_name("own.yaml")
    own.write_text(f"extends: {path.name}\n" + capsys.readouterr().out)
    loops = load_experiment(own).controllers["found"]
    saved = json.loads((folder / "tune.json").read_text())
    assert {each.joint: dict(each.to_parameters()) for each in loops} == saved["parameters"]
    assert saved["best"]["cost"] <= 1.0
    rows = list(csv.DictReader((folder / "points.csv").open()))
    costs = [float(row["cost"]) for row in rows if row["cost"]]
    assert len(rows) == 12
    assert min(costs) == saved["best"]["cost"]


def test_the_snippet_keeps_what_its_entry_had(experiment_file):
    compare = {
        "PID": {"law": "pid", "velocity_filter_time_constant": 0.01},
        "hPID": {"mu": -0.1, "norm": {"type": "canonical"}, "norm.error_scale": 0.2},
    }
    experiment = load_experiment(experiment_file(compare=compare, judge={"joints": ARM}))
    space = SearchSpace.of(experiment, "hpid")
    entry = compare_entry(experiment, space, space.controller([-0.2, 2.0, 0.3]))
    assert entry["norm"]["type"] == "canonical"
    assert set(entry) == {"law", "mu", "norm"}
    assert set(entry["norm"]) == {"type", "error_scale", "rate_weight"}
    space = SearchSpace.of(experiment, "pid")
    entry = compare_entry(experiment, space, space.controller([1.0, 1.5, 0.5, 0.0]))
    assert entry["velocity_filter_time_constant"] == 0.01


def test_what_was_said_of_one_joint_does_not_outlive_the_search(experiment_file):
    """The search has one law and one rate weight, the baseline's gains, and scales that follow."""
    norm = {"norm": {"rate_weight": 0.5, "error_scale": 0.1}, "norm.floor": 0.0}
    own = {"arm_joint_1": {"law": "pid", "gains.p": 9.0, **norm}}
    compare = {"PID": {"law": "pid"}, "hPID": {"mu": -0.1, "joints": own}}
    path = experiment_file(duration=0.05, compare=compare, judge={"joints": ARM})
    experiment = load_experiment(path)
    space = SearchSpace.of(experiment, "hpid")
    loops = space.controller([-0.2, 2.0, 0.3])
    entry = compare_entry(experiment, space, loops)
    assert entry["norm"] == {"rate_weight": 0.3}
    assert entry["joints"]["arm_joint_1"]["norm"] == {"floor": 0.0, "error_scale": 0.2}
    document = yaml.safe_load(path.read_text())
    document["compare"]["found"] = entry
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    assert load_experiment(path).controllers["found"] == loops


def test_an_interrupt_leaves_what_was_found(path, tmp_path, capsys, monkeypatch):
    def interrupted(task, keeper):
        if task.label.startswith("point 7 "):  # in the middle of a generation
            raise KeyboardInterrupt
        return simulated(task, keeper)

    monkeypatch.setattr(batch, "simulated", interrupted)
    code, folder = tune(path, tmp_path, "--law", "pid", "-j", 1)
    assert code == INTERRUPTED
    saved = json.loads((folder / "tune.json").read_text())
    assert saved["evaluations"] == {"planned": 12, "made": 7}
    assert saved["best"] is not None
    assert (folder / "best.yaml").read_text().startswith("compare:")
    assert f"what was found: {folder}" in capsys.readouterr().err


def test_a_baseline_that_cannot_be_run_is_a_failure(path, tmp_path, capsys, monkeypatch):
    def broken(task, keeper):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(batch, "simulated", broken)
    code, _ = tune(path, tmp_path, "--law", "pid", "-j", 1)
    assert code == FAILED
    assert "the baseline cannot be run: ZeroDivisionError: by zero" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["pid", "--evaluations", "3"], "evaluations must be at least 10"),
        (["pid", "--seeds", "0"], "seeds must be at least 1"),
        (["pid", "--joint", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["pid", "--settle", "0"], "settle must be positive"),
        (["pid", "--weight", "ivc"], "--weight must be NAME=NUMBER, not 'ivc'"),
        (["pid", "--bounds", "mu=0:0.2"], "unknown free parameter 'mu'"),
        (["hpid", "--bounds", "mu=0.2:0.1"], "the first below the second"),
        (["pid"], "the inertia of 'arm_joint_1' is not known"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(
    experiment_file, tmp_path, refused, options, words
):
    unknown = {} if options[1:] else {"controllers__joints__arm_joint_1__inertia": 0.0}
    path = experiment_file(duration=0.05, judge={"joints": ARM}, **unknown)
    assert words in refused("tune", path, "-o", tmp_path / "t", "--law", *options)
    assert unknown or not (tmp_path / "t").exists()
