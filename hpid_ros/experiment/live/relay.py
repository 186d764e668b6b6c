"""A relay test of a running joint: asked for, recorded, and what its bag tells."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import NamedTuple

from hpid_ros.bags import read_run
from hpid_ros.base.errors import SettingError
from hpid_ros.excitation.relays import PlannedRelay
from hpid_ros.experiment.live.graph import RunningController, RunningGraph
from hpid_ros.experiment.live.watching import Ending, Mover, Tell, carried_out
from hpid_ros.identification.identify import identify
from hpid_ros.identification.records import JointRecord
from hpid_ros.identification.relay import RelayCycle, relay_cycle
from hpid_ros.identification.results import DELAY, INERTIA, JointIdentification
from hpid_ros.recordings.series import seconds_since

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
        "parts.live.relay_tester",
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
