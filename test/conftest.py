"""Shared fixtures: short experiments, and a graph that nobody else is on."""

import os

import pytest
import yaml
from harness import Harness
from hypothesis import settings

from hpid_ros.experiment.isolation import closed_environment, own_domain
from hpid_ros.resources import share_folder

settings.register_profile("suite", deadline=None)  # a busy machine is not a failure
settings.load_profile("suite")

PAPER = share_folder() / "config" / "experiments" / "paper.yaml"


@pytest.fixture
def experiment_file(tmp_path):
    """Return a function that writes the paper's experiment, shortened and changed."""

    def write(file="short.yaml", duration=0.3, **changes):
        document = yaml.safe_load(PAPER.read_text())
        document |= {"name": "short", "duration": duration, "simulation": {"physics_steps": 1}}
        # Patient: on a busy machine a late answer is asked for again, and counted in the result.
        document["control"] = {"rate": 1000, "answer_timeout": 120.0}
        for dotted, value in changes.items():
            *path, last = dotted.split("__")
            inner = document
            for part in path:
                inner = inner.setdefault(part, {})
            inner[last] = value
        path = tmp_path / file
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        return path

    return write


@pytest.fixture
def harness(tmp_path):
    """Return a node of the test and a group of processes, on a domain of their own."""
    with own_domain() as domain:
        environment = closed_environment(domain)
        before = dict(os.environ)
        os.environ.update(environment)
        try:
            with Harness(domain, environment, tmp_path) as harness:
                yield harness
        finally:
            os.environ.clear()
            os.environ.update(before)
