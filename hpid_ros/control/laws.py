"""The laws by name, and what holds for each; ``make_law`` of :mod:`.assembly` makes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

LawName = Literal["hpid", "pid"]


class Law(NamedTuple):
    """What is to be known of a law, whatever its settings."""

    title: str  # in tables, legends and buttons
    # Certified as homogeneous, at its degree, which is mu. Otherwise it is certified as linear,
    # by Routh and Hurwitz, and its degree is 0, whatever mu is.
    is_homogeneous: bool
    needs_norm: bool  # with explicit steps; with semi-implicit ones every law has a norm


LAWS: Mapping[str, Law] = {
    "pid": Law("PID", is_homogeneous=False, needs_norm=False),
    "hpid": Law("hPID", is_homogeneous=True, needs_norm=True),
}
"""The laws, in the order in which a person chooses."""
