"""Fixtures: the command, short experiments, and which runs are made of sweeps and studies."""

import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from harness.experiments import write_experiment
from harness.studies import ARM, study

from hpid_bench.cli.commands import BAD_INPUT, DONE
from hpid_bench.cli.main import main
from hpid_bench.experiment import batch
from hpid_bench.experiment.batch import run_batch, simulated
from hpid_bench.experiment.description import load_experiment


@pytest.fixture
def hpid(capsys):
    """Return a function that runs ``hpid`` in this process: exit code, output and errors."""

    def run(*arguments):
        capsys.readouterr()
        code = main([*map(str, arguments)])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def refused(hpid):
    """Return a function that runs ``hpid`` on what is wrong, and gives the one line it says."""

    def run(*arguments):
        code, printed, errors = hpid(*arguments)
        assert (code, printed, errors.count("\n")) == (BAD_INPUT, "", 1)
        assert errors.startswith("hpid: ")
        return errors

    return run


@pytest.fixture
def experiment(experiment_file):
    """Return the paper's experiment, a tenth of a second long."""
    return load_experiment(experiment_file(duration=0.1))


@pytest.fixture(scope="session")
def finished_study(tmp_path_factory):
    """Return two experiments of a twentieth of a second, and the folder of their study."""
    place = tmp_path_factory.mktemp("study")
    calm = write_experiment(place, "a.yaml", 0.05, name="calm", judge={"joints": ARM})
    noisy = write_experiment(place, "b.yaml", 0.05, name="noisy", sensors__noise=1e-3)
    assert study([calm, noisy], place / "s") == DONE
    return [calm, noisy], place / "s"


@pytest.fixture
def studied(finished_study, tmp_path):
    """Return a copy of both, for one test."""
    files, folder = finished_study
    shutil.copytree(folder, tmp_path / "s")
    return [Path(shutil.copy(file, tmp_path)) for file in files], tmp_path / "s"


@pytest.fixture
def study_runs(monkeypatch):
    """Return the labels of the runs that are made from now on, in this process."""
    labels = []

    def watched(task, keeper):
        labels.append(task.label)
        return simulated(task, keeper)

    monkeypatch.setattr(batch, "simulated", watched)
    return labels


@contextmanager
def _losing(label, error):
    def run(task, keeper):
        if task.label == label:
            raise error
        return simulated(task, keeper)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "simulated", run)
        yield


@pytest.fixture
def losing():
    """Return what makes a block in which the run of a label ends with an error."""
    return _losing


@contextmanager
def _last_first():
    def run(tasks, jobs):
        return run_batch(dict(reversed(tasks.items())), 1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "run_batch", run)
        yield


@pytest.fixture
def backwards():
    """Return a block in which the last run of a batch ends first, as with many processes."""
    return _last_first()
