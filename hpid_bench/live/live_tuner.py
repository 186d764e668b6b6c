"""Serves the page on which a person sees, retunes, tries and stops running controllers."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.task import Future

from hpid_bench.live.graph_client import GraphClient
from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.status import StatusParameters, StatusPipe

_LARGEST_PORT = 65535
_NICENESS = 10  # controllers come first
_LOOK_PERIOD = 0.05  # [s]
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


@dataclass(frozen=True)
class TunerParameters(Record):
    """How the page is served."""

    host: str = quantity("Address to listen at", default="127.0.0.1")
    port: int = quantity(
        "Port to listen at; 0 chooses a free one", default=8080, least=0, most=_LARGEST_PORT
    )
    token: str = quantity("What opens the page, in its address; empty draws one", default="")
    open_browser: bool = quantity("Open the page where there is a display", default=True)
    rate: float = quantity("Frames a second", "Hz", default=30.0, least=5.0, most=60.0)
    button_timeout: float = quantity(
        "Longest gap in the signal of a held button; then joints stop",
        "s",
        default=0.4,
        least=0.2,
        most=2.0,
    )


class LiveTuner(executor.ClosingNode):
    """The graph on one side, the page's server on the other."""

    def __init__(self) -> None:
        super().__init__("live_tuner")
        asked = read(self, TunerParameters)
        self._status = StatusPipe(self)
        self._graph = GraphClient(self)
        # Its library, which no other node needs, is imported here.
        from hpid_bench.live.page.server import PageServer

        self._served = PageServer(
            self._graph, asked.host, asked.port, asked.token, asked.rate, asked.button_timeout
        )
        url = self._served.url
        print(f"hpid live: {url}", flush=True)
        self._status.send("serving", url=url)
        if asked.open_browser and any(os.environ.get(each) for each in _DISPLAYS):
            # A browser that nobody has used yet takes seconds.
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

    def begin_stop(self) -> Future | None:
        """Cancel a trial that is under way: joints come to rest, and get back what it has set."""
        trials = self._served.trials
        if trials.is_idle:
            return None
        trials.cancel("ended: hpid live was stopped")
        has_ended = Future()

        def look() -> None:
            if trials.is_idle and not has_ended.done():
                has_ended.set_result(None)

        steady_timer(self, _LOOK_PERIOD, look)
        return has_ended

    def close(self) -> None:
        """End the page; nothing is told to any controller."""
        tried = self._served.stop()
        if tried:
            print(
                f"hpid live: {', '.join(tried)}: what a trial has set is still in force",
                file=sys.stderr,
            )
        self._graph.close()


USAGE = Usage(
    "live_tuner",
    "Serves a page on which a person sees, retunes, tries and stops running controllers.",
    "",
    names_of(TunerParameters, StatusParameters),
    [
        "joint_states",
        "joint_commands",
        "CONTROLLER/reference",
        "CONTROLLER/transition_event",
        "/diagnostics",
        "/parameter_events",
    ],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [LiveTuner()], args, USAGE, niceness=_NICENESS)


if __name__ == "__main__":
    sys.exit(main())
