"""Says aloud when DDS security was asked for and is not there.

With ``ROS_SECURITY_ENABLE=true`` a middleware that was built without DDS security starts all the
same, unprotected and without a word. The wheels of ROS on PyPI are built so.
"""

from __future__ import annotations

import mmap
import os
from pathlib import Path

from rclpy.node import Node

_MIDDLEWARES = ("libfastrtps.so", "libfastdds.so")
_MARK = b"dds.sec.auth.plugin"  # the property that names the authentication plugin


def warn_if_unprotected(node: Node) -> None:
    """Log one warning when security was asked for and the loaded Fast DDS has none.

    Args:
        node: Any node of the process; its middleware is loaded.
    """
    if os.environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        return
    library = _loaded_middleware()
    if library is not None and not _has_security(library):
        node.get_logger().warning(
            "ROS_SECURITY_ENABLE is set, but this Fast DDS was built without security: nothing is "
            "authenticated or encrypted, and anybody on the network can command this node"
        )


def _loaded_middleware(maps: Path = Path("/proc/self/maps")) -> Path | None:
    """Return the Fast DDS library of this process; None when another middleware is loaded."""
    for line in maps.read_text().splitlines():
        path = Path(line.rpartition(" ")[2])
        if path.name.startswith(_MIDDLEWARES):
            return path
    return None


def _has_security(library: Path) -> bool:
    with library.open("rb") as stream, mmap.mmap(stream.fileno(), 0, prot=mmap.PROT_READ) as data:
        return data.find(_MARK) >= 0
