"""The reference of a loop: what it follows, and the effort that is fed forward for it."""

from hpid_ros.control.reference.following import (
    LARGEST_POSITION,
    Following,
    Glide,
    Motion,
    Reference,
    Setpoint,
    Turned,
    whole_turns,
)

__all__ = [
    "LARGEST_POSITION",
    "Following",
    "Glide",
    "Motion",
    "Reference",
    "Setpoint",
    "Turned",
    "whole_turns",
]
