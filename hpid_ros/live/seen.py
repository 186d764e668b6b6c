"""Controllers as the page knows them, made of the parameters that their nodes have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from hpid_ros.base.errors import RunError
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.control.settings.table import PARAMETERS
from hpid_ros.experiment.live.graph import RunningController, RunningGraph, described_limits
from hpid_ros.live.graph import SeenController

__all__ = [
    "MORE_PARAMETERS",
    "RunningGraph",
    "StateOf",
    "as_running",
    "seen_controller",
    "with_changes",
]

MORE_PARAMETERS = ("robot_description", "introspection_rate", "require_certificate")
"""What a joint controller has beside the parameters of its loop, as far as it is read."""

StateOf = Callable[[str], tuple[float | None, float | None]]
"""Returns position and mean effort of a node's joint, None where unknown."""


def seen_controller(node: str, parameters: Mapping[str, Any]) -> SeenController:
    """Return a controller that has been found."""
    values = {name: parameters[name] for name in PARAMETERS}
    settings = LoopSettings.from_parameters(values)
    limits = _limits(str(parameters["robot_description"]), settings.joint)
    return SeenController(
        node,
        values,
        limits.within(settings),
        limits,
        float(parameters["introspection_rate"]),
        bool(parameters["require_certificate"]),
    )


@lru_cache(maxsize=64)  # a controller is read again after every set
def _limits(source: str, joint: str) -> RobotLimits:
    return described_limits(source, joint)


def with_changes(seen: SeenController, changes: Mapping[str, Any]) -> SeenController:
    """Return a controller after some of its parameters have been set."""
    values = {**seen.values, **{name: changes[name] for name in changes if name in PARAMETERS}}
    settings = seen.limits.within(LoopSettings.from_parameters(values))
    return replace(seen, values=values, settings=settings)


def as_running(
    seen: Sequence[SeenController],
    parameters: Mapping[str, Mapping[str, Any]],
    state_of: StateOf,
    *,
    has_commands: bool,
) -> RunningGraph:
    """Return controllers as whatever moves joints wants them."""
    found: dict[str, RunningController] = {}
    for each in seen:
        if each.joint in found:
            both = f"{found[each.joint].node} and {each.node}"
            raise RunError(f"{each.joint} has two controllers, {both}: which is meant?")
        found[each.joint] = each.running(*state_of(each.node))
    document = {each.node: {"ros__parameters": dict(parameters[each.node])} for each in seen}
    return RunningGraph(found, document, has_commands)
