"""Do nodes find each other: ``python -m benchmarks.discovery [--ends KIND ...] [--number N]``.

Some processes watch a graph of their own while controllers come and go beside them, each of which
ends in one of the ways below; after every end a new controller must be found by all. Prints for
each kind of end how long that took, how many controllers somebody lists 30 s after they ended (the
middleware may take a node's last message after it has seen its participant end), and how many were
stuck when they ended. Exit codes: 0 all were found in time, 1 one was not, 2 unusable arguments,
130 interrupted. ``--lease 0.6`` shows what looking for overdue participants does (docs/faults.md).

=======  =========================================================================================
end      SIGTERM, as a launch ends a node
launch   SIGTERM to eight at once, as a launch ends a robot
refuse   parameters that are refused
rival    the joint is another controller's
kill     SIGKILL
freeze   SIGSTOP for 2.5 s, then SIGTERM
=======  =========================================================================================
"""

from __future__ import annotations

import argparse
import os
import random
import re
import select
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import rclpy

from hpid_bench.experiment.processes import closed_environment, own_domain
from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.base.processes import heed_interrupts
from hpid_ros.nodes import joint_controller
from hpid_ros.nodes.core.process import end

ENDS = ("end", "launch", "refuse", "rival", "kill", "freeze")
TRANSPORTS = {  # what is asked of Fast DDS beyond the domain
    "closed": {},
    "udp": {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    "default": {"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"},  # UDP, and shared memory beside it
}
_LOST_AFTER = 30.0  # [s]
_FROZEN = 2.5  # [s]
_LAUNCHED = 8
_PRESENT = (0.2, 1.5)  # [s] that a controller is there before it is killed or frozen
_OUTPUT = os.devnull
_FAILED, _INTERRUPTED = 1, 130


class _Children:
    """Processes forked from this one, which has imported everything and started no middleware."""

    def __init__(self) -> None:
        self.pids: set[int] = set()

    def fork(self, act: Callable[[], object]) -> int:
        pid = os.fork()
        if not pid:
            output = os.open(_OUTPUT, os.O_WRONLY)
            os.dup2(output, 1)
            os.dup2(output, 2)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            act()
            end(0)
        self.pids.add(pid)
        return pid

    def send(self, pid: int, number: signal.Signals) -> None:
        os.kill(pid, number)

    def wait(self, pid: int) -> int:
        """Return the exit code, once it has ended; negative for a signal."""
        _, status = os.waitpid(pid, 0)
        self.pids.discard(pid)
        return os.waitstatus_to_exitcode(status)

    def end(self) -> None:
        for pid in list(self.pids):
            os.kill(pid, signal.SIGKILL)
            self.wait(pid)


def _watch(pipe: int) -> NoReturn:
    """Write ``+N`` when a controller ``probe_N`` is there, and ``-N`` when it has gone."""
    rclpy.init(args=[])
    node = rclpy.create_node(f"watcher_{os.getpid()}")
    seen: set[str] = set()
    while True:
        rclpy.spin_once(node, timeout_sec=0.01)
        here = {name for name in node.get_node_names() if name.startswith("probe_")}
        for sign, names in (("+", here - seen), ("-", seen - here)):
            for name in names:
                os.write(pipe, f"{sign}{name.removeprefix('probe_')}\n".encode())
        seen = here


def _control(name: str, *parameters: str) -> Callable[[], object]:
    given = [word for each in parameters for word in ("-p", each)]
    return lambda: joint_controller.main(
        ["joint_controller", "--ros-args", "-r", f"__node:={name}", *given]
    )


class _Graph:
    """Watchers, a controller that stays, and what comes and goes."""

    def __init__(self, children: _Children, watchers: int) -> None:
        self._children, self._watchers = children, watchers
        self._reader, writer = os.pipe()
        for _ in range(watchers):
            children.fork(lambda: _watch(writer))
        children.fork(_control("resident", "joint:=taken", "gains.p:=1.0"))
        self._number = 0
        self.stuck = 0
        self._told: Counter[str] = Counter()

    def disturb(self, kind: str, number: int) -> None:
        children, is_refused = self._children, kind in ("refuse", "rival")
        names = [f"visitor_{number}_{k}" for k in range(_LAUNCHED if kind == "launch" else 1)]
        more = ("gains.p:=1.0", "mu:=0.9") if kind == "refuse" else ("gains.p:=1.0",)
        pids = [
            children.fork(_control(name, f"joint:={'taken' if kind == 'rival' else name}", *more))
            for name in names
        ]
        if not is_refused:
            time.sleep(random.uniform(*_PRESENT) + (kind == "launch"))
        if kind == "freeze":
            children.send(pids[0], signal.SIGSTOP)
            time.sleep(_FROZEN)
            children.send(pids[0], signal.SIGCONT)
        if not is_refused:
            for pid in pids:
                children.send(pid, signal.SIGKILL if kind == "kill" else signal.SIGTERM)
        codes = [children.wait(pid) for pid in pids]
        if kind != "kill" and not is_refused:
            self.stuck += sum(code != 0 for code in codes)

    def probe(self) -> float | None:
        """Return how long a new controller took to be found by all in [s], None if for ever."""
        self._number += 1
        number, begun = self._number, time.monotonic()
        pid = self._children.fork(_control(f"probe_{number}", f"joint:=probe_{number}"))
        is_found = self._all_tell([f"+{number}"])
        took = time.monotonic() - begun
        self._children.send(pid, signal.SIGTERM)
        self.stuck += self._children.wait(pid) != 0
        return took if is_found else None

    def ghosts(self) -> int:
        """Return how many controllers that have ended are listed by somebody, and stay so."""
        wanted = [f"-{number}" for number in range(1, self._number + 1)]
        self._all_tell(wanted)
        return sum(self._told[each] < self._watchers for each in wanted)

    def _all_tell(self, wanted: Sequence[str]) -> bool:
        deadline = time.monotonic() + _LOST_AFTER
        while any(self._told[each] < self._watchers for each in wanted):
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            if select.select([self._reader], [], [], left)[0]:
                self._told.update(os.read(self._reader, 1 << 16).decode().split())
        return True


@contextmanager
def _graph(options: argparse.Namespace) -> Iterator[_Graph]:
    children = _Children()
    with own_domain() as domain, tempfile.NamedTemporaryFile("w", suffix=".xml") as profile:
        os.environ.update(closed_environment(domain) | TRANSPORTS[options.transport])
        if options.lease is not None:
            text = Path(os.environ[PROFILE_FILES[0]]).read_text()
            seconds, rest = divmod(round(options.lease * 1e9), 10**9)
            lease = f"<leaseDuration><sec>{seconds}</sec><nanosec>{rest}</nanosec></leaseDuration>"
            profile.write(re.sub("<leaseDuration>.*</leaseDuration>", lease, text))
            profile.flush()
            os.environ.update(dict.fromkeys(PROFILE_FILES, profile.name))
        try:
            graph = _Graph(children, options.watchers)
            graph.probe()  # until all is there
            yield graph
        finally:
            children.end()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmarks.discovery", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--ends", nargs="+", choices=ENDS, default=ENDS, metavar="KIND")
    parser.add_argument("--number", type=int, default=100, help="ends of each kind")
    parser.add_argument("--watchers", type=int, default=4)
    parser.add_argument("--transport", choices=TRANSPORTS, default="closed")
    parser.add_argument("--lease", type=float, help="of every participant, in [s] (an hour)")
    parser.add_argument("--within", type=float, default=3.0, help="in time, in [s]")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print a line for each kind of end, and say whether all were found in time."""
    options = _parser().parse_args(arguments)
    heed_interrupts()
    late = 0
    counted = f"{'late':>6}{'never':>7}{'ghosts':>8}{'stuck':>7}"
    print(f"{'ends':8}{'number':>7}{'median':>8}{'99 %':>8}{'largest':>9}{counted}")
    try:
        for kind in options.ends:
            with _graph(options) as graph:
                took = []
                for number in range(options.number):
                    graph.disturb(kind, number)
                    took.append(graph.probe())
                ghosts = graph.ghosts()
            found = sorted(each for each in took if each is not None)
            never = len(took) - len(found)
            late_ones = sum(each > options.within for each in found)
            late += never + late_ones
            figures = [
                statistics.median(found or [float("nan")]),
                found[int(0.99 * len(found))] if found else float("nan"),
                max(found, default=float("nan")),
            ]
            median, high, largest = (f"{each:.2f}" for each in figures)
            counts = f"{late_ones:6}{never:7}{ghosts:8}{graph.stuck:7}"
            print(f"{kind:8}{len(took):7}{median:>8}{high:>8}{largest:>9}{counts}", flush=True)
    except KeyboardInterrupt:
        return _INTERRUPTED
    return _FAILED if late else 0


if __name__ == "__main__":
    sys.exit(main())
