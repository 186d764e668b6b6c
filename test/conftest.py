"""Shared fixtures: short experiments, a graph that nobody else is on, and counted faults."""

import os
from collections import Counter
from pathlib import Path

import pytest
import yaml
from harness.fork_server import ForkedPopen
from harness.graph import Harness
from hypothesis import settings

from hpid_ros.base.resources import share_folder
from hpid_ros.experiment.graph.isolation import closed_environment, own_domain
from hpid_ros.experiment.graph.processes import NodeProcess

# A busy machine is not a failure. Every run draws other examples, so that many runs see many.
settings.register_profile("suite", deadline=None, max_examples=25)
settings.register_profile("thorough", deadline=None, max_examples=500)
settings.load_profile("suite")  # another one: pytest --hypothesis-profile thorough

NodeProcess.popen = ForkedPopen  # of the suite's processes: nodes that it starts are forked

FAULTS = pytest.StashKey()
TESTS = Path(__file__).parent
TRACKING = share_folder() / "config" / "experiments" / "tracking.yaml"


@pytest.fixture
def experiment_file(tmp_path):
    """Return a function that writes tracking.yaml, shortened and changed."""

    def write(file="short.yaml", duration=0.3, **changes):
        document = yaml.safe_load(TRACKING.read_text())
        document |= {"name": "short", "duration": duration}
        # Whatever a test is about but for the engines themselves: a step is thirty times faster.
        document["simulation"] = {"engine": "mujoco", "physics_steps": 1}
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


class Faults:
    """Counts what a test did to the package and what came of it, for ``make faults``."""

    def __init__(self, counts):
        self._counts = counts

    def count(self, name, number=1):
        """Add to a count.

        Args:
            name: What is counted, in a few words, for instance ``messages fuzzed: live node``.
            number: How many more.
        """
        self._counts[name] += int(number)


@pytest.fixture(scope="session")
def faults(request):
    """Return the counts of this session; they are printed at its end."""
    return Faults(request.config.stash.setdefault(FAULTS, Counter()))


def pytest_addoption(parser):
    parser.addoption(
        "--faults",
        action="store_true",
        help="run only the tests that inject faults and count them",
    )


def pytest_collection_modifyitems(config, items):
    for item in items:
        item.add_marker(item.path.relative_to(TESTS).parts[0])
    if config.getoption("--faults"):
        others = [item for item in items if "faults" not in item.fixturenames]
        items[:] = [item for item in items if "faults" in item.fixturenames]
        config.hook.pytest_deselected(items=others)


def pytest_terminal_summary(terminalreporter, config):
    counts = config.stash.get(FAULTS, {})
    if not counts:
        return
    terminalreporter.section("faults injected, and what came of them")
    width = max(map(len, counts))
    for name, number in sorted(counts.items()):
        terminalreporter.write_line(f"{name:<{width}}  {number:>10}")
