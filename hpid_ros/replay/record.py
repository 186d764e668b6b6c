"""What was recorded of one joint and of its controller, in the order of the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.interludes.relay import RelayRequest
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
    """Something that a controller was told: a motion, other settings, or a relay.

    Attributes:
        log_time_ns: When it was recorded, in [ns].
        place: Its place in the log.
        what: Does to a loop what the controller does then; it may refuse, in words.
        text: The same in words.
    """

    log_time_ns: int
    place: int
    what: Callable[[JointLoop], None]
    text: str


def following(motion: Motion) -> Callable[[JointLoop], None]:
    """Return what has a loop follow a motion."""
    return lambda loop: loop.follow(motion)


def retuned(change: Callable[[LoopSettings], LoopSettings]) -> Callable[[JointLoop], None]:
    """Return what puts the settings in force that a change makes of those before."""
    return lambda loop: loop.retune(change(loop.settings))


def driven(request: RelayRequest | None) -> Callable[[JointLoop], None]:
    """Return what has a relay drive a loop's joint; None ends one."""
    if request is None:
        return lambda loop: loop.end_relay("it was told to end")
    return lambda loop: loop.begin_relay(request)


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
