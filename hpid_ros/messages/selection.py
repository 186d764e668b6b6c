"""What is to be read of a bag: joints, topics, reference, clock, window."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.messages.quality import HOLD
from hpid_ros.motion.joint_trajectory import JointTrajectory

CLOCKS = ("header", "receive")
"""Where the time of states and stamped commands comes from.

``header`` is the stamp in the message, ``receive`` the time at which the recorder got it.
"""

REFERENCES = ("auto", "trajectory", "setpoint", "sampled", "controller_state", HOLD)
"""Kinds of reference: found in this order; see :class:`BagSelection`."""

NO_COMMANDS = "none"
"""As ``commands``: read no efforts."""

EFFORT_COMMANDS = "effort"
"""As ``commands``: what controllers publish on ``~/command`` or ``~/commands`` are efforts."""

ReferenceChoice = str | JointTrajectory
"""A name of :data:`REFERENCES`, a topic, or the reference itself."""

_MAPPING = re.compile(r"(?P<joint>[^=]+)=(?P<topic>[^=\[\]]+)(\[(?P<element>\d+)\])?")


class CommandTopic(NamedTuple):
    """Where one joint's efforts are."""

    topic: str  # full name of the topic
    element: int = 0  # place in the data of a Float64MultiArray


@dataclass(frozen=True)
class BagSelection:
    """What is read from a bag, and on which clock. What is left out is found by name, then type.

    Topic names are full with a leading slash; without one their last parts are enough.

    Attributes:
        joints: Only these joints, in this order: names, shell patterns (``arm_*``), or names and
            patterns after ``!`` or ``^``, which leave joints out. All that are commanded or have
            a reference if None.
        namespace: Only topics below this namespace, for instance ``"/left"``: which of several
            robots.
        states: Topics of the states (``sensor_msgs/JointState``), each joint on one of them; a
            single name is one topic.
        commands: Topic of the efforts: ``sensor_msgs/JointState`` or
            ``control_msgs/JointTrajectoryControllerState`` (its output). The topic of the states
            gives their measured efforts, which are taken, too, where nothing else carries any.
            ``"effort"`` takes the numbers of ``*_controller/commands`` for efforts, which
            neither their names nor their types tell. ``"none"`` reads no efforts.
        command_topics: Topics with the efforts of single joints (``std_msgs/Float64``,
            ``std_msgs/Float64MultiArray``), by joint.
        reference: A name of :data:`REFERENCES`, or a topic: ``trajectory`` is
            ``trajectory_msgs/JointTrajectory``, ``setpoint`` a controller's
            ``std_msgs/Float64``, ``sampled`` its ``~/reference``, ``controller_state`` the
            reference of a ``JointTrajectoryControllerState``, ``hold`` the first position of
            each joint. ``auto`` takes the first of these, but for ``hold``, that the joint has.
            A trajectory is one that was followed from the first state on.
        clock: One of :data:`CLOCKS`. Commands without a stamp have their receive time in either.
        start: Begin of the window, seconds since the first state of any joint, in [s].
        end: End of the window (inclusive), likewise.
        separates_runs: Whether stamps that go back by a second or more begin another run, which
            then follows the one before after a gap; else all are put in the order of their stamps.
        sender: Which sender of joint states is taken where several send the same joints: its
            number in the warning, its rate (``50Hz``) or its layout; the one that goes on if None.
        kinds: Types of joints as a URDF has them, by name, for their turns: positions of
            ``continuous`` joints are unwrapped and their errors taken to the nearest turn, as are
            those of others, with a line, where the positions jump by a turn.
        velocities: Whether the velocities that the states measured are read, too.
        every: Whether the other joints that the states name follow, as far as they can be read.

    Raises:
        SettingError: An unknown clock, an empty or reversed window, an empty name.
    """

    joints: Sequence[str] | None = None
    namespace: str | None = None
    states: str | Sequence[str] | None = None
    commands: str | None = None
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    reference: ReferenceChoice = "auto"
    clock: str = "header"
    start: float | None = None
    end: float | None = None
    separates_runs: bool = False
    velocities: bool = False
    every: bool = False
    sender: str | None = None
    kinds: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.joints is not None:
            object.__setattr__(self, "joints", tuple(self.joints))
            if not self.joints or len(set(self.joints)) < len(self.joints):
                raise SettingError(f"joints must name each joint once, got {list(self.joints)}")
        object.__setattr__(self, "command_topics", dict(self.command_topics))
        if isinstance(self.states, str):
            object.__setattr__(self, "states", (self.states,))
        elif self.states is not None:
            object.__setattr__(self, "states", tuple(self.states))
        for name in ("namespace", "states", "commands", "reference", "sender"):
            value = getattr(self, name)
            if value == "" or (name == "states" and value is not None and not all(value or [""])):
                raise SettingError(f"{name} must not be an empty text")
        if self.clock not in CLOCKS:
            raise SettingError(unknown_name("clock", self.clock, CLOCKS))
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise SettingError(f"{name} must be zero or more seconds, got {value}")
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise SettingError(f"start must be before end, got {self.start} s and {self.end} s")


def parse_command_topics(texts: Sequence[str]) -> dict[str, CommandTopic]:
    """Return the mapping that options like ``elbow=/elbow_controller/commands[0]`` give."""
    topics: dict[str, CommandTopic] = {}
    for text in texts:
        match = _MAPPING.fullmatch(text)
        if match is None:
            raise SettingError(f"must be JOINT=TOPIC or JOINT=TOPIC[ELEMENT], got {text!r}")
        joint = match["joint"]
        if joint in topics:
            raise SettingError(f"joint {joint!r} has two command topics, the second in {text!r}")
        topics[joint] = CommandTopic(match["topic"], int(match["element"] or 0))
    return topics
