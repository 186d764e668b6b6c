"""Which of several publishers a joint follows: the first one, until it is silent or has left.

The middleware does not tell who sent a message, but its number among those of its sender. The
numbers of one sender rise, so that two senders are told apart by which row a number continues.
"""

from __future__ import annotations


class FollowedPublisher:
    """Tells the publisher that a joint follows from others by the numbers of their messages.

    A number that rises by more than the one before may be the same sender's, after losses, or the
    first of another one. It is taken; the next number of the sender that was followed shows it.

    Attributes:
        others: Commands of others while one was followed.
        changes: How often the one that is followed has changed.

    Args:
        patience: The one that is followed is silent after so long, in [s].
    """

    def __init__(self, patience: float) -> None:
        self.others = self.changes = 0
        self._patience = patience
        self._heard = -patience
        self._last: int | None = None
        self._step = 1  # by which its numbers rise: not every one is about this joint
        self._before_jump: int | None = None  # its number before one that rose by more
        self._other: int | None = None  # the last number of somebody else

    def takes(self, number: int, effort: float, now: float) -> bool:
        """Tell whether a command is to be followed.

        Args:
            number: Of the message among those of its publisher.
            effort: The command in [N m]; zero is how a controller leaves its joint: whoever comes
                next may take over.
            now: The time in [s], on any clock that does not go back.
        """
        last, before = self._last, self._before_jump
        if last is None:
            self._follow(number)
        elif number == last + self._step:
            self._last, self._before_jump = number, None
        elif number > last and not self._is_by_other(number, last):
            self._last, self._step, self._before_jump = number, number - last, last
        elif before is not None and before < number < last:
            self.others += 1  # the one that rose so much
            self._other = last
            self._last, self._step, self._before_jump = number, number - before, None
        elif now - self._heard > self._patience:
            self.changes += 1
            self._other = last
            self._follow(number)
        else:
            self.others += 1
            self._other = number
            return False
        self._heard = now if effort != 0.0 else now - self._patience
        return True

    def wait(self, now: float) -> None:
        """Begin to be patient anew: time has stood still for everybody."""
        if self._last is not None:
            self._heard = now

    def _follow(self, number: int) -> None:
        self._last, self._step, self._before_jump = number, 1, None

    def _is_by_other(self, number: int, last: int) -> bool:
        """Tell whether a number continues the other's row better than the followed one's."""
        other = self._other
        if other is None or number <= other:
            return False
        return number - other - 1 < abs(number - last - self._step)
