"""The joint controllers that run, their limits, and where their joints are.

The graph is asked in a process of its own: whoever asks need not have ROS.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.robot.description import RobotDescription
from hpid_ros.tuning.controller_files import settings_from_parameters

_READER = "hpid_ros.nodes.parts.live.graph_reader"


@dataclass(frozen=True)
class RunningController:
    """A joint controller that runs."""

    node: str  # its full name
    settings: LoopSettings  # in force, within the limits of its robot
    limits: RobotLimits  # those of its robot, which are in the settings already
    introspection_rate: float  # [Hz] of its ~/reference
    position: float | None  # [rad] where its joint is or [m]; None if nobody says so
    effort: float | None  # [N m] its mean effort or [N]; None likewise

    @property
    def namespace(self) -> str:
        """Of the node."""
        return self.node.rpartition("/")[0] or "/"


@dataclass(frozen=True)
class RunningGraph:
    """What runs."""

    controllers: Mapping[str, RunningController]  # by joint, in the order of the nodes' names
    document: Mapping[str, Any]  # their parameters, as a parameter file has them
    has_commands: bool  # whether they told efforts on joint_commands


def running_loops() -> dict[str, LoopSettings]:
    """Return the settings of all running controllers by the names of their nodes."""
    return settings_from_parameters(_read()["controllers"], "the running graph")


def running_graph(states: str = "joint_states", namespace: str | None = None) -> RunningGraph:
    """Return what runs, and where the joints are."""
    below = f"/{namespace.strip('/')}" if namespace else ""
    read = _read(states, below)
    document = read["controllers"]
    found: dict[str, RunningController] = {}
    settings_from_parameters(document, f"the running graph {below}".rstrip())
    for node, section in document.items():
        values = section["ros__parameters"]
        (settings,) = settings_from_parameters({node: section}, "the running graph").values()
        if settings.joint in found:
            both = f"{found[settings.joint].node} and {node}"
            raise SettingError(
                f"{settings.joint} has two controllers, {both}: choose one's with --namespace"
            )
        limits = described_limits(str(values.get("robot_description") or ""), settings.joint)
        state = read["joints"].get(settings.joint, {})
        found[settings.joint] = RunningController(
            node,
            limits.within(settings),
            limits,
            float(values.get("introspection_rate") or 0.0),
            _finite(state.get("position")),
            _finite(state.get("effort")),
        )
    return RunningGraph(found, document, bool(read["has_commands"]))


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def described_limits(source: str, joint: str) -> RobotLimits:
    """Return the limits of a joint in the description that its controller has."""
    if not source:
        return RobotLimits()
    if not source.lstrip().startswith("<"):
        try:
            source = str(find_resource(source))
        except HpidError as error:
            raise RunError(
                f"robot_description of the controller of {joint} is a file that is not here: "
                f"{error}"
            ) from None
    (found,) = RobotDescription.load(source).select([joint])
    return RobotLimits.of(found)


def _read(*arguments: str) -> dict[str, Any]:
    reader = subprocess.run(
        [sys.executable, "-m", _READER, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if reader.returncode:
        lines = reader.stderr.strip().splitlines()
        raise RunError(f"cannot read the running graph: {lines[-1] if lines else 'no answer'}")
    return dict(json.loads(reader.stdout))
