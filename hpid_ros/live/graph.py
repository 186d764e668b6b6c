"""The graph as the page sees it: controllers, their parameters, and what can be asked of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

from hpid_ros.base.errors import RunError
from hpid_ros.base.units import Numbers
from hpid_ros.control.controller_files import RobotLimits
from hpid_ros.control.settings import PARAMETERS, LoopSettings, Value
from hpid_ros.live.controllers import RunningController, RunningGraph, described_limits

SILENT_AFTER = 3.0
"""Time without a word on ``/diagnostics`` in [s]; controllers report once a second."""


class Health(NamedTuple):
    """What a controller has said of itself on ``/diagnostics``."""

    level: int  # 0 ok, 1 warning, 2 error
    message: str  # one line
    values: Mapping[str, str]  # figures by name, as texts
    heard_at: float  # [s] when, on the monotonic clock of this process


@dataclass(frozen=True)
class ControllerSummary:
    """A joint controller of this package on the graph."""

    node: str  # its full name
    values: Mapping[str, Value]  # active loop parameters by name, all of PARAMETERS
    settings: LoopSettings  # those, within the limits of its robot
    limits: RobotLimits  # what its robot allows
    introspection_rate: float  # [Hz] of its ~/reference
    requires_certificate: bool  # whether it refuses what is not certified
    lifecycle: str = ""  # label of its state, for instance active; empty while unknown
    health: Health | None = None  # what it said last; None before it said anything
    is_here: bool = True  # whether it is on the graph now

    @property
    def joint(self) -> str:
        """Name of its joint."""
        return self.settings.joint

    @property
    def namespace(self) -> str:
        """Of its node."""
        return self.node.rpartition("/")[0] or "/"

    def running(self, position: float | None, effort: float | None) -> RunningController:
        """Return it as whatever moves joints wants it."""
        return RunningController(
            self.node, self.settings, self.limits, self.introspection_rate, position, effort
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """What came of one joint since the last look; times in [s] of the control clock.

    The clock starts again (0) with the first state seen, and when its stamps go back.
    """

    # time [s], position [rad], velocity [rad/s] (nan where states have none), (N, 3)
    states: Numbers
    efforts: Numbers  # time [s], commanded effort [N m], (M, 2)
    references: Numbers  # time [s], position [rad], velocity [rad/s] of ~/reference, (K, 3)
    # whether the clock has gone back: what came before is of another time
    is_restarted: bool = False


class Answer(NamedTuple):
    """What a node has answered to a request."""

    is_taken: bool  # whether it did what was asked
    reason: str = ""  # the node's own words where it did not, or why there is no answer
    is_certain: bool = True  # whether it has said so; who did not answer may do it yet


@dataclass(frozen=True)
class Change:
    """A set of parameters that a controller took, whoever asked for it."""

    node: str  # full name of the controller
    values: Mapping[str, Value] = field(default_factory=dict)
    stamp: float = 0.0  # [s] wall time
    time: float = float("nan")  # on the control clock of its joint, as in Samples


class Graph(Protocol):
    """A running graph. Every method returns at once and may be called from any thread."""

    def controllers(self) -> Mapping[str, ControllerSummary]:
        """Return the controllers that have been seen, by the full names of their nodes, sorted."""

    def watch(self, nodes: Sequence[str]) -> None:
        """Take samples of these controllers from now on, and of no others."""

    def take(self) -> Mapping[str, Samples]:
        """Return what came since the last call, by node; of one thread at a time."""

    def changes(self) -> Sequence[Change]:
        """Return the sets that were taken since the last call."""

    def set(self, node: str, values: Mapping[str, Value]) -> Future[Answer]:
        """Have a controller take parameters, all or none."""

    def change_state(self, node: str, transition: str) -> Future[Answer]:
        """Have a controller go through a transition."""

    def running(
        self, nodes: Sequence[str], state_of: Callable[[str], tuple[float | None, float | None]]
    ) -> RunningGraph:
        """Return controllers as whatever moves joints wants them."""

    def states_topic(self, node: str) -> str:
        """Return the full name of the topic that a controller takes its states from."""


MORE_PARAMETERS = ("robot_description", "introspection_rate", "require_certificate")
"""What a joint controller has beside the parameters of its loop, as far as it is read."""

StateOf = Callable[[str], tuple[float | None, float | None]]
"""Returns position and mean effort of a node's joint, None where unknown."""


def controller_summary(node: str, parameters: Mapping[str, Any]) -> ControllerSummary:
    """Return a controller that has been found."""
    values = {name: parameters[name] for name in PARAMETERS}
    settings = LoopSettings.from_parameters(values)
    limits = _limits(str(parameters["robot_description"]), settings.joint)
    return ControllerSummary(
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


def with_changes(seen: ControllerSummary, changes: Mapping[str, Any]) -> ControllerSummary:
    """Return a controller after some of its parameters have been set."""
    values = {**seen.values, **{name: changes[name] for name in changes if name in PARAMETERS}}
    settings = seen.limits.within(LoopSettings.from_parameters(values))
    return replace(seen, values=values, settings=settings)


def as_running(
    seen: Sequence[ControllerSummary],
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
