"""The joint controllers of a running graph, and what comes of them: records without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

from hpid_ros.base.errors import RunError, SettingError
from hpid_ros.base.resources import ResourceError
from hpid_ros.base.units import Numbers
from hpid_ros.control.settings import PARAMETERS, LoopSettings, Value
from hpid_ros.robot.description import robot_limits
from hpid_ros.robot.joint_description import JointDescription

SILENT_AFTER = 3.0
"""Time without a word on ``/diagnostics`` in [s]; controllers report once a second."""

READ_PARAMETERS = (*PARAMETERS, "robot_description", "introspection_rate", "require_certificate")
"""What is read of a joint controller: those of its loop, and some of its node."""


class Health(NamedTuple):
    """What a controller has said of itself on ``/diagnostics``."""

    level: int  # 0 ok, 1 warning, 2 error
    message: str  # one line
    values: Mapping[str, str]  # figures by name, as texts
    heard_at: float  # [s] when, on the monotonic clock of this process


@dataclass(frozen=True)
class RunningController:
    """A joint controller of this package on the graph."""

    node: str  # its full name
    parameters: Mapping[str, Any]  # all of READ_PARAMETERS
    settings: LoopSettings  # active, within the limits of its robot
    limits: JointDescription  # what its robot allows
    lifecycle: str = ""  # label of its state, for instance active; empty while unknown
    health: Health | None = None  # what it said last; None before it said anything
    is_here: bool = True  # whether it is on the graph now
    position: float | None = None  # [rad] or [m] of its joint; None where nobody has asked
    effort: float | None = None  # [N m] or [N], the mean of its joint; None likewise

    @classmethod
    def of(cls, node: str, parameters: Mapping[str, Any]) -> RunningController:
        settings = LoopSettings.from_parameters(_of_loop(parameters))
        limits = _described_limits(str(parameters["robot_description"]), settings.joint)
        return cls(node, parameters, limits.within(settings), limits)

    def with_parameters(self, changes: Mapping[str, Any]) -> RunningController:
        """Return it after some of its parameters have been set."""
        parameters = {**self.parameters, **changes}
        settings = LoopSettings.from_parameters(_of_loop(parameters))
        return replace(self, parameters=parameters, settings=self.limits.within(settings))

    @property
    def joint(self) -> str:
        return self.settings.joint

    @property
    def namespace(self) -> str:
        return self.node.rpartition("/")[0] or "/"

    @cached_property
    def values(self) -> dict[str, Value]:
        """Its active loop parameters by name, all of PARAMETERS."""
        return _of_loop(self.parameters)

    @property
    def introspection_rate(self) -> float:
        """How often it tells its ``~/reference``, in [Hz]."""
        return float(self.parameters["introspection_rate"])

    @property
    def requires_certificate(self) -> bool:
        return bool(self.parameters["require_certificate"])


def _of_loop(parameters: Mapping[str, Any]) -> dict[str, Value]:
    return {name: parameters[name] for name in PARAMETERS}


@lru_cache(maxsize=64)  # a controller is read again after every doubt
def _described_limits(source: str, joint: str) -> JointDescription:
    """Return the limits of a joint in the description that its controller has."""
    try:
        return robot_limits(source, joint)
    except ResourceError as error:
        raise RunError(
            f"robot_description of the controller of {joint} is a file that is not here: {error}"
        ) from None


class RunningGraph(NamedTuple):
    """Controllers as whatever moves joints wants them."""

    controllers: Mapping[str, RunningController]  # by joint, with positions and efforts
    has_commands: bool  # whether they publish efforts on joint_commands
    states: str = "joint_states"  # name of the topic that their states come from

    @classmethod
    def of(
        cls, controllers: Iterable[RunningController], states: str, *, has_commands: bool
    ) -> RunningGraph:
        """Order controllers by their joints, of which each must have one."""
        found: dict[str, RunningController] = {}
        for each in controllers:
            if each.joint in found:
                both = f"{found[each.joint].node} and {each.node}"
                raise SettingError(
                    f"{each.joint} has two controllers, {both}: choose those of one namespace "
                    f"only (--namespace)"
                )
            found[each.joint] = each
        return cls(found, has_commands, states)

    @property
    def document(self) -> dict[str, Any]:
        """Their parameters, as a parameter file has them."""
        return {
            each.node: {"ros__parameters": dict(each.parameters)}
            for each in self.controllers.values()
        }


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


class Change(NamedTuple):
    """A set of parameters that a controller took, whoever asked for it."""

    node: str  # full name of the controller
    values: Mapping[str, Value]
    time: float  # on the control clock of its joint, as in Samples
