"""Serves the page on which a person sees, retunes, tries and stops running controllers."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Sequence

from rclpy.task import Future

from hpid_ros.base.errors import SettingError
from hpid_ros.live.graph_client import GraphClient
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import steady_timer
from hpid_ros.nodes.core.process import read_number, read_only
from hpid_ros.nodes.core.status import StatusPipe

_LARGEST_PORT = 65535
_NICENESS = 10  # controllers come first
_LOOK_PERIOD = 0.05  # [s]
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


class LiveTuner(executor.ClosingNode):
    """The graph on one side, the page's server on the other."""

    def __init__(self) -> None:
        super().__init__("live_tuner")
        host = str(read_only(self, "host", "127.0.0.1", "Address to listen at"))
        port = read_only(self, "port", 8080, "Port to listen at; 0 chooses a free one")
        token = str(
            read_only(self, "token", "", "What opens the page, in its address; empty draws one")
        )
        opens = read_only(self, "open_browser", True, "Open the page where there is a display")
        rate = read_number(self, "rate", 30.0, "Frames a second [Hz]", (5.0, 60.0))
        within = read_number(
            self, "button_timeout", 0.4, "Of a held button, then joints stop [s]", (0.2, 2.0)
        )
        if not 0 <= port <= _LARGEST_PORT:
            raise SettingError(f"port must lie in [0, {_LARGEST_PORT}], not {port}")
        self._status = StatusPipe(self)
        self._graph = GraphClient(self)
        # Its library, which no other node needs, is imported here.
        from hpid_ros.live.page.server import ServerSettings, serve

        settings = ServerSettings(host, port, token, rate, button_timeout=within)
        self._served = serve(self._graph, settings)
        url = self._served.url
        print(f"hpid live: {url}", flush=True)
        self._status.send("serving", url=url)
        if opens and any(os.environ.get(each) for each in _DISPLAYS):
            # A browser that nobody has used yet takes seconds.
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

    def begin_stop(self) -> Future | None:
        """Cancel a trial that is under way."""
        if not self._served.is_trying:
            return None
        self._served.cancel()
        has_ended = Future()

        def look() -> None:
            if not self._served.is_trying and not has_ended.done():
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
    ["host", "port", "token", "open_browser", "rate", "button_timeout", "status_fd"],
    [
        *("joint_states", "joint_commands", "CONTROLLER/reference", "CONTROLLER/transition_event"),
        *("/diagnostics", "/parameter_events"),
    ],
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the page."""
    return executor.run(lambda: [LiveTuner()], args, USAGE, niceness=_NICENESS)


if __name__ == "__main__":
    sys.exit(main())
