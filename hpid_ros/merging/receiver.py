"""Who gets the merged commands: whether they are heard, in which order, and whether they act."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.base.errors import SettingError
from hpid_ros.merging.settings import require_order

ACTIVE = "active"
"""State of a controller that acts on commands, as lifecycles name it."""

EFFORT = "effort"
"""Interface of ros2_control that efforts are for."""


class Receiver:
    """What is known of the receiver of merged commands, and why nothing may be sent to it.

    A receiver that is named is a group controller of ros2_control, which says itself which joints
    it has, in which order. A message of another size would end it, so it is asked whenever there
    is a new one of that name, and gets nothing before it has answered. Of one without a name
    nothing is known but that somebody subscribes.
    """

    def __init__(self, name: str, joints: Sequence[str], topic: str) -> None:
        self.name = name
        self._given = tuple(joints)
        self._topic = topic
        self._endpoints: frozenset[bytes] = frozenset()
        self._told: tuple[str, ...] = ()
        self._refusal = ""
        self._state: str | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        """The order of the commands; empty while it is not known."""
        return self._told if self.name else self._given

    @property
    def must_be_asked(self) -> bool:
        """Whether it is there and has not said which joints it has."""
        return bool(self.name and self._endpoints and not self._told and not self._refusal)

    @property
    def is_refused(self) -> bool:
        """Whether it has said something of itself for which it gets nothing."""
        return bool(self._refusal)

    @property
    def is_deactivated(self) -> bool:
        """Whether it is there, and does not act on commands."""
        return bool(self._endpoints) and self._state not in (None, ACTIVE)

    @property
    def reason(self) -> str:
        """Why nothing may be sent, in words; empty if something may."""
        if self._refusal:
            return self._refusal
        if not self._endpoints:
            return f"waiting for {self.name or 'somebody'} to subscribe to {self._topic}"
        if not self.joints:
            return f"waiting for {self.name} to say which joints it has"
        if self.is_deactivated:
            return f"{self.name} is {self._state}, and discards what it is sent"
        return ""

    def see(self, endpoints: frozenset[bytes]) -> bool:
        """Take note of its subscriptions to the commands."""
        is_new = bool(endpoints - self._endpoints)
        if is_new:
            self._told, self._refusal = (), ""
        if not endpoints:
            self._told, self._refusal, self._state = (), "", None
        self._endpoints = endpoints
        return is_new

    def hear_state(self, state: str | None) -> None:
        """Take note of what its manager says of it."""
        self._state = state

    def hear_joints(self, joints: Sequence[str] | None, interface: str | None) -> None:
        """Take note of what it says of itself."""
        try:
            self._told, self._refusal = self._checked(joints, interface), ""
        except SettingError as error:
            self._told, self._refusal = (), f"nothing is sent to {self.name}: {error}"

    def _checked(self, joints: Sequence[str] | None, interface: str | None) -> tuple[str, ...]:
        if joints is None:
            raise SettingError("it has no parameter joints")
        if interface not in (None, "", EFFORT):
            raise SettingError(f"it commands the {interface} of its joints, not their effort")
        order = require_order(joints)
        if self._given and self._given != order:
            raise SettingError(
                f"its joints are {', '.join(order)}, those that were given "
                f"{', '.join(self._given)}"
            )
        return order
