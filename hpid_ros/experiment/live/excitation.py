"""An excitation on a running graph: planned from what runs, carried out, recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import RunError, SettingError, unknown_name
from hpid_ros.excitation.bounds import JointBounds, inertia_from_gains
from hpid_ros.excitation.plan import ExcitationPlan
from hpid_ros.experiment.live.button import Button
from hpid_ros.experiment.live.graph import RunningController, RunningGraph
from hpid_ros.experiment.live.watching import Ending, Mover, Tell, carried_out

_EXCITER = Mover(
    "hpid_exciter",
    "parts.live.exciter",
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
