"""The certificate of a controller's degree, found out beside its loop."""

from __future__ import annotations

from rclpy.node import Node

from hpid_ros.base.errors import GainError
from hpid_ros.control import LoopSettings
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.nodes.ros.steady_timer import steady_timer
from hpid_ros.stability.certifier import Certifier

_POLL_PERIOD = 0.1  # [s]


class Certification:
    """Warns of a degree that is not certified, or refuses it."""

    def __init__(self, node: Node, settings: LoopSettings) -> None:
        self._is_on = read_only(
            node, "certify", True, "Find out beside the loop whether its degree is certified"
        )
        self._is_required = read_only(
            node, "require_certificate", False, "Refuse degrees that are not certified stable"
        )
        self._certifier = Certifier()
        self._settings = settings
        if self._is_required:
            found = self._certifier.wait(settings)
            if not found.is_certified:
                raise GainError(_refusal(settings, found.text))
        elif self._is_on:
            self._certifier.want(settings)
        if self._is_required or self._is_on:
            steady_timer(node, _POLL_PERIOD, self._certifier.poll)

    def require(self, settings: LoopSettings) -> None:
        """Refuse settings that are about to be set, if a certificate is required.

        What is not known yet is refused as well, and begun: the same set succeeds later.
        """
        if not self._is_required:
            return
        found = self._certifier.finding(settings)
        if found.is_certified is None:
            self._certifier.want(settings)
        if not found.is_certified:
            raise GainError(_refusal(settings, found.text))

    def accept(self, settings: LoopSettings) -> None:
        """Take note of settings that are in force now."""
        self._settings = settings
        if self._is_on:
            self._certifier.want(settings)

    @property
    def degrees(self) -> str:
        """The certified degrees, in words."""
        if not self._is_on and not self._is_required:
            return "not asked for"
        return self._certifier.finding(self._settings).text

    @property
    def warning(self) -> str:
        """What to warn of; empty when there is nothing."""
        if not self._is_on and not self._is_required:
            return ""
        if self._certifier.finding(self._settings).is_certified is False:
            return f"mu = {self._settings.mu:g} is not certified stable"
        return ""

    def close(self) -> None:
        """End what is being computed."""
        self._certifier.close()


def _refusal(settings: LoopSettings, degrees: str) -> str:
    if degrees == "being computed":
        return "no certificate yet for these gains: it is being computed, set them again shortly"
    return f"mu = {settings.mu:g} is not certified stable; certified degrees: {degrees}"
