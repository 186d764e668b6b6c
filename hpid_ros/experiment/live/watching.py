"""A process beside a running graph that moves joints: recorded, watched, and stopped in time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpid_ros.base.errors import RunError
from hpid_ros.experiment.graph.processes import NodeGroup, NodeProcess
from hpid_ros.experiment.live.button import Button
from hpid_ros.experiment.live.graph import RunningGraph

RECORDER = "hpid_excitation_recorder"
_ENDS_WITHIN = 8.0  # [s], the joints' stop included
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
    executable: str  # module below hpid_ros.nodes
    unless_stopped: str  # what joints do if nobody stops them, in words
    topics: tuple[str, ...]  # that it publishes, and that are recorded


@dataclass(frozen=True)
class Ending:
    """How an excitation ended."""

    reason: str  # why it was stopped, in words; empty if it went to its end
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
