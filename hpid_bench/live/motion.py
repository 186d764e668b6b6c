"""Motions of a running joint: an excitation or a relay test, recorded, watched, analysed.

What moves joints is a process of its own, which stops them when its parent or its button is gone.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

from hpid_bench.experiment.processes import NodeGroup, NodeProcess, Process, parameters
from hpid_bench.live.known_controllers import RunningController, RunningGraph
from hpid_bench.tuning.autotune import RelayCycle, relay_cycle
from hpid_bench.tuning.identification.identify import identify
from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.identification.regression import DELAY, INERTIA
from hpid_ros.base.errors import RunError, SettingError, unknown_name
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import seconds_since
from hpid_ros.motion.excitation import (
    ExcitationPlan,
    JointBounds,
    PlannedRelay,
    inertia_from_gains,
)

HELD_WITHIN = 0.4
"""Longest time between two presses, in [s]; who holds the button presses several times in it."""

_WATCHED_WITHIN = 2.0  # [s] for a sign of life of this process, where nobody holds a button
_ENDS_WITHIN = 8.0  # [s] from the release


class Button:
    """Bytes on a process's standard input while somebody holds it, and its end afterwards."""

    def __init__(self, within: float = HELD_WITHIN) -> None:
        self.within = within
        self._lock = threading.Lock()
        self._input: IO[bytes] | None = None  # of the process that it is held for
        self._released_at: float | None = None

    def press(self) -> None:
        """Say that it is held: several times in the time allowed, or joints stop."""
        with self._lock, suppress(BlockingIOError, BrokenPipeError):
            if self._input is not None and self._released_at is None:
                os.write(self._input.fileno(), b".")

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

    @contextmanager
    def held_for(self, process: Process) -> Iterator[None]:
        """Tell this process while the block runs."""
        assert process.stdin is not None
        os.set_blocking(process.stdin.fileno(), False)
        with self._lock:
            self._input = process.stdin
            if self._released_at is not None:
                self._close()
        try:
            yield
        finally:
            with self._lock:
                self._close()

    def _close(self) -> None:
        if self._input is not None:
            with suppress(OSError):
                self._input.close()
            self._input = None


RECORDER = "hpid_excitation_recorder"
_LOOK_PERIOD = 0.05  # [s]
_ENDINGS = ("done", "stopped", "failed")

BUTTON_RELEASED = "the button was released"
"""Why a motion that is held has ended: nobody has said for a while that it is."""

TellMotion = Callable[[str, float], None]
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
    # where the references stood when it began, in the order of its joints; empty if it did not
    began_at: tuple[float, ...] = ()


def carried_out(
    mover: Mover,
    order: Mapping[str, Any],
    graph: RunningGraph,
    namespace: str,
    bag: Path,
    tell: TellMotion,
    button: Button | None = None,
) -> Ending:
    """Run a process that moves joints, and record; however it ends, it has let the joints rest."""
    remapped = ["-r", f"joint_states:={graph.states}"] if graph.states != "joint_states" else []
    arguments = ["-r", f"__ns:={namespace}", *remapped]
    with tempfile.TemporaryDirectory(prefix="hpid_live_") as folder:
        place = Path(folder)
        file = place / "plan.json"
        whole = {
            **order,
            "recorder": RECORDER,
            "held_within": button and button.within,
            "watched_within": None if button else _WATCHED_WITHIN,
        }
        file.write_text(json.dumps(whole))
        with (
            NodeGroup(os.environ, place) as group,
            _recorded(group, graph, mover.topics, bag, place, arguments) as recorder,
        ):
            of_mover = [*arguments, *parameters(plan_file=file)]
            process = group.start(mover.name, mover.executable, of_mover, has_input=True)
            held = button or Button(_WATCHED_WITHIN)
            with held.held_for(process.process):
                return _watched(mover, process, recorder, tell, held, is_own=button is None)


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
    file = place / "controllers.yaml"
    file.write_text(dump_yaml(dict(graph.document)), encoding="utf-8")
    commands = ["joint_commands"] if graph.has_commands else []
    topics = ["/parameter_events", *told, *commands, "joint_states"]
    slides = [name for name, each in graph.controllers.items() if each.limits.is_slide]
    of_slides = {"slides": slides} if slides else {}
    flags = parameters(bag=bag.resolve(), controllers_file=file, topics=topics, **of_slides)
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
    tell: TellMotion,
    button: Button,
    *,
    is_own: bool,  # whether this process presses it, and no person
) -> Ending:
    """Wait for the end; an interrupt, the recorder's end or one that is overdue is one, too."""
    try:
        while True:
            if is_own:  # not while Ctrl-Z has stopped this process
                button.press()
            recorder.read_events()  # a pipe that nobody reads would hold the recorder up
            ending = _ending(mover, process, tell)
            if ending is not None:
                return ending
            if recorder.process.poll() is not None:
                return _stopped(mover, process, f"the recorder has ended: {recorder.last_words()}")
            if button.is_overdue():
                return _stopped(mover, process, BUTTON_RELEASED)
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
    return Ending(reason, is_interrupted, is_at_rest, *map(_began_at, told[-1:]))


def _by_itself(mover: Mover, process: NodeProcess) -> str:
    return f"{mover.name} has ended by itself ({process.last_words()}): {mover.unless_stopped}"


def _ending(mover: Mover, process: NodeProcess, tell: TellMotion) -> Ending | None:
    has_ended = process.process.poll() is not None
    for event in process.read_events():
        kind = event["event"]
        if kind == "failed":
            raise RunError(f"nothing was moved: {event['reason']}")
        if kind in ("done", "stopped"):
            with suppress(subprocess.TimeoutExpired):  # it has done what it was to do
                process.process.wait(_ENDS_WITHIN)
            is_at_rest = bool(event["is_at_rest"])
            return Ending(str(event["reason"]), is_at_rest=is_at_rest, began_at=_began_at(event))
        tell(kind, float(event.get("seconds", 0.0)))
    if has_ended:
        raise RunError(_by_itself(mover, process))
    return None


def _began_at(event: Mapping[str, Any]) -> tuple[float, ...]:
    return tuple(map(float, event.get("began_at", ())))


_EXCITER = Mover(
    "hpid_exciter",
    "live.exciter",
    "what was under way goes on to the end of its trajectory, and holds there",
    ("joint_trajectory",),
)
_UNLIMITED = 1e6  # what parameters say where there is no limit
_REFERENCE_PERIODS, _LEAST_REFERENCE_TIMEOUT = 5.0, 0.5  # of ~/reference; [s]


def chosen_controllers(graph: RunningGraph, joints: Sequence[str]) -> list[RunningController]:
    """Return the controllers of the joints that are to be excited, in their order."""
    for joint in joints:
        if joint not in graph.controllers:
            raise SettingError(unknown_name("joint", joint, graph.controllers))
    found = [graph.controllers[joint] for joint in dict.fromkeys(joints or graph.controllers)]
    spaces = {each.namespace for each in found}
    if len(spaces) > 1:
        raise SettingError(
            f"controllers of several namespaces run ({', '.join(sorted(spaces))}): choose the "
            f"joints of one namespace only (--joint)"
        )
    for each in found:
        if each.position is None:
            raise RunError(f"there has been no state of {each.joint}: is the robot on?")
        if each.introspection_rate == 0.0:
            raise SettingError(
                f"{each.node} has introspection_rate 0: without its ~/reference nobody sees "
                f"whether it follows; start it with 20"
            )
    return found


def bounds_of(controller: RunningController, inertia: float | None) -> JointBounds:
    settings, limits = controller.settings, controller.limits
    known = inertia or settings.inertia
    if not known and settings.model.is_decoupling:
        raise SettingError(
            f"the inertia of {settings.joint} must be known: set its parameter inertia, or give "
            f"--inertia or --urdf; its gains are those of a unit inertia"
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
        is_endless=limits.is_continuous or settings.encoder.encoder_wrap > 0.0,
    )


def _limit(value: float) -> float:
    return value if abs(value) < _UNLIMITED else math.copysign(math.inf, value)


def carry_out(
    plan: ExcitationPlan,
    controllers: Sequence[RunningController],
    graph: RunningGraph,
    bag: Path,
    tell: TellMotion,
    button: Button | None = None,
    ends_at: Sequence[float] | None = None,
) -> Ending:
    """Excite joints and record them; however it ends, the joints have come to rest before.

    Their references begin where they stand, or end where it is said.
    """
    timings = [each.settings.timing for each in controllers]
    rates = [each.introspection_rate for each in controllers if each.introspection_rate > 0.0]
    slowest = max((_REFERENCE_PERIODS / rate for rate in rates), default=0.0)
    order = {
        "plan": plan.as_mapping(),
        "takeover_time": max(each.takeover_time for each in timings),
        "reference_timeout": max(_LEAST_REFERENCE_TIMEOUT, slowest),
        "is_simulated": all(each.is_simulated for each in timings),
        "ends_at": ends_at if ends_at is None else list(ends_at),
    }
    return carried_out(_EXCITER, order, graph, controllers[0].namespace, bag, tell, button)


class HeldMotion:
    """One motion, in a thread of its own; every method returns at once.

    It begins with the first :meth:`press` after it is ``ready``, goes on while presses come at
    least as often as they must, and otherwise the joints come to rest. It is recorded either way.
    """

    def __init__(
        self,
        plan: ExcitationPlan,
        controllers: Sequence[RunningController],
        graph: RunningGraph,
        bag: Path,
        within: float = HELD_WITHIN,
        ends_at: Sequence[float] | None = None,
    ) -> None:
        self.bag = bag
        self.stage: Literal["preparing", "ready", "moving", "ended"] = "preparing"
        self.seconds = 0.0
        self._button = button = Button(within)
        self._ended: Future[Ending] = Future()
        self.press = button.press  # says that the button is held
        self.release = button.release  # joints come to rest; it cannot be taken up again

        def run() -> None:
            try:
                ending = carry_out(plan, controllers, graph, bag, self._tell, button, ends_at)
                self._ended.set_result(ending)
            except BaseException as error:  # raised where somebody asks for the ending
                self._ended.set_exception(error)
            finally:
                button.release()
                self.stage = "ended"

        # Its children get SIGTERM from the kernel when the thread that started them ends.
        threading.Thread(target=run, name="held motion", daemon=True).start()

    @property
    def ending(self) -> Ending | None:
        """How it ended, once its recording is closed; None before."""
        return self._ended.result() if self._ended.done() else None

    def _tell(self, event: str, seconds: float) -> None:
        self.seconds = max(self.seconds, seconds)
        self.stage = "ready" if event == "ready" else "moving"


_UNSURE = 0.15  # of an inertia that only the limit cycle tells


def carry_out_relay(
    planned: PlannedRelay,
    controller: RunningController,
    graph: RunningGraph,
    bag: Path,
    tell: TellMotion,
) -> Ending:
    """Have a relay drive a joint for some cycles, and record it."""
    mover = Mover(
        "hpid_relay_tester",
        "live.relay_tester",
        "the relay gives the joint back by itself",
        (f"{controller.node}/relay",),
    )
    order = {"controller": controller.node, "request": list(astuple(planned.request))}
    return carried_out(mover, order, graph, controller.namespace, bag, tell)


class RelayFindings(NamedTuple):
    """What the bag of a relay test tells of the joint."""

    cycle: RelayCycle  # the limit cycle
    identified: JointIdentification  # the joint, by the equation of motion
    inertia: tuple[float, float]  # [kg m^2] least and largest that it may have
    delay: float  # [s] from effort to motion; 0 if it is not told
    is_by_cycle: bool  # whether the inertia is the limit cycle's, for want of a better one


def relay_findings(
    bag: Path, controller: RunningController, planned: PlannedRelay
) -> RelayFindings:
    joint = controller.joint
    recording = read_run(bag, "relay", joints=[joint], progress=lambda share: None)
    (series,) = recording.joints
    record = JointRecord(
        joint,
        seconds_since(series.state_stamps_ns, recording.start_ns),
        series.position,
        seconds_since(series.command_stamps_ns, recording.start_ns),
        series.effort,
    )
    gains, request = controller.settings.gains, planned.request
    cycle = relay_cycle(record, request.amplitude, request.hysteresis, gains.d / gains.p)
    identified = identify([record])[0]
    inertia, delay = identified.reliable(INERTIA), identified.reliable(DELAY)
    if inertia is not None and inertia.low > 0.0:
        bounds = inertia.low, inertia.high
    elif cycle.inertia > 0.0:
        bounds = (1.0 - _UNSURE) * cycle.inertia, (1.0 + _UNSURE) * cycle.inertia
    else:
        raise SettingError(
            f"the limit cycle of {joint} tells no inertia: its effort and motion "
            f"are in phase, as against a spring"
        )
    return RelayFindings(
        cycle,
        identified,
        bounds,
        max(delay.value, 0.0) if delay is not None else 0.0,
        inertia is None,
    )
