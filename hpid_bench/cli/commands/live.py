"""``hpid live``: the page on which running controllers are seen, retuned, tried and stopped."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from hpid_bench.experiment.processes import parameters
from hpid_ros.base.libraries import require_ros


def run(options: argparse.Namespace) -> NoReturn:
    """Become the page's node: signals and exit code are its own."""
    require_ros("the live page")
    given = parameters(
        host=options.host,
        port=options.port,
        token=options.token,
        open_browser=not options.no_browser,
        rate=options.rate,
        button_timeout=options.button_timeout,
    )
    command = [sys.executable, "-m", "hpid_bench.live.live_tuner", "--ros-args", *given]
    os.execv(sys.executable, command)
