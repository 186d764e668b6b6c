"""Tests of a world run in every engine that is installed."""

from dataclasses import replace

import pytest
from harness.engines import INSTALLED

from hpid_ros.simulation import world

WORLDS = ("test_world", "test_drives", "test_disturbances", "test_gripper")


@pytest.fixture(autouse=True)
def engine(request, monkeypatch):
    """Let every world be computed by the engine of the test's name."""
    name = getattr(request, "param", None)
    if name is not None:
        build = world.build_physics
        monkeypatch.setattr(
            world, "build_physics", lambda each, robot: build(replace(each, engine=name), robot)
        )
    return name


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__.rpartition(".")[2] in WORLDS:
        metafunc.parametrize("engine", INSTALLED, indirect=True)
