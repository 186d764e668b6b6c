"""Whose joint it is where no kernel decides: claims that are told, and the order among them.

A claim is told again and again by who makes it, and ends when it has not been heard for a lease.
First it is a wish, for as long as others need to answer, and then it is held. Who wishes yields
to who holds; among equals the order is that of the records, so that both sides decide alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

LEASE = 1.5
"""A claim that has not been heard for so long has ended, in [s]."""


class ClaimState(Enum):
    """How far a claim has come."""

    WISHED = "wished"
    HELD = "held"
    RELEASED = "released"


@dataclass(frozen=True)
class Claim:
    """One controller's claim of one joint.

    Attributes:
        joint: The joint.
        commands: Full name of the topic of its commands.
        node: Full name of the node that claims.
        host: Name of its host.
        pid: Its process.
        since_ns: When its process began, or came back to life, by its host's clock in [ns].
        realm: Where one kernel grants a joint to one process alone: among claims of one realm
            there is nothing to decide.
        state: How far it has come.
    """

    joint: str
    commands: str
    node: str
    host: str
    pid: int
    since_ns: int
    realm: str
    state: ClaimState = ClaimState.WISHED

    @property
    def owner(self) -> tuple[str, str, int, str]:
        """Who claims."""
        return self.realm, self.host, self.pid, self.node

    def yields_to(self, other: Claim) -> bool:
        """Tell whether of two claims of one joint it is this one that must go.

        Of two different owners exactly one yields to the other.
        """
        if self.state is not other.state:
            return self.state is ClaimState.WISHED
        return (other.since_ns, *other.owner) < (self.since_ns, *self.owner)

    def become(self, state: ClaimState) -> Claim:
        """Return it in another state."""
        return replace(self, state=state)


class HeardClaims:
    """The claims of others, as far as they have been heard of late."""

    def __init__(self) -> None:
        self._heard: dict[tuple[str, str, int, str], tuple[float, Claim]] = {}

    def hear(self, claim: Claim, now: float) -> None:
        """Take a claim that was told.

        Args:
            claim: The claim; one that is released ends.
            now: The time in [s], on any clock that does not go back.
        """
        if claim.state is ClaimState.RELEASED:
            self._heard.pop(claim.owner, None)
        else:
            self._heard[claim.owner] = now, claim

    def standing(self, now: float) -> Claim | None:
        """Return the claim that stands, the strongest of several; None if there is none."""
        self._heard = {
            owner: (heard, claim)
            for owner, (heard, claim) in self._heard.items()
            if now - heard <= LEASE
        }
        claims = [claim for _, claim in self._heard.values()]
        for claim in claims:
            if not any(claim.yields_to(other) for other in claims if other is not claim):
                return claim
        return None
