"""Controllers of a running graph, and processes that move joints: recorded, watched, stopped.

The graph is asked in a process of its own: whoever asks need not have ROS.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.files import find_resource
from hpid_ros.control.controller_files import RobotLimits, settings_from_parameters
from hpid_ros.control.settings import LoopSettings
from hpid_ros.experiment.processes import NodeGroup, NodeProcess
from hpid_ros.robot.description import RobotDescription

HELD_WITHIN = 0.4
"""Longest time between two presses, in [s]; who holds the button presses several times in it."""

_ENDS_WITHIN = 8.0  # [s] from the release


class Button:
    """Bytes on a process's standard input while somebody holds it, and its end afterwards."""

    def __init__(self, within: float = HELD_WITHIN) -> None:
        self.within = within
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._released_at: float | None = None

    @property
    def is_released(self) -> bool:
        """Whether it has been released; it cannot be pressed again."""
        return self._released_at is not None

    def press(self) -> None:
        """Say that it is held: several times in the time allowed, or joints stop."""
        with self._lock:
            if self._process is None or self._process.stdin is None or self.is_released:
                return
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                os.write(self._process.stdin.fileno(), b".")

    def release(self) -> None:
        """Have the joints stop."""
        with self._lock:
            if self._released_at is None:
                self._released_at = time.monotonic()
            self._close()

    def is_overdue(self) -> bool:
        """Return whether the process should have ended long ago."""
        released_at = self._released_at
        return released_at is not None and time.monotonic() - released_at > _ENDS_WITHIN

    @contextlib.contextmanager
    def held_for(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """Tell this process while the block runs."""
        assert process.stdin is not None
        os.set_blocking(process.stdin.fileno(), False)
        with self._lock:
            self._process = process
            if self.is_released:
                self._close()
        try:
            yield
        finally:
            with self._lock:
                self._close()

    def _close(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._process = None


_READER = "hpid_ros.live.graph_reader"


@dataclass(frozen=True)
class RunningController:
    """A joint controller that runs."""

    node: str  # its full name
    settings: LoopSettings  # active, within the limits of its robot
    limits: RobotLimits  # those of its robot, which are in the settings already
    introspection_rate: float  # [Hz] of its ~/reference
    position: float | None  # [rad] or [m], where its joint is; None if nobody says so
    effort: float | None  # [N m] or [N], its mean effort; None likewise

    @property
    def namespace(self) -> str:
        """Of the node."""
        return self.node.rpartition("/")[0] or "/"


@dataclass(frozen=True)
class RunningGraph:
    """What runs."""

    controllers: Mapping[str, RunningController]  # by joint, in the order of the nodes' names
    document: Mapping[str, Any]  # their parameters, as a parameter file has them
    has_commands: bool  # whether they told efforts on joint_commands


def running_loops() -> dict[str, LoopSettings]:
    """Return the settings of all running controllers by the names of their nodes."""
    return settings_from_parameters(_read()["controllers"], "the running graph")


def running_graph(states: str = "joint_states", namespace: str | None = None) -> RunningGraph:
    """Return what runs, and where the joints are."""
    below = f"/{namespace.strip('/')}" if namespace else ""
    read = _read(states, below)
    document = read["controllers"]
    found: dict[str, RunningController] = {}
    settings_from_parameters(document, f"the running graph {below}".rstrip())
    for node, section in document.items():
        values = section["ros__parameters"]
        (settings,) = settings_from_parameters({node: section}, "the running graph").values()
        if settings.joint in found:
            both = f"{found[settings.joint].node} and {node}"
            raise SettingError(
                f"{settings.joint} has two controllers, {both}: choose one's with --namespace"
            )
        limits = described_limits(str(values.get("robot_description") or ""), settings.joint)
        state = read["joints"].get(settings.joint, {})
        found[settings.joint] = RunningController(
            node,
            limits.within(settings),
            limits,
            float(values.get("introspection_rate") or 0.0),
            _finite(state.get("position")),
            _finite(state.get("effort")),
        )
    return RunningGraph(found, document, bool(read["has_commands"]))


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def described_limits(source: str, joint: str) -> RobotLimits:
    """Return the limits of a joint in the description that its controller has."""
    if not source:
        return RobotLimits()
    if not source.lstrip().startswith("<"):
        try:
            source = str(find_resource(source))
        except HpidError as error:
            raise RunError(
                f"robot_description of the controller of {joint} is a file that is not here: "
                f"{error}"
            ) from None
    (found,) = RobotDescription.load(source).select([joint])
    return RobotLimits.of(found)


def _read(*arguments: str) -> dict[str, Any]:
    reader = subprocess.run(
        [sys.executable, "-m", _READER, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if reader.returncode:
        lines = reader.stderr.strip().splitlines()
        raise RunError(f"cannot read the running graph: {lines[-1] if lines else 'no answer'}")
    return dict(json.loads(reader.stdout))


RECORDER = "hpid_excitation_recorder"
_LOOK_PERIOD = 0.05  # [s]
_ENDINGS = ("done", "stopped", "failed")

RELEASED = "the button was released"
"""Why a motion that is held has ended: nobody has said for a while that it is."""

Tell = Callable[[str, float], None]
"""Is called with the event, ``begun`` or ``at``, and the time since the start in [s].

Where a button must be held also with ``ready``.
"""


class Mover(NamedTuple):
    """A process that moves joints."""

    name: str  # of its node
    executable: str  # module below hpid_ros, see module_of
    unless_stopped: str  # what joints do if nobody stops them
    topics: tuple[str, ...]  # that it publishes, and that are recorded


@dataclass(frozen=True)
class Ending:
    """How an excitation ended."""

    reason: str  # why it was stopped; empty if it went to its end
    is_interrupted: bool = False  # whether somebody wanted it to end
    is_at_rest: bool = True  # whether the joints were seen to rest


def carried_out(
    mover: Mover,
    order: Mapping[str, Any],
    graph: RunningGraph,
    namespace: str,
    bag: Path,
    states: str,
    tell: Tell,
    button: Button | None = None,
) -> Ending:
    """Run a process that moves joints, and record; however it ends, it has let the joints rest."""
    remapped = ["-r", f"joint_states:={states}"] if states != "joint_states" else []
    arguments = ["-r", f"__ns:={namespace}", *remapped]
    with tempfile.TemporaryDirectory(prefix="hpid_live_") as folder:
        place = Path(folder)
        file = place / "plan.json"
        whole = {**order, "recorder": RECORDER, "held_within": button and button.within}
        file.write_text(json.dumps(whole))
        with (
            NodeGroup(os.environ, place) as group,
            _recorded(group, graph, mover.topics, bag, place, arguments) as recorder,
        ):
            of_mover = [*arguments, "-p", f"plan_file:={file}"]
            process = group.start(
                mover.name, mover.executable, of_mover, has_input=button is not None
            )
            if button is None:
                return _watched(mover, process, recorder, tell, lambda: False)
            with button.held_for(process.process):
                return _watched(mover, process, recorder, tell, button.is_overdue)


@contextmanager
def _recorded(
    group: NodeGroup,
    graph: RunningGraph,
    told: Sequence[str],
    bag: Path,
    place: Path,
    arguments: Sequence[str],
) -> Iterator[NodeProcess]:
    """Record while the block runs, and close the bag when nothing is told any more."""
    parameters = place / "controllers.yaml"
    parameters.write_text(yaml.safe_dump(dict(graph.document), sort_keys=False))
    commands = ["joint_commands"] if graph.has_commands else []
    topics = ["/parameter_events", *told, *commands, "joint_states"]
    of_recorder = [
        f"bag:={bag.resolve()}",
        f"controllers_file:={parameters}",
        f"topics:={topics}",
    ]
    slides = [name for name, each in graph.controllers.items() if each.limits.is_slide]
    if slides:
        of_recorder.append(f"slides:={slides}")
    flags = [text for each in of_recorder for text in ("-p", each)]
    recorder = group.start(RECORDER, "bag_recorder", [*arguments, *flags])
    try:
        yield recorder
    finally:
        recorder.read_events()
        group.stop([RECORDER], patience=_ENDS_WITHIN)
    if recorder.process.returncode:
        raise RunError(f"the recorder has failed: {recorder.last_words()}")


def _watched(
    mover: Mover,
    process: NodeProcess,
    recorder: NodeProcess,
    tell: Tell,
    is_overdue: Callable[[], bool],
) -> Ending:
    """Wait for the end; an interrupt, or the recorder's end, is a reason to stop.

    So is an end that is overdue.
    """
    try:
        while True:
            recorder.read_events()  # a pipe that nobody reads would hold the recorder up
            ending = _ending(mover, process, tell)
            if ending is not None:
                return ending
            if recorder.process.poll() is not None:
                return _stopped(mover, process, f"the recorder has ended: {recorder.last_words()}")
            if is_overdue():
                return _stopped(mover, process, RELEASED)
            time.sleep(_LOOK_PERIOD)
    except KeyboardInterrupt:
        return _stopped(mover, process, "it was interrupted", is_interrupted=True)


def _stopped(
    mover: Mover, process: NodeProcess, reason: str, *, is_interrupted: bool = False
) -> Ending:
    """Ask the process to stop the joints, and return when they rest."""
    process.process.send_signal(signal.SIGINT)
    try:
        process.process.wait(_ENDS_WITHIN)
    except subprocess.TimeoutExpired:
        raise RunError(
            f"{reason}; {mover.name} has not stopped the joints within {_ENDS_WITHIN:g} s: "
            f"{mover.unless_stopped}; deactivate their controllers"
        ) from None
    told = [each for each in process.read_events() if each["event"] in _ENDINGS]
    if not told and process.process.returncode:
        raise RunError(f"{reason}; {_by_itself(mover, process)}; deactivate their controllers")
    is_at_rest = all(each.get("is_at_rest", True) for each in told)
    return Ending(reason, is_interrupted, is_at_rest)


def _by_itself(mover: Mover, process: NodeProcess) -> str:
    return f"{mover.name} has ended by itself ({process.last_words()}): {mover.unless_stopped}"


def _ending(mover: Mover, process: NodeProcess, tell: Tell) -> Ending | None:
    has_ended = process.process.poll() is not None
    for event in process.read_events():
        kind = event["event"]
        if kind == "failed":
            raise RunError(f"nothing was moved: {event['reason']}")
        if kind in ("done", "stopped"):
            with suppress(subprocess.TimeoutExpired):  # it has done what it was to do
                process.process.wait(_ENDS_WITHIN)
            return Ending(str(event["reason"]), is_at_rest=bool(event["is_at_rest"]))
        tell(kind, float(event.get("seconds", 0.0)))
    if has_ended:
        raise RunError(_by_itself(mover, process))
    return None
