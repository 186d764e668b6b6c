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
    """A state that a controller may have heard."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the log
    stamp_ns: int  # [ns] its stamp
    answer: Answer


class RecordedCommand(NamedTuple):
    """A command for the joint."""

    place: int  # its place in the log
    stamp_ns: int  # [ns] stamp of the state that it answers
    effort: float  # [N m]
    sender: str  # who sent it, as it says; empty where it does not


class Instruction(NamedTuple):
    """Something that a controller was told: a motion, other settings, or a relay."""

    log_time_ns: int  # [ns] when it was recorded
    place: int  # its place in the log
    what: Callable[[JointLoop], None]  # does to a loop what the controller does then
    text: str  # the same in words


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
    """One joint of a recording, each part in the order of the log."""

    settings: LoopSettings  # the controller's settings when it began
    states: Sequence[RecordedState]
    commands: Sequence[RecordedCommand]
    instructions: Sequence[Instruction]  # what the controller was told
    begin_ns: int  # [ns] stamp from which times are counted
    is_slide: bool = False  # [N] whether the joint slides: its efforts are
