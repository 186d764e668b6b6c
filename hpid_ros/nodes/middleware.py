"""What the nodes ask of the middleware beyond their qualities of service."""

from __future__ import annotations

import contextlib
import os

from hpid_ros.names import PROFILE_FILES
from hpid_ros.resources import ResourceError, find_resource


def load_profile() -> None:
    """Let Fast DDS load ``config/fastdds_nodes.xml``, unless a file of profiles is named already.

    To be called before the middleware is. Other middlewares know nothing of it. Without it all
    works, and acknowledgements take longer: a package that lacks the file is no reason to end.
    """
    if any(os.environ.get(name) for name in PROFILE_FILES):
        return
    with contextlib.suppress(ResourceError):
        profile = str(find_resource("config/fastdds_nodes.xml"))
        os.environ.update(dict.fromkeys(PROFILE_FILES, profile))


def has_shared_memory_alone() -> bool:
    """Tell whether the nodes of this process reach no other host and no other user.

    As in the closed mode of docs/security.md: Fast DDS talks through shared memory alone, and does
    not meet those that talk through a network, even in the same domain of the same host.
    """
    return (
        os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
        and os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") == "SHM"
        and os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET") == "SUBNET"
        and os.environ.get("ROS_LOCALHOST_ONLY", "0") != "1"
    )
