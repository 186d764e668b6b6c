"""``hpid live``: the page on which running controllers are seen, retuned, tried and stopped."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from importlib.util import find_spec

from hpid_ros.base.errors import LibraryError
from hpid_ros.base.processes import uninterrupted
from hpid_ros.experiment.forking import Beginning
from hpid_ros.experiment.processes import parameters

_ENDS_WITHIN = 10.0  # [s]


def run(options: argparse.Namespace) -> int:
    """Run the page's node until it ends, and return its exit code."""
    if find_spec("rclpy") is None:
        raise LibraryError(
            "the live page needs ROS 2 (rclpy): source its setup file, or pip install "
            "'hpid_ros[ros]'"
        )
    given = parameters(
        host=options.host,
        port=options.port,
        token=options.token,
        open_browser=not options.no_browser,
        rate=options.rate,
        button_timeout=options.button_timeout,
    )
    command = [sys.executable, "-m", "hpid_ros.live.live_tuner", "--ros-args", *given]
    with uninterrupted():
        process = subprocess.Popen(command, preexec_fn=Beginning(signal.SIGTERM))
    try:
        code = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)  # a terminal has sent it already, which does no harm
        try:
            code = process.wait(_ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
    return code if code >= 0 else 128 - code
