"""What ends an excitation: the button released, or a joint beyond its bounds.

A goal of :class:`~hpid_ros.nodes.parts.goal_follower.GoalFollower` carries the excitation out:
it knows the path tolerance, silences, other senders, and how joints are stopped. The rest is here.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.motion.excitation import ExcitationPlan, PlannedJoint
from hpid_ros.motion.joint_trajectory import PointArrays
from hpid_ros.nodes.core.process import read_only
from hpid_ros.nodes.parts.goals import GoalRequest, GroupSettings, JointFacts


def read_order(node: Node) -> dict[str, Any]:
    """Return what the file says that the parameter ``plan_file`` names."""
    file = str(read_only(node, "plan_file", "", "JSON file that hpid has written"))
    try:
        return dict(json.loads(Path(file).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise SettingError(f"plan_file {file!r} cannot be read: {error}") from None


_AT_ONCE = 65536


class DeadMan:
    """Whether the button is held. The end of input says that the writer is gone."""

    def __init__(self, within: float) -> None:
        self._within = within
        self.is_gone = False
        self._input = sys.stdin.fileno()
        self._last = -float("inf")

    def is_held(self) -> bool:
        """Return whether it is held; to be asked more often than a byte must come."""
        now = time.monotonic()
        if self._has_come():
            self._last = now
        return not self.is_gone and now - self._last < self._within

    def forget(self) -> None:
        """Take it for not held until a byte comes."""
        self._has_come()
        self._last = -float("inf")

    def _has_come(self) -> bool:
        has_come = False
        while not self.is_gone and select.select([self._input], [], [], 0.0)[0]:
            try:
                count = len(os.read(self._input, _AT_ONCE))
            except OSError:  # nobody gave it any input
                count = 0
            has_come |= count > 0
            self.is_gone = count == 0
        return has_come


_EFFORT_SHARE = 0.95  # of an effort limit: there the controller does what it can, and no more
_EFFORT_PATIENCE = NANOSECONDS // 20
_BEYOND = 1e-3  # [rad] that noise may take a joint beyond a limit
_STATES_WITHIN = 0.5  # [s]


class Watch:
    """Looks at states and efforts of the joints of a plan."""

    def __init__(self, plan: ExcitationPlan) -> None:
        self._joints = plan.joints
        self._loaded_since_ns: list[int | None] = [None] * len(plan.joints)

    def see(
        self,
        stamp_ns: int,
        motions: Sequence[tuple[float, float]],
        efforts: Sequence[float | None],
    ) -> str:
        """Return which limit is reached; empty if none is."""
        for number, planned in enumerate(self._joints):
            line = _motion_beyond(planned, *motions[number])
            line = line or self._effort_beyond(number, stamp_ns, efforts[number])
            if line:
                return f"{planned.bounds.joint} {line}"
        return ""

    def _effort_beyond(self, number: int, stamp_ns: int, effort: float | None) -> str:
        least, largest = self._joints[number].bounds.efforts
        is_within = effort is None or _EFFORT_SHARE * least < effort < _EFFORT_SHARE * largest
        since_ns = self._loaded_since_ns[number]
        if is_within or since_ns is None:
            self._loaded_since_ns[number] = None if is_within else stamp_ns
            return ""
        if stamp_ns - since_ns < _EFFORT_PATIENCE:
            return ""
        unit = "N" if self._joints[number].bounds.is_slide else "N m"
        return f"needs {effort:.4g} {unit}, its limits are {least:.4g} and {largest:.4g} {unit}"


def _motion_beyond(planned: PlannedJoint, position: float, velocity: float) -> str:
    bounds = planned.bounds
    if not bounds.lower - _BEYOND <= position <= bounds.upper + _BEYOND:
        return (
            f"is at {position:.4g} {bounds.unit}, its limits are {bounds.lower:.4g} and "
            f"{bounds.upper:.4g} {bounds.unit}"
        )
    if abs(velocity) > planned.velocity_stop:
        return (
            f"moves at {abs(velocity):.4g} {bounds.unit}/s, it is stopped above "
            f"{planned.velocity_stop:.4g} {bounds.unit}/s"
        )
    return ""


def group_settings(
    plan: ExcitationPlan, takeover_time: float, reference_timeout: float, *, is_simulated: bool
) -> GroupSettings:
    """Return what the goal of a plan is followed under."""
    facts = {
        each.bounds.joint: JointFacts(
            each.bounds.lower, each.bounds.upper, each.bounds.is_endless, unit=each.bounds.unit
        )
        for each in plan.joints
    }
    values: dict[str, float | str] = {
        "state_timeout": _STATES_WITHIN,
        "reference_timeout": reference_timeout,
        "takeover_time": takeover_time,
        "state_clock": "simulated" if is_simulated else "wall",
    }
    for each in plan.joints:
        name = f"constraints.{each.bounds.joint}"
        values[f"{name}.trajectory"] = each.tolerance
        values[f"{name}.max_deceleration_on_cancel"] = each.peaks.acceleration
    return GroupSettings.from_parameters(plan.names, facts, values)


def goal_of(plan: ExcitationPlan, standing: Sequence[float]) -> GoalRequest:
    """Return the goal that carries a plan out, from where the joints' references stand."""
    times_ns = np.rint(plan.times * NANOSECONDS).astype(np.int64)
    none = np.full_like(plan.positions, np.nan)
    arrays = PointArrays(plan.positions + standing, plan.velocities, plan.accelerations, none)
    return GoalRequest(plan.names, 0, times_ns, arrays)
