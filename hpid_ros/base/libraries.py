"""Libraries that are optional at run time, and the line that names one that is missing.

Of the robot's side rosdep knows Pinocchio alone; what the bench needs beyond it rosdep knows, too.
Whoever imports one does so where it is needed; the shells put :func:`optional_libraries` around
that.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import NamedTuple

from hpid_ros.base.errors import LibraryError


class Library(NamedTuple):
    """A library that is optional at run time."""

    purpose: str  # what cannot be done without it
    package: str  # what pip calls it


OPTIONAL = {
    "pinocchio": Library("a model of the whole robot", "pin"),
    "mujoco": Library("the simulated robot in MuJoCo", "mujoco"),
    "pybullet": Library("the simulated robot in PyBullet", "pybullet"),
    "rosbags": Library(
        "writing bags, and reading those of ROS 1 and reports of a simulated robot", "rosbags"
    ),
    "mcap": Library("writing bags", "mcap"),
    # What the live page is made of comes with the first of them.
    **dict.fromkeys(
        ("nicegui", "fastapi", "starlette", "uvicorn"),
        Library("the live page", "'hpid_ros[live]'"),
    ),
    **dict.fromkeys(
        ("rich", "matplotlib", "jinja2", "PIL", "argcomplete"),
        Library("this command of the bench", "'hpid_ros[bench]'"),
    ),
    "joblib": Library("more than one process at a time (--jobs 1 needs none)", "joblib"),
    "rclpy": Library("a running graph", "'hpid_ros[ros]'"),
    "distributed": Library("a batch on a Dask cluster", "distributed"),
    "lz4": Library("reading bags compressed with lz4", "lz4"),
    "backports": Library("reading bags compressed with zstd", "backports.zstd"),
}
"""By the name that is imported."""


@contextmanager
def optional_libraries() -> Iterator[None]:
    """Name a library that is missing, and what needs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if name not in OPTIONAL:
            raise
        purpose, package = OPTIONAL[name]
        raise LibraryError(
            f"{purpose} needs {name}, which is not installed: pip install {package} (into a venv "
            "with --system-site-packages where the system's Python is externally managed)"
        ) from error


def require_ros(what: str) -> None:
    if find_spec("rclpy") is None:
        raise LibraryError(
            f"{what} needs ROS 2 (rclpy): source its setup file, or pip install 'hpid_ros[ros]'"
        )
