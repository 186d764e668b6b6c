"""Shared fixtures: short experiments, a graph that nobody else is on, and counted faults."""

import faulthandler
import os
import signal
from collections import Counter
from contextlib import contextmanager
from functools import partial
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from harness import browser, interfaces
from harness.experiments import write_experiment
from harness.fork_server import ForkedPopen
from harness.graph import Harness
from hypothesis import settings

from benchmarks.surroundings import loopback_environment
from hpid_bench.experiment.processes import NodeGroup, own_domain

# A busy machine is not a failure. Every run draws other examples, so that many runs see many.
settings.register_profile("suite", deadline=None, max_examples=25)
settings.register_profile("quick", deadline=None, max_examples=5)
settings.register_profile("thorough", deadline=None, max_examples=500)
settings.load_profile("suite")  # another one: pytest --hypothesis-profile thorough

for number in (signal.SIGHUP, signal.SIGQUIT):  # nodes ignore what nohup or a shell had ignored
    signal.signal(number, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's & had ignored
NodeGroup.popen = ForkedPopen  # of the suite's processes: nodes that it starts are forked

FAULT = "fault"  # a property of a test: what is counted, and how many more
BROWSER_REQUIRED = "HPID_BROWSER_REQUIRED"  # set by CI, which has installed one
HUNG = 300.0  # [s] beyond a test's timeout: what that could not end waits outside of Python
TESTS = Path(__file__).parent
WAITING = ("field", "graph")  # folders of tests that wait half of their time


@pytest.fixture
def experiment_file(tmp_path):
    """Return a function that writes tracking.yaml, shortened and changed."""

    return partial(write_experiment, tmp_path)


@pytest.fixture
def environment_of():
    """Return what makes the environment of a graph; a module may have another one."""
    return loopback_environment


@contextmanager
def harness_on(environment_of, folder):
    """Yield a node of the test and a group of processes, on a domain of their own."""
    with own_domain() as domain:
        environment = environment_of(domain)
        before = dict(os.environ)
        os.environ.update(environment)
        try:
            with Harness(domain, environment, folder) as harness:
                yield harness
        finally:
            os.environ.clear()
            os.environ.update(before)


@pytest.fixture
def harness(tmp_path, environment_of):
    """Return a harness of this test."""
    with harness_on(environment_of, tmp_path) as harness:
        yield harness


@pytest.fixture(scope="module")
def module_harness(tmp_path_factory):
    """Return a harness of all tests of a module, whose nodes none of them ends."""
    with harness_on(loopback_environment, tmp_path_factory.mktemp("nodes")) as harness:
        yield harness


class Faults:
    """Counts what a test did to the package and what came of it, for ``make faults``."""

    def __init__(self, note):
        self._note = note

    def count(self, name, number=1):
        """Add to a count, for instance of ``messages fuzzed: live node``."""
        self._note(FAULT, (name, int(number)))


@pytest.fixture
def faults(record_property):
    """Return the counts of a test; their sums are printed at the end of the session."""
    return Faults(record_property)


def pytest_configure(config):
    """Provide message packages before modules are imported that ask for them."""
    temporary = None
    if not hasattr(config, "cache"):  # -p no:cacheprovider: built for this session alone
        temporary = TemporaryDirectory()
        config.add_cleanup(temporary.cleanup)
    for name in interfaces.PACKAGES:
        folder = Path(temporary.name, name) if temporary else config.cache.mkdir(name)
        folder.mkdir(exist_ok=True)
        interfaces.provide(name, folder)


@pytest.hookimpl(tryfirst=True)  # before -m looks
def pytest_collection_modifyitems(items):
    for item in items:
        item.add_marker(item.path.relative_to(TESTS).parts[0])
        if "faults" in item.fixturenames:
            item.add_marker("faults")
    items[:] = spread(items)


def spread(items):
    """Order files so that those whose tests wait for nodes lie among those that compute."""
    files = {path: list(own) for path, own in groupby(items, key=lambda item: item.path)}
    places = {}
    for waits in (True, False):
        own = [path for path in files if (path.relative_to(TESTS).parts[0] in WAITING) == waits]
        places |= {path: place / len(own) for place, path in enumerate(own)}
    return [item for path in sorted(files, key=places.get) for item in files[path]]


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_protocol(item):
    """Have a test that hangs for good say where, and end its process."""
    own = item.get_closest_marker("timeout")
    timeout = float(own.args[0] if own else item.config.getini("timeout"))
    stderr = item.config.stash[fault_handler_stderr_fd_key]
    faulthandler.dump_traceback_later(timeout + HUNG, exit=True, file=stderr)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _without_browser(terminalreporter):
    """Return the reports of tests that were skipped for want of a browser."""
    reasons = [
        each.longrepr[2] if isinstance(each.longrepr, tuple) else str(each.longrepr)
        for each in terminalreporter.getreports("skipped")
    ]
    return [each for each in reasons if browser.MISSING in each]


@pytest.hookimpl(wrapper=True)
def pytest_sessionfinish(session):
    """Fail where a browser must be there, and tests were skipped without one."""
    yield
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    is_passed = session.exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    if is_passed and BROWSER_REQUIRED in os.environ and reporter and _without_browser(reporter):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter):
    _tell_faults(terminalreporter)
    if skipped := _without_browser(terminalreporter):
        kind = "red" if BROWSER_REQUIRED in os.environ else "yellow"
        terminalreporter.write_line(f"{len(skipped)} {browser.LINE}", **{kind: True})


def _tell_faults(terminalreporter):
    counts = Counter()
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == FAULT:
                counts.update({value[0]: value[1]})
    if counts:
        terminalreporter.section("faults injected, and what came of them")
        width = max(map(len, counts))
        for name, number in sorted(counts.items()):
            terminalreporter.write_line(f"{name:<{width}}  {number:>10}")
