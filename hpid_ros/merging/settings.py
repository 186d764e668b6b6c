"""What a merger is told: its joints in their order, how long it waits, what it falls back to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError, unknown_name

LONGEST_TIMEOUT = 1.0
"""No joint may be silent for longer than this without its fallback, in [s]."""

LARGEST_EFFORT = 1e6
"""No fallback is larger, in [N m] or [N]."""


@dataclass(frozen=True)
class MergedJoint:
    """One joint of a merged command."""

    name: str  # the joint
    timeout: float = 0.1  # [s] it is silent when no usable command has come for longer than this
    fallback: float = 0.0  # [N m] effort that it is sent while it is silent or [N]
    # whether the merger starts without a command of this joint, at its fallback
    may_be_missing: bool = False

    def __post_init__(self) -> None:
        if not self.name:
            raise SettingError("a joint must have a name, not an empty one")
        if not 0.0 < self.timeout <= LONGEST_TIMEOUT:
            raise SettingError(
                f"the timeout of {self.name} must lie in (0, {LONGEST_TIMEOUT:g}] s, "
                f"not {self.timeout}"
            )
        if not abs(self.fallback) <= LARGEST_EFFORT:
            raise SettingError(
                f"the fallback of {self.name} must lie in [{-LARGEST_EFFORT:g}, "
                f"{LARGEST_EFFORT:g}], not {self.fallback}"
            )


@dataclass(frozen=True)
class MergerSettings:
    """All that a merger is told."""

    joints: tuple[MergedJoint, ...]  # in the order of the merged command
    straggler_wait: float = 0.5
    # [s] a joint that comes back is faded in from its fallback for so long
    fade_in_time: float = 0.1

    def __post_init__(self) -> None:
        require_order(joint.name for joint in self.joints)
        if not 0.0 < self.straggler_wait <= 1.0:
            raise SettingError(f"straggler_wait must lie in (0, 1], not {self.straggler_wait}")
        if not (self.fade_in_time >= 0.0 and math.isfinite(self.fade_in_time)):
            raise SettingError(f"fade_in_time must be 0 s or more, not {self.fade_in_time}")

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names, in their order."""
        return tuple(joint.name for joint in self.joints)


def require_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return the order of a merged command."""
    order = tuple(names)
    if not order or len(set(order)) != len(order):
        raise SettingError(
            f"the joints of a merged command must be named once each, "
            f"not {', '.join(order) or 'none'}"
        )
    return order


def joints_of(
    order: Iterable[str],
    timeout: float,
    timeouts: Mapping[str, float],
    fallbacks: Mapping[str, float],
) -> tuple[MergedJoint, ...]:
    """Return the joints of a merged command."""
    names = require_order(order)
    for what, values in (("timeout", timeouts), ("fallback", fallbacks)):
        for name in values:
            if name not in names:
                unknown = unknown_name("joint", name, names)
                raise SettingError(f"a {what} is given for the {unknown}")
    return tuple(
        MergedJoint(name, timeouts.get(name, timeout), fallbacks.get(name, 0.0), name in fallbacks)
        for name in names
    )
