"""Libraries that a robot's controllers do without: one line where one is missing.

But for Pinocchio and joblib rosdep has no package of them, so ``package.xml`` names no other.
Whoever imports one does so where it is needed; the shells put :func:`optional_libraries` around
that.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
    "rosbags": Library("writing bags, and reading reports of a simulated robot", "rosbags"),
    # What the live page is made of comes with the first of them.
    **dict.fromkeys(
        ("nicegui", "fastapi", "starlette", "uvicorn"),
        Library("the live page", "'hpid_ros[live]'"),
    ),
    "joblib": Library("more than one process at a time (--jobs 1 needs none)", "joblib"),
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
