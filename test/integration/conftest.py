"""Fixtures of sweeps and studies: short experiments, and which runs are made of them."""

import pytest
from harness.studies import ARM

from hpid_ros.experiment import batch
from hpid_ros.experiment.batch import simulated
from hpid_ros.experiment.description import load_experiment


@pytest.fixture
def experiment(experiment_file):
    """Return the paper's experiment, a tenth of a second long."""
    return load_experiment(experiment_file(duration=0.1))


@pytest.fixture
def study_files(experiment_file):
    """Return two experiments of a twentieth of a second."""
    return [
        experiment_file("a.yaml", duration=0.05, name="calm", judge={"joints": ARM}),
        experiment_file("b.yaml", duration=0.05, name="noisy", sensors__noise=1e-3, judge={}),
    ]


@pytest.fixture
def study_runs(monkeypatch):
    """Return the labels of the runs that are made from now on, in this process."""
    labels = []

    def watched(task, keeper):
        labels.append(task.label)
        return simulated(task, keeper)

    monkeypatch.setattr(batch, "simulated", watched)
    return labels
