"""Finds the package's share folder: config, urdf, launch.

The same names work in a source checkout, after a plain ``pip install`` (which puts the folder
below the environment's prefix) and in a ROS installation (below the ament prefix).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hpid_ros.errors import HpidError
from hpid_ros.robot.packages import package_folder

_PACKAGE = "hpid_ros"
_SCHEME = "package://"


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


def find_resource(name: str, beside: Sequence[Path] = ()) -> Path:
    """Return the file of this name.

    Args:
        name: An absolute path; a path in one of ``beside`` or in the working directory; a path
            in the share folder; or ``PACKAGE/path`` in an ament or Python package, for instance
            ``pybullet_data/kuka_iiwa/model.urdf``. ``package://PACKAGE/path`` is the last of
            these and nothing else.
        beside: Folders to look in first, in this order.

    Raises:
        ResourceError: There is no such file.
    """
    places = list(_places(name, beside))
    for path in places:
        if path.is_file():
            return path.resolve()
    raise ResourceError(f"there is no file {name} ({_list(places, name)})")


def _places(name: str, beside: Sequence[Path]) -> Iterator[Path]:
    """Yield the files that a name may mean, the likeliest first."""
    relative = name.removeprefix(_SCHEME)
    package, _, below = relative.partition("/")
    if relative == name:
        yield from (folder / name for folder in beside)
        yield Path(name)
        yield share_folder() / name
    elif package == _PACKAGE:
        yield share_folder() / below
        return
    folder = package_folder(package) if below else None
    if folder is not None:
        yield folder / below


def _list(places: list[Path], name: str) -> str:
    """Say where a name was looked for."""
    looked = ", ".join(dict.fromkeys(str(path.absolute().parent) for path in places))
    if not looked:
        package = name.removeprefix(_SCHEME).partition("/")[0]
        return f"there is no ament or Python package {package}"
    return f"looked in {looked}"
