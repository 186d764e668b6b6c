"""Positions of an encoder that begins anew after each turn, made continuous."""

from __future__ import annotations

import math

_ROUNDING = 1e-3  # of a turn; a driver's pi need not be exactly half of it


class Unwrapper:
    """Adds up the increments of an encoder that wraps around.

    A step of more than half a turn between two states is a turn that the encoder has left out,
    if both positions are such as a wrapping encoder gives: within (-turn/2, turn/2] or
    [0, turn). Positions of an encoder that counts its turns are left alone.

    Args:
        turn: By how much the encoder wraps around, in [rad], positive.
    """

    __slots__ = ("_before", "_has_wrapped", "_largest", "_offset", "_turn")

    def __init__(self, turn: float) -> None:
        self._turn = turn
        self._largest = turn * (1.0 + _ROUNDING)
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next position is taken as it is."""
        self._before = math.nan
        self._offset = 0.0
        self._has_wrapped = False

    def interrupt(self) -> None:
        """Note that the joint may have moved any way since the last position.

        Of an encoder that has wrapped before, the nearest turn is taken; of another one it is
        not known that it ever does.
        """
        if not self._has_wrapped:
            self._before = math.nan

    def update(self, position: float) -> float:
        """Return the continuous position in [rad].

        Args:
            position: As the encoder gives it, in [rad], finite.
        """
        step = position - self._before
        if abs(step) > 0.5 * self._turn and max(abs(position), abs(self._before)) < self._largest:
            self._offset -= self._turn * round(step / self._turn)
            self._has_wrapped = True
        self._before = position
        return position + self._offset
