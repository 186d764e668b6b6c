"""What a group of joints is told about goals: its joints, tolerances, limits and timeouts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple, get_args

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.control.settings.choices import StateClock
from hpid_ros.control.settings.table import ParameterSpec, Value
from hpid_ros.goals.tolerances import Tolerance, Tolerances

_MOST = math.inf  # no range, so no slider whose steps are too coarse


def _positive(name: str, default: float, least: float, most: float, text: str) -> ParameterSpec:
    return ParameterSpec(name, default, text, least, most)


GOAL_PARAMETERS = (
    ParameterSpec("allow_partial_joints_goal", False, "Take goals that name some joints only"),
    ParameterSpec(
        "allow_nonzero_velocity_at_trajectory_end",
        False,
        "Take goals whose last point has a velocity; the reference rests there all the same",
    ),
    _positive(
        "constraints.goal_time",
        0.0,
        0.0,
        _MOST,
        "How much later than its last point a goal's tolerances must be met [s]; 0 waits for ever",
    ),
    _positive(
        "constraints.stopped_velocity_tolerance",
        0.01,
        0.0,
        _MOST,
        "Velocity at which a joint counts as stopped at the end of a goal [rad/s]; 0 is any",
    ),
    _positive(
        "constraints.stop_duration",
        0.5,
        0.01,
        100.0,
        "How long a joint without max_deceleration_on_cancel takes to stop [s]",
    ),
)
"""What may change while the node runs; it holds for the next goal."""

FIXED_PARAMETERS = (
    _positive(
        "action_monitor_rate", 20.0, 0.1, 1000.0, "Rate of the feedback [Hz], of the wall clock"
    ),
    _positive(
        "state_timeout",
        0.5,
        0.01,
        10.0,
        "A goal is aborted, and none is taken, when a joint has had no state for so long [s]",
    ),
    ParameterSpec(
        "state_clock",
        "wall",
        "What stamps the states: wall, or simulated, which can be paused without an abort",
        choices=get_args(StateClock),
    ),
    _positive(
        "takeover_time", 0.5, 0.0, 100.0, "That of the controllers [s], which they glide for"
    ),
    _positive(
        "reference_timeout",
        0.5,
        0.0,
        100.0,
        "A goal is aborted when a controller that has told its ~/reference tells none for so "
        "long [s], by the stamps; 0 does not look",
    ),
)
"""What is fixed when the node starts."""


def joint_parameters(joint: str) -> tuple[ParameterSpec, ...]:
    """Return the parameters of one joint of a group; they may change as GOAL_PARAMETERS may."""
    return (
        _positive(
            f"constraints.{joint}.trajectory",
            0.0,
            0.0,
            _MOST,
            "How far the joint may be from its reference during a goal [rad]; 0 is any",
        ),
        _positive(
            f"constraints.{joint}.goal",
            0.0,
            0.0,
            _MOST,
            "How far it may be from its reference at the end of a goal [rad]; 0 is any",
        ),
        _positive(
            f"constraints.{joint}.max_deceleration_on_cancel",
            0.0,
            0.0,
            _MOST,
            "Deceleration with which it stops when a goal is cancelled or aborted [rad/s^2]; 0 "
            "stops it within constraints.stop_duration",
        ),
    )


class JointFacts(NamedTuple):
    """What is known of a joint; "rad" reads "m" where it is prismatic."""

    lower: float = -math.inf  # [rad] lowest position; -inf for none
    upper: float = math.inf  # [rad] highest position; inf for none
    is_endless: bool = False  # whether it turns without end, so that whole turns are no error
    # whether goals lead it the shorter way round to their first point
    takes_shorter_way: bool = False
    unit: str = "rad"  # of its position, rad or m


def require_joints(
    joints: Sequence[str], wrapping: Sequence[str] = (), counting: Sequence[str] = ()
) -> None:
    """Refuse names that make no group."""
    if not joints or len(set(joints)) != len(joints) or "" in joints:
        raise SettingError(f"the parameter joints must name each joint once, not {list(joints)}")
    for parameter, named in (("angle_wraparound", wrapping), ("multi_turn", counting)):
        for joint in named:
            if joint not in joints:
                line = unknown_name("joint", joint, joints)
                raise SettingError(f"the parameter {parameter}: {line}")
    for joint in wrapping:
        if joint in counting:
            raise SettingError(f"{joint} is in angle_wraparound and in multi_turn: take one")


@dataclass(frozen=True)
class GroupSettings:
    """Settings of a group of joints; "rad" reads "m" where a joint is prismatic."""

    joints: tuple[str, ...]  # their names, each once
    facts: tuple[JointFacts, ...]  # what is known of each, in the same order
    tolerances: Tolerances  # of goals that ask for no others
    decelerations: tuple[float, ...]  # [rad/s^2] with which each stops; 0 for none of its own
    stop_duration: float  # [s] how long a joint without one takes to stop
    allows_partial_goals: bool  # whether goals may name some joints only
    allows_final_velocity: bool  # whether the last point may have a velocity
    state_timeout: float  # [s] how old a joint's state may be
    is_simulated: bool  # whether states may stay away because the simulation was paused
    takeover_time: float  # [s] how long controllers glide
    reference_timeout: float  # [s] how old a controller's reference may be; 0 for any

    @classmethod
    def from_parameters(
        cls, joints: Sequence[str], facts: Mapping[str, JointFacts], values: Mapping[str, Value]
    ) -> GroupSettings:
        """Return the settings that parameters say."""
        require_joints(joints)
        specs = (*GOAL_PARAMETERS, *FIXED_PARAMETERS, *chain(*map(joint_parameters, joints)))
        checked = {spec.name: spec.checked(values.get(spec.name, spec.default)) for spec in specs}

        def of(name: str) -> float:
            return float(checked[name])

        stopped = of("constraints.stopped_velocity_tolerance")
        tolerances = Tolerances(
            {each: Tolerance(of(f"constraints.{each}.trajectory")) for each in joints},
            {each: Tolerance(of(f"constraints.{each}.goal"), stopped) for each in joints},
            of("constraints.goal_time"),
        )
        stopping = "max_deceleration_on_cancel"
        return cls(
            tuple(joints),
            tuple(facts.get(joint, JointFacts()) for joint in joints),
            tolerances,
            tuple(of(f"constraints.{joint}.{stopping}") for joint in joints),
            of("constraints.stop_duration"),
            bool(checked["allow_partial_joints_goal"]),
            bool(checked["allow_nonzero_velocity_at_trajectory_end"]),
            of("state_timeout"),
            checked["state_clock"] == "simulated",
            of("takeover_time"),
            of("reference_timeout"),
        )
