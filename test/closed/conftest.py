"""Graphs in the closed mode; Fast DDS reads its profile once a process, so they have their own."""

import pytest

from hpid_bench.experiment.processes import closed_environment


@pytest.fixture
def environment_of():
    return closed_environment
