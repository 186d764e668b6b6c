"""How large an incoming message may be: asked before anything is made of what it claims.

A message says how many names and points it has before they come. Each of them takes some bytes, so
that a count is checked against the bytes that are left; nothing is as long as the product of two
counts, unless the message holds as many bytes. Beyond that what a node takes is bounded: its
loop waits meanwhile.
"""

from __future__ import annotations

from typing import NamedTuple

from hpid_ros.base.errors import MessageError

LENGTH = 4
"""Bytes of a sequence's or a text's length, the least that each text takes."""


class MessageBounds(NamedTuple):
    """The most that is taken of one message."""

    size: int  # bytes
    names: int  # joints, controllers, parameters
    points: int  # of a trajectory, all of one layout
    mixed_points: int  # of a trajectory whose points differ in layout


LIVE = MessageBounds(size=32 << 20, names=16_384, points=50_000, mixed_points=5_000)
"""What a node takes. A point is 32 bytes and more, a joint's four numbers in it 32 bytes more."""

_ANY = 2**63

RECORDED = MessageBounds(*(_ANY,) * len(MessageBounds._fields))
"""What is taken from a bag: reading it need not keep pace with a robot."""

MOST_NUMBERS = 64
"""Numbers of an array that asks a controller for something."""

MOST_DIMENSIONS = 8
"""Dimensions that an array may describe; ours have none."""

GOALS_KEPT = 64 << 20
"""Bytes of all goals that an action server keeps, which it does until their results expire."""


def require_size(kind: str, size: int, most: int = LIVE.size) -> None:
    """Refuse a message of more bytes than are taken."""
    if size > most:
        raise MessageError(f"a {kind} may have {most} bytes, not {size}")


def require_count(
    kind: str, what: str, count: int, least: int, left: int, most: int = _ANY
) -> None:
    """Refuse a count of things of ``least`` bytes each that the ``left`` bytes cannot hold."""
    if count > most:
        raise MessageError(f"a {kind} may have {most} {what}, not {count}")
    if count * least > left:
        raise MessageError(f"a {kind} cannot hold {count} {what} in its last {max(left, 0)} bytes")
