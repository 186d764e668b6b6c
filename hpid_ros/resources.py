"""Finds the package's share folder: config, urdf, launch.

The same names work in a source checkout, after a plain ``pip install`` (which puts the folder
below the environment's prefix) and in a ROS installation (below the ament prefix).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from hpid_ros.errors import HpidError

_PACKAGE = "hpid_ros"


class ResourceError(HpidError, FileNotFoundError):
    """A file that is neither where it was said to be nor in the package's share folder."""


def share_folder() -> Path:
    """Return the folder that holds this package's config, urdf and launch files.

    Raises:
        ResourceError: The package was installed without them.
    """
    for folder in _candidates():
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise ResourceError(f"the share folder of {_PACKAGE} is not installed")


def _candidates() -> Iterator[Path]:
    yield Path(__file__).resolve().parents[1]
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]:
        if prefix:
            yield Path(prefix) / "share" / _PACKAGE


def find_resource(name: str, beside: Path | None = None) -> Path:
    """Return the file of this name.

    Args:
        name: An absolute path, a path relative to ``beside`` or to the working directory, or a
            path in the share folder; ``package://hpid_ros/...`` is the last of these.
        beside: A folder to look in first.

    Raises:
        ResourceError: There is no such file.
    """
    relative = name.removeprefix(f"package://{_PACKAGE}/")
    places = [] if relative != name else [*([beside / name] if beside else []), Path(name)]
    for path in places:
        if path.is_file():
            return path.resolve()
    path = share_folder() / relative
    if path.is_file():
        return path
    raise ResourceError(f"there is no file {name} (looked in {_list([*places, path])})")


def _list(paths: list[Path]) -> str:
    return ", ".join(dict.fromkeys(str(path.absolute().parent) for path in paths))
