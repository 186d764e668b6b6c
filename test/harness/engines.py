"""The physics engines that are installed, and what is left out without PyBullet."""

import pytest

from hpid_bench.experiment.study_plan import is_robot_installed
from hpid_ros.simulation.settings import ENGINES, default_engine, installed_engines

INSTALLED = installed_engines()
HAS_BULLET = ENGINES[0] in INSTALLED
NO_BULLET = "PyBullet is not installed"
"""Why a test is skipped: the one reason, whatever the test needs PyBullet for."""

needs_bullet = pytest.mark.skipif(not HAS_BULLET, reason=NO_BULLET)
"""For tests of PyBullet, of both engines, and of the robots that its package carries."""


def shipped(paths):
    """Return experiment files as parameters; those whose robot is PyBullet's need it."""
    return [
        pytest.param(path, id=path.stem, marks=[] if is_robot_installed(path) else [needs_bullet])
        for path in paths
    ]


ENGINE = default_engine()
"""The engine of tests that need one and care not which."""

BRIDGE = f"{ENGINE}_bridge"
"""Its executable, and the name of its node."""
