"""An excitation on a running graph: planned from what runs, carried out, recorded."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from hpid_ros.base.errors import RunError, SettingError, unknown_name
from hpid_ros.excitation.bounds import JointBounds, inertia_from_gains
from hpid_ros.excitation.plan import ExcitationPlan
from hpid_ros.experiment.graph.processes import NodeGroup, NodeProcess
from hpid_ros.experiment.live.graph import RunningController, RunningGraph

EXCITER, RECORDER = "hpid_exciter", "hpid_excitation_recorder"
_EXECUTABLE = "parts.live.exciter"
_UNLIMITED = 1e6  # what parameters say where there is no limit
_ENDS_WITHIN = 8.0  # [s], the joints' stop included
_LOOK_PERIOD = 0.05  # [s]
_REFERENCE_PERIODS, _LEAST_REFERENCE_TIMEOUT = 5.0, 0.5  # of ~/reference; [s]

Tell = Callable[[str, float], None]
"""Is called with the event, ``begun`` or ``at``, and the time since the start in [s]."""


def chosen(graph: RunningGraph, joints: Sequence[str]) -> list[RunningController]:
    """Return the controllers of the joints that are to be excited, in their order.

    Args:
        graph: What runs.
        joints: Names; all that run if there are none.

    Raises:
        SettingError: One does not run, tells no reference, or they are in several namespaces.
        RunError: Nobody says where a joint is.
    """
    for joint in joints:
        if joint not in graph.controllers:
            raise SettingError(unknown_name("joint", joint, graph.controllers))
    found = [graph.controllers[joint] for joint in dict.fromkeys(joints or graph.controllers)]
    spaces = {each.namespace for each in found}
    if len(spaces) > 1:
        raise SettingError(
            f"controllers of several namespaces run ({', '.join(sorted(spaces))}): choose the "
            f"joints of one with --joint"
        )
    for each in found:
        if each.position is None:
            raise RunError(f"there has been no state of {each.settings.joint}: is the robot on?")
        if each.introspection_rate == 0.0:
            raise SettingError(
                f"{each.node} has introspection_rate 0: without its ~/reference nobody sees "
                f"whether it follows; start it with 20"
            )
    return found


def bounds_of(controller: RunningController, inertia: float | None) -> JointBounds:
    """Return the bounds of a running controller's joint.

    Args:
        controller: The controller; its position is known.
        inertia: Of its joint in [kg m^2]; None where neither it nor anybody says so.

    Raises:
        SettingError: The inertia is unknown, and not to be taken from the gains.
    """
    settings, limits = controller.settings, controller.limits
    known = inertia or settings.inertia
    if not known and settings.model.is_decoupling:
        raise SettingError(
            f"the inertia of {settings.joint} must be given (--inertia or --urdf): its gains are "
            f"those of a unit inertia"
        )
    motion, effort = settings.motion, settings.effort
    assert controller.position is not None
    return JointBounds(
        settings.joint,
        controller.node,
        controller.position,
        controller.effort or 0.0,
        _limit(motion.position_min),
        _limit(motion.position_max),
        _limit(motion.velocity_max),
        (_limit(effort.u_clamp_min), _limit(effort.u_clamp_max)),
        known or inertia_from_gains(settings.gains.p, settings.gains.d),
        not known,
        limits.is_slide,
        is_endless=limits.is_continuous or settings.encoder.wrap > 0.0,
    )


def _limit(value: float) -> float:
    return value if abs(value) < _UNLIMITED else math.copysign(math.inf, value)


@dataclass(frozen=True)
class Ending:
    """How an excitation ended.

    Attributes:
        reason: Why it was stopped, in words; empty if it went to its end.
        is_interrupted: Whether somebody wanted it to end.
        is_at_rest: Whether the joints were seen to rest.
        lead: How long the recorder had been recording when it began, in [s].
    """

    reason: str
    is_interrupted: bool = False
    is_at_rest: bool = True
    lead: float = 0.0


def carry_out(
    plan: ExcitationPlan,
    controllers: Sequence[RunningController],
    graph: RunningGraph,
    bag: Path,
    states: str,
    tell: Tell,
) -> Ending:
    """Excite joints and record them; however it ends, the joints have come to rest before.

    Args:
        plan: The plan.
        controllers: Of its joints.
        graph: What runs; the bag keeps its controllers' parameters.
        bag: Folder to create.
        states: Topic of the states.
        tell: Told how far it is.

    Raises:
        RunError: It could not begin, a process has ended, or joints are not known to rest.
    """
    with tempfile.TemporaryDirectory(prefix="hpid_excite_") as folder:
        place = Path(folder)
        arguments = _arguments(controllers[0].namespace, states)
        order = place / "plan.json"
        order.write_text(json.dumps(_order(plan, controllers)))
        with (
            NodeGroup(os.environ, place) as group,
            recorded(group, graph, bag, place, arguments),
        ):
            exciter = group.start(EXCITER, _EXECUTABLE, [*arguments, "-p", f"plan_file:={order}"])
            return _watched(exciter, group.nodes[RECORDER], tell)


def _arguments(namespace: str, states: str) -> list[str]:
    remapped = ["-r", f"joint_states:={states}"] if states != "joint_states" else []
    return ["-r", f"__ns:={namespace}", *remapped]


def _order(plan: ExcitationPlan, controllers: Sequence[RunningController]) -> dict[str, Any]:
    timings = [each.settings.timing for each in controllers]
    rates = [each.introspection_rate for each in controllers if each.introspection_rate > 0.0]
    slowest = max((_REFERENCE_PERIODS / rate for rate in rates), default=0.0)
    return {
        "plan": plan.as_mapping(),
        "recorder": RECORDER,
        "takeover_time": max(each.takeover_time for each in timings),
        "reference_timeout": max(_LEAST_REFERENCE_TIMEOUT, slowest),
        "is_simulated": all(each.is_simulated for each in timings),
    }


@contextmanager
def recorded(
    group: NodeGroup, graph: RunningGraph, bag: Path, place: Path, arguments: Sequence[str]
) -> Iterator[None]:
    """Record while the block runs, and close the bag when nothing is told any more.

    Args:
        group: Takes the recorder.
        graph: What runs; the bag keeps its controllers' parameters.
        bag: Folder to create.
        place: Folder for what the recorder needs.
        arguments: ROS arguments that put it beside the controllers.

    Raises:
        RunError: The recorder has failed.
    """
    parameters = place / "controllers.yaml"
    parameters.write_text(yaml.safe_dump(dict(graph.document), sort_keys=False))
    commands = ["joint_commands"] if graph.has_commands else []
    topics = ["/parameter_events", "joint_trajectory", *commands, "joint_states"]
    of_recorder = [
        f"bag:={bag.resolve()}",
        f"controllers_file:={parameters}",
        f"topics:={topics}",
    ]
    flags = [text for each in of_recorder for text in ("-p", each)]
    recorder = group.start(RECORDER, "bag_recorder", [*arguments, *flags])
    try:
        yield
    finally:
        recorder.read_events()
        group.stop([RECORDER], patience=_ENDS_WITHIN)
    if recorder.process.returncode:
        raise RunError(f"the recorder has failed: {recorder.last_words()}")


def _watched(exciter: NodeProcess, recorder: NodeProcess, tell: Tell) -> Ending:
    """Wait for the end; an interrupt, or the recorder's end, is a reason to stop."""
    recording_at = begun_at = time.monotonic()

    def told(event: str, seconds: float) -> None:
        nonlocal begun_at
        if event == "begun":
            begun_at = time.monotonic()
        tell(event, seconds)

    try:
        while True:
            # A pipe that nobody reads would hold the recorder up.
            if any(each["event"] == "recording" for each in recorder.read_events()):
                recording_at = time.monotonic()
            ending = _ending(exciter, told)
            if ending is not None:
                return replace(ending, lead=begun_at - recording_at)
            if recorder.process.poll() is not None:
                return _stopped(exciter, f"the recorder has ended: {recorder.last_words()}")
            time.sleep(_LOOK_PERIOD)
    except KeyboardInterrupt:
        return _stopped(exciter, "it was interrupted", is_interrupted=True)


def _stopped(exciter: NodeProcess, reason: str, *, is_interrupted: bool = False) -> Ending:
    """Ask the exciter to stop the joints, and return when they rest.

    Raises:
        RunError: Nobody has stopped them.
    """
    exciter.process.send_signal(signal.SIGINT)
    try:
        exciter.process.wait(_ENDS_WITHIN)
    except subprocess.TimeoutExpired:
        raise RunError(
            f"{reason}; the exciter has not stopped the joints within {_ENDS_WITHIN:g} s: they "
            f"go on to the end of the trajectory, deactivate their controllers"
        ) from None
    ended = [each for each in exciter.read_events() if each["event"] in ("done", "stopped")]
    is_at_rest = all(each["is_at_rest"] for each in ended)
    return Ending(reason, is_interrupted, is_at_rest)


def _ending(exciter: NodeProcess, tell: Tell) -> Ending | None:
    has_ended = exciter.process.poll() is not None
    for event in exciter.read_events():
        kind = event["event"]
        if kind == "failed":
            raise RunError(f"nothing was moved: {event['reason']}")
        if kind in ("done", "stopped"):
            exciter.process.wait(_ENDS_WITHIN)
            return Ending(str(event["reason"]), is_at_rest=bool(event["is_at_rest"]))
        tell(kind, float(event.get("seconds", 0.0)))
    if has_ended:
        raise RunError(
            f"the exciter has ended by itself ({exciter.last_words()}): what was under way "
            f"goes on to the end of its trajectory, and holds there"
        )
    return None
