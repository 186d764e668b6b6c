"""Which of several senders a joint follows: the first one, until it is silent."""

from __future__ import annotations

_SPARED_AT_ZERO = 0.75  # of the patience, after an effort of zero


class FollowedSender:
    """Tells the sender that a joint follows from others.

    Attributes:
        sender: The one that is followed; None before the first command.
        other: Another one that commanded the joint meanwhile, the last of them.
        others: Commands of others that were not followed.
        changes: How often the one that is followed has changed.

    Args:
        patience: The one that is followed is silent after so long, in [s].
    """

    def __init__(self, patience: float) -> None:
        self.sender: str | None = None
        self.other = ""
        self.others = self.changes = 0
        self._patience = patience
        self._heard = 0.0

    def takes(self, sender: str, effort: float, now: float) -> bool:
        """Tell whether a command is to be followed.

        Args:
            sender: Who sent it; all who do not say so are one.
            effort: The command in [N m]; zero is how a controller leaves its joint, and how it
                rests: silence counts after a quarter of the patience then.
            now: The time in [s], on any clock that does not go back.
        """
        if sender != self.sender:
            if self.sender is not None:
                if now - self._heard <= self._patience:
                    self.others += 1
                    self.other = sender
                    return False
                self.changes += 1
            self.sender = sender
        self._heard = now if effort != 0.0 else now - _SPARED_AT_ZERO * self._patience
        return True

    def wait(self, now: float) -> None:
        """Begin to be patient anew: time has stood still for everybody."""
        self._heard = now
