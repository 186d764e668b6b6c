"""What the live page asks of a running graph, and what it is told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from hpid_ros.base.arrays import Numbers
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.control.settings.table import Value
from hpid_ros.experiment.live.graph import RunningController, RunningGraph

SILENT_AFTER = 3.0
"""Time without a word on ``/diagnostics`` in [s]; controllers report once a second."""


class Health(NamedTuple):
    """What a controller has said of itself on ``/diagnostics``.

    Attributes:
        level: 0 ok, 1 warning, 2 error.
        message: One line.
        values: Figures by name, as texts.
        heard_at: When, on the monotonic clock of this process, in [s].
    """

    level: int
    message: str
    values: Mapping[str, str]
    heard_at: float


@dataclass(frozen=True)
class SeenController:
    """A joint controller of this package on the graph.

    Attributes:
        node: Its full name.
        values: Loop parameters in force by name, every one of ``PARAMETERS``.
        settings: Those, within the limits of its robot.
        limits: What its robot allows.
        introspection_rate: Of its ``~/reference`` in [Hz].
        requires_certificate: Whether it refuses what is not certified.
        lifecycle: Label of its state, for instance ``active``; empty while unknown.
        health: What it said last; None before it said anything.
        is_here: Whether it is on the graph now; one that has gone keeps its place on the page.
    """

    node: str
    values: Mapping[str, Value]
    settings: LoopSettings
    limits: RobotLimits
    introspection_rate: float
    requires_certificate: bool
    lifecycle: str = ""
    health: Health | None = None
    is_here: bool = True

    @property
    def joint(self) -> str:
        """Name of its joint."""
        return self.settings.joint

    @property
    def namespace(self) -> str:
        """Of its node."""
        return self.node.rpartition("/")[0] or "/"

    def running(self, position: float | None, effort: float | None) -> RunningController:
        """Return it as whatever moves joints wants it.

        Args:
            position: Where the joint is in [rad] or [m]; None if nobody says so.
            effort: Its mean effort in [N m] or [N]; None likewise.
        """
        return RunningController(
            self.node, self.settings, self.limits, self.introspection_rate, position, effort
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """What came of one joint since the last look; times in [s] of the control clock.

    The clock begins anew (0) with the first state that is seen, and again when its stamps go back.

    Attributes:
        states: Time, position [rad], velocity [rad/s] (nan where states have none), shape (N, 3).
        efforts: Time, effort that was commanded [N m], shape (M, 2). Where commands are not told
            on a topic that is read, the efforts of the states.
        references: Time, position, velocity, of ``~/reference``, shape (K, 3).
        is_restarted: Whether the clock has gone back: what came before is of another time.
    """

    states: Numbers
    efforts: Numbers
    references: Numbers
    is_restarted: bool = False


class Answer(NamedTuple):
    """What a node has answered to a request.

    Attributes:
        is_taken: Whether it did what was asked.
        reason: The node's own words where it did not, or why there is no answer.
        is_certain: Whether it has said so; who did not answer may do it yet.
    """

    is_taken: bool
    reason: str = ""
    is_certain: bool = True


@dataclass(frozen=True)
class Change:
    """A set of parameters that a controller took, whoever asked for it.

    Attributes:
        node: Full name of the controller.
        values: What is new, by name.
        stamp: Wall time in [s].
        time: On the control clock of its joint, as in :class:`Samples`; nan where unknown.
    """

    node: str
    values: Mapping[str, Value] = field(default_factory=dict)
    stamp: float = 0.0
    time: float = float("nan")


class Graph(Protocol):
    """A running graph. Every method returns at once and may be called from any thread."""

    def controllers(self) -> Mapping[str, SeenController]:
        """Return the controllers that have been seen, by the full names of their nodes, sorted."""

    def watch(self, nodes: Sequence[str]) -> None:
        """Take samples of these controllers from now on, and of no others.

        Args:
            nodes: Full names; none while nobody looks.
        """

    def take(self) -> Mapping[str, Samples]:
        """Return what came since the last call, by node; of one thread at a time."""

    def changes(self) -> Sequence[Change]:
        """Return the sets that were taken since the last call."""

    def set(self, node: str, values: Mapping[str, Value]) -> Future[Answer]:
        """Have a controller take parameters, all or none.

        Args:
            node: Its full name.
            values: By name.
        """

    def change_state(self, node: str, transition: str) -> Future[Answer]:
        """Have a controller go through a transition.

        Args:
            node: Its full name.
            transition: ``configure``, ``activate`` or ``deactivate``.
        """

    def running(
        self, nodes: Sequence[str], state_of: Callable[[str], tuple[float | None, float | None]]
    ) -> RunningGraph:
        """Return controllers as whatever moves joints wants them.

        Args:
            nodes: Full names.
            state_of: Returns position and mean effort of a node's joint, None where unknown.
        """

    def states_topic(self, node: str) -> str:
        """Return the full name of the topic that a controller takes its states from."""
