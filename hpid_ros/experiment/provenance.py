"""Where numbers come from: versions of everything that takes part in them."""

from __future__ import annotations

import platform
from importlib import metadata

from hpid_ros import __version__

_PARTS = ("numpy", "pybullet", "pin", "rosbags", "ros-rclpy", "rclpy", "ros-fastrtps")


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that compute."""
    found = {"hpid_ros": __version__, "python": platform.python_version()}
    for name in _PARTS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
