"""Qualities of service, chosen once.

Publishers are reliable, so that any subscriber may ask for either; controllers and bridge
subscribe with best effort, which costs a third less per sample and loses nothing on one
machine. A recorder asks for reliability; the depth of the publishers is what it may fall
behind. Every profile can be overridden by the standard ``qos_overrides`` parameters.
"""

from __future__ import annotations

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

_BEHIND_AT_MOST = 4000  # messages that a reliable subscriber may fall behind
_STATES_AT_ONCE = 5  # that a controller may fall behind before it forgets the oldest
_COMMANDS_AT_ONCE = 256  # joints that may answer one state before the bridge has looked


def _profile(reliability: ReliabilityPolicy, depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=DurabilityPolicy.VOLATILE,
    )


OFFERED = _profile(ReliabilityPolicy.RELIABLE, _BEHIND_AT_MOST)
"""States and commands, as they are published."""

NEWEST_STATES = _profile(ReliabilityPolicy.BEST_EFFORT, _STATES_AT_ONCE)
"""States, as a controller takes them: a hiccup is caught up, anything older is the past."""

ALL_COMMANDS = _profile(ReliabilityPolicy.BEST_EFFORT, _COMMANDS_AT_ONCE)
"""Commands, as the bridge takes them."""

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The reference: whoever comes later gets it too."""

RARE = _profile(ReliabilityPolicy.RELIABLE, 10)
"""Messages that come rarely: setpoints, diagnostics, poses."""


def overridable() -> QoSOverridingOptions:
    """Return the option that lets ``qos_overrides`` parameters replace a profile."""
    return QoSOverridingOptions.with_default_policies()
