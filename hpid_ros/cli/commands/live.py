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

_ENDS_WITHIN = 10.0  # [s]


def run(options: argparse.Namespace) -> int:
    """Run the page's node until it ends, and return its exit code."""
    if find_spec("rclpy") is None:
        raise LibraryError(
            "the live page needs ROS 2 (rclpy): source its setup file, or pip install "
            "'hpid_ros[ros]'"
        )
    command = [sys.executable, "-m", "hpid_ros.live.live_tuner", "--ros-args", *_given(options)]
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


def _given(options: argparse.Namespace) -> list[str]:
    parameters = {
        "host": _text(options.host),
        "port": options.port,
        "token": _text(options.token),
        "open_browser": str(not options.no_browser).lower(),
        "rate": float(options.rate),
        "button_timeout": float(options.button_timeout),
    }
    return [text for name, value in parameters.items() for text in ("-p", f"{name}:={value}")]


def _text(value: str) -> str:
    """Return a text as YAML, which takes it for no number."""
    return "'" + value.replace("'", "''") + "'"
