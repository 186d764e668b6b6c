"""A recording under PIDs, with the controllers that ran, as it is taken for an upgrade."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from hpid_bench.tuning.identification.robot_identification import (
    BaseTravel,
    is_wheel,
    remark_on_base,
    why_not_wheel,
)
from hpid_bench.tuning.loop_statistics import median_period
from hpid_bench.tuning.recorded_loops import recorded_controllers
from hpid_ros.base.errors import SettingError
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.messages import measures_velocity, read_retunes
from hpid_ros.messages.quality import NO_EFFORT
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.robot.description import GivenRobot

RECORDED_RUN = "recorded"
"""Label of the run."""


@dataclass(frozen=True)
class PidRecording:
    """What was recorded, and the controllers that ran."""

    run: RunSeries  # of all joints that were recorded
    loops: Sequence[LoopSettings]  # the controllers that can be upgraded, as they ran
    warnings: Sequence[str]  # what the numbers must be read with, one line each
    has_velocities: bool  # whether the robot measures them

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """The joints of the controllers that can be upgraded."""
        return tuple(each.joint for each in self.loops)

    @cached_property
    def series(self) -> Mapping[str, JointSeries]:
        """What was recorded of each joint, by its name."""
        return {each.joint: each for each in self.run.joints}

    @cached_property
    def controlled(self) -> RunSeries:
        """The run of the joints that can be upgraded."""
        return self.run.narrowed(list(self.joints))

    @cached_property
    def period(self) -> float:
        """Median time between two states, in [s]."""
        return median_period(self.run.joints[0])


def read_pid_recording(
    bag: Path, robot: GivenRobot, parameters: Path | None, base: BaseTravel | None
) -> PidRecording:
    """Read a recording; refuse one that is not of PIDs, or that lacks what an upgrade needs.

    ``parameters`` is a file of the controllers' parameters, where the bag has none.
    """
    controllers = recorded_controllers(bag, parameters)
    run = read_run(
        bag,
        RECORDED_RUN,
        selection=BagSelection(  # of runs that are no one motion
            separates_runs=True, every=True, kinds=robot.description.kinds
        ),
        progress=lambda share: raise_if_interrupted(),
    ).with_slides(robot.description.slides)
    loops: list[LoopSettings] = []
    left_out: dict[str, list[str]] = {}  # joints by the reason
    driven = {each.joint for each in run.joints if each.has_effort or each.has_reference}
    for joint, controller in controllers.items():
        if joint not in run.joint_names or joint not in robot.description.joints:
            who = "the recording" if joint not in run.joint_names else "the robot"
            left_out.setdefault(f"{who} does not have it", []).append(joint)
        elif is_wheel(joint, robot, base) and (reason := why_not_wheel(base, is_asked_for=True)):
            left_out.setdefault(reason, []).append(joint)
        elif joint not in driven:
            left_out.setdefault("the recording has no effort or reference of it", []).append(joint)
        else:
            loops.append(controller.settings)
    warnings = [f"left out: {', '.join(each)}: {reason}" for reason, each in left_out.items()]
    if not loops:
        raise SettingError(f"{bag}: no controller can be upgraded: {'; '.join(warnings)}")
    _require_pids(bag, loops)
    _require_complete(bag, run, loops)
    retunes = read_retunes(bag)
    if retunes:
        first = retunes[0]
        warnings.append(
            f"parameters were changed while it was recorded, first {first.node}: {first.change}; "
            "the controllers are taken as they began"
        )
    if base is not None and base.is_moving:
        warnings.append(remark_on_base(base))
    warnings.extend(run.quality.missing_lines)
    return PidRecording(run, loops, warnings, measures_velocity(bag, loops[0].joint))


def _require_pids(bag: Path, loops: Sequence[LoopSettings]) -> None:
    others = [f"{each.joint} (mu {each.mu:+g})" for each in loops if each.degree != 0.0]
    if others:
        raise SettingError(
            f"{bag} was not recorded under a PID, but under the homogeneous law: "
            f"{', '.join(others)}; record one with law pid or mu 0, which is the baseline"
        )


def _require_complete(bag: Path, run: RunSeries, loops: Sequence[LoopSettings]) -> None:
    """Refuse a recording without the reference or the effort of a controlled joint."""
    without = {each.joint for each in run.joints if not each.has_reference}
    missing = [each.joint for each in loops if each.joint in without]
    if missing:
        raise SettingError(
            f"{bag} has no reference of {', '.join(missing)}: record joint_trajectory, "
            "as bag_recorder does"
        )
    without = {each.joint for each in run.joints if not each.has_effort}
    missing = [each.joint for each in loops if each.joint in without]
    if missing:
        why = run.quality.joints[missing[0]].no_effort or NO_EFFORT
        raise SettingError(
            f"{bag} has no efforts of {', '.join(missing)} ({why}): record joint_commands, or "
            "efforts that are measured"
        )
