"""Proposals for the controllers of a robot, joint by joint, or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.recordings.series import JointSeries
from hpid_ros.robot.description import RobotDescription
from hpid_ros.stability.gain_check import inertia_of
from hpid_ros.tuning.upgrade import Candidate, Upgrade, loop_statistics, upgrades

Certifying = Callable[[int], AbstractContextManager[Callable[[Sequence[str]], None]]]
"""Shows how many of a number of joints are certified."""


class Proposals(NamedTuple):
    """What came of controllers."""

    found: dict[str, Upgrade]  # what is proposed, by joint
    failures: dict[str, HpidError]  # why there is nothing for the other joints


def propose(
    loops: Sequence[LoopSettings],
    inertias: Mapping[str, tuple[float, float]],
    recorded: Sequence[JointSeries],
    limits: Mapping[str, float],
    goal: str,
    certifying: Certifying,
) -> Proposals:
    """Propose a homogeneous PID for each controller."""
    series = {each.joint: each for each in recorded}
    candidates: list[Candidate] = []
    proposals = Proposals({}, {})
    for loop in loops:
        own, statistics = series.get(loop.joint), None
        try:
            inertia = inertia_of(loop, inertias.get(loop.joint))
            if own is not None:
                statistics = loop_statistics(own, loop.velocity.filter_time_constant)
        except HpidError as error:
            proposals.failures[loop.joint] = error
        else:
            limit = limits.get(loop.joint, math.inf)
            candidates.append(Candidate(loop, inertia, statistics, limit))
    with certifying(len(candidates)) as tell:
        found = upgrades(candidates, goal, tell)
    for candidate, each in zip(candidates, found, strict=True):
        if isinstance(each, HpidError):
            proposals.failures[candidate.pid.joint] = each
        else:
            proposals.found[candidate.pid.joint] = each
    if not proposals.found:
        reasons = dict.fromkeys(str(each) for each in proposals.failures.values())
        raise SettingError(f"no joint can be upgraded: {'; '.join(reasons)}")
    return proposals


def effort_limits(description: RobotDescription) -> dict[str, float]:
    """Return the limits of a robot's motors, by joint, in [N m]; 0 where it says none."""
    return {name: joint.effort for name, joint in description.joints.items()}
