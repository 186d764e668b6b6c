"""Motions of a running joint: an excitation or a relay test, recorded and analysed."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any, Literal, NamedTuple

from hpid_ros.base.errors import RunError, SettingError, unknown_name
from hpid_ros.live.controllers import (
    HELD_WITHIN,
    Button,
    Ending,
    Mover,
    RunningController,
    RunningGraph,
    Tell,
    carried_out,
)
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import seconds_since
from hpid_ros.motion.excitation import ExcitationPlan, JointBounds, inertia_from_gains
from hpid_ros.motion.relays import PlannedRelay
from hpid_ros.tuning.identification_results import DELAY, INERTIA, JointIdentification
from hpid_ros.tuning.identify import identify
from hpid_ros.tuning.measurements import JointRecord
from hpid_ros.tuning.relay_identification import RelayCycle, relay_cycle

_EXCITER = Mover(
    "hpid_exciter",
    "live.exciter",
    "what was under way goes on to the end of its trajectory, and holds there",
    ("joint_trajectory",),
)
_UNLIMITED = 1e6  # what parameters say where there is no limit
_REFERENCE_PERIODS, _LEAST_REFERENCE_TIMEOUT = 5.0, 0.5  # of ~/reference; [s]


def chosen(graph: RunningGraph, joints: Sequence[str]) -> list[RunningController]:
    """Return the controllers of the joints that are to be excited, in their order."""
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
    """Return the bounds of a running controller's joint."""
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


def carry_out(
    plan: ExcitationPlan,
    controllers: Sequence[RunningController],
    graph: RunningGraph,
    bag: Path,
    states: str,
    tell: Tell,
    button: Button | None = None,
) -> Ending:
    """Excite joints and record them; however it ends, the joints have come to rest before."""
    order = _order(plan, controllers)
    space = controllers[0].namespace
    return carried_out(_EXCITER, order, graph, space, bag, states, tell, button)


def _order(plan: ExcitationPlan, controllers: Sequence[RunningController]) -> dict[str, Any]:
    timings = [each.settings.timing for each in controllers]
    rates = [each.introspection_rate for each in controllers if each.introspection_rate > 0.0]
    slowest = max((_REFERENCE_PERIODS / rate for rate in rates), default=0.0)
    return {
        "plan": plan.as_mapping(),
        "takeover_time": max(each.takeover_time for each in timings),
        "reference_timeout": max(_LEAST_REFERENCE_TIMEOUT, slowest),
        "is_simulated": all(each.is_simulated for each in timings),
    }


HeldStage = Literal["preparing", "ready", "moving", "ended"]


class HeldMotion:
    """One motion, in a thread of its own; every method returns at once unless it says so.

    It begins with the first :meth:`press` after it is ``ready``, goes on while presses come at
    least as often as they must, and otherwise the joints come to rest. It is recorded either way.
    """

    def __init__(
        self,
        plan: ExcitationPlan,
        controllers: Sequence[RunningController],
        graph: RunningGraph,
        bag: Path,
        states: str = "joint_states",
        within: float = HELD_WITHIN,
    ) -> None:
        self.bag = bag
        self.stage: HeldStage = "preparing"
        self.seconds = 0.0
        self._button = Button(within)
        self._ending: Ending | None = None
        self._failure: BaseException | None = None
        self._has_ended = threading.Event()
        arguments = (plan, controllers, graph, bag, states, self._tell, self._button)
        # Its children get SIGTERM from the kernel when the thread that started them ends.
        self._thread = threading.Thread(
            target=self._run, args=arguments, name="held motion", daemon=True
        )
        self._thread.start()

    def press(self) -> None:
        """Say that the button is held."""
        self._button.press()

    def release(self) -> None:
        """Have the joints come to rest; the motion cannot be taken up again."""
        self._button.release()

    @property
    def ending(self) -> Ending | None:
        """How it ended, once its recording is closed; None before."""
        if self._failure is not None:
            raise self._failure
        return self._ending

    def wait(self, timeout: float | None = None) -> Ending | None:
        """Wait until it has ended, and its recording is closed."""
        self._has_ended.wait(timeout)
        return self.ending

    def _run(self, *arguments: object) -> None:
        try:
            self._ending = carry_out(*arguments)  # type: ignore[arg-type]
        except BaseException as error:  # raised where somebody waits for the end
            self._failure = error
        finally:
            self._button.release()
            self.stage = "ended"
            self._has_ended.set()

    def _tell(self, event: str, seconds: float) -> None:
        self.seconds = max(self.seconds, seconds)
        if event == "ready":
            self.stage = "ready"
        elif event in ("begun", "at"):
            self.stage = "moving"


_UNSURE = 0.15  # of an inertia that only the limit cycle tells


def carry_out_relay(
    planned: PlannedRelay,
    controller: RunningController,
    graph: RunningGraph,
    bag: Path,
    states: str,
    tell: Tell,
) -> Ending:
    """Have a relay drive a joint for some cycles, and record it."""
    mover = Mover(
        "hpid_relay_tester",
        "live.relay_tester",
        "the relay gives the joint back by itself",
        (f"{controller.node}/relay",),
    )
    order = {"controller": controller.node, "request": list(astuple(planned.request))}
    return carried_out(mover, order, graph, controller.namespace, bag, states, tell)


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
    """Return what a bag tells."""
    joint = controller.settings.joint
    record = _record(bag, joint)
    gains, request = controller.settings.gains, planned.request
    cycle = relay_cycle(record, request.amplitude, request.hysteresis, gains.d / gains.p)
    identified = identify([record])[0]
    inertia, delay = identified.told(INERTIA), identified.told(DELAY)
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


def _record(bag: Path, joint: str) -> JointRecord:
    """Return a joint's positions and commands."""
    recording = read_run(bag, "relay", joints=[joint], progress=lambda share: None)
    (series,) = recording.joints
    return JointRecord(
        joint,
        seconds_since(series.state_stamps_ns, recording.start_ns),
        series.position,
        seconds_since(series.command_stamps_ns, recording.start_ns),
        series.effort,
    )
