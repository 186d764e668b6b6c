"""A process that does not outlive the launch that started it.

``ros2 launch`` ends its processes on SIGINT; SIGTERM and SIGKILL end it alone, and what it started
would go on driving the robot. This package's launch files name themselves to what they start, and
the kernel tells it when they are gone.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path

LAUNCH = "HPID_ROS_LAUNCH"
"""Environment variable: the process id of the launch."""

_PR_SET_PDEATHSIG = 1


def end_with_the_launch() -> None:
    """Get SIGTERM when the launch has ended, however that came about; on Linux."""
    launch = os.environ.get(LAUNCH)
    if launch is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if not Path("/proc", launch).exists():  # it was gone before
        os.kill(os.getpid(), signal.SIGTERM)
