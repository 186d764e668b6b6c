"""What was recorded of one joint and of its controller, in the order of the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import Motion

Answer = Callable[[JointLoop], float]
"""Steps a loop with a state, and returns its effort in [N m]."""


class RecordedState(NamedTuple):
    """A state that a controller may have heard.

    Attributes:
        log_time_ns: When it was recorded, in [ns].
        place: Its place in the log.
        stamp_ns: Its stamp in [ns].
        answer: Answers it.
    """

    log_time_ns: int
    place: int
    stamp_ns: int
    answer: Answer


class RecordedCommand(NamedTuple):
    """A command for the joint.

    Attributes:
        place: Its place in the log.
        stamp_ns: Stamp of the state that it answers, in [ns].
        effort: In [N m].
        sender: Who sent it, as it says; empty where it does not.
    """

    place: int
    stamp_ns: int
    effort: float
    sender: str


class Instruction(NamedTuple):
    """Something that a controller was told: a motion, or other settings.

    Attributes:
        log_time_ns: When it was recorded, in [ns].
        place: Its place in the log.
        what: The motion, or what makes the settings that are in force from then on.
        text: The same in words.
    """

    log_time_ns: int
    place: int
    what: Motion | Callable[[LoopSettings], LoopSettings]
    text: str


@dataclass(frozen=True)
class JointRecord:
    """One joint of a recording, each part in the order of the log.

    Attributes:
        settings: The controller's settings when it began.
        states: The states.
        commands: The commands.
        instructions: What the controller was told.
        begin_ns: Stamp from which times are counted, in [ns].
        is_slide: Whether the joint slides: its efforts are in [N].
    """

    settings: LoopSettings
    states: Sequence[RecordedState]
    commands: Sequence[RecordedCommand]
    instructions: Sequence[Instruction]
    begin_ns: int
    is_slide: bool = False
