"""Claims of joints: a name that the kernel gives to one process, and claims that are told.

The name is that of an abstract unix socket. To take it is atomic, the kernel frees it when the
process ends, however that ends, and it costs nothing in between. A second socket of the holder
bears who it is in its name: that can be read in the table of the kernel even while the holder is
frozen, and nobody can send anything to either.

A claim is told again and again by who makes it, and ends when it has not been heard for a lease.
First it is a wish, for as long as others need to answer, and then it is held. Who wishes yields
to who holds; among equals the order is that of the records, so that both sides decide alike.
"""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import time
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

_PREFIX = "hpid_ros/"
_LONGEST_NAME = 107  # bytes of an abstract name, by the kernel
_TABLE = Path("/proc/net/unix")
_TRIES, _PAUSE = 10, 0.002  # [s]; between the two sockets of a holder lies less than that


class HostLock:
    """The right to something on this host, or rather in this network namespace."""

    def __init__(self, key: str, owner: str) -> None:
        self._name = _PREFIX + hashlib.sha256(key.encode()).hexdigest()[:16]
        self._owner = owner
        self._sockets: list[socket.socket] = []

    @staticmethod
    def realm() -> str:
        """Return a name of where locks hold: kernel and network namespace; empty if nowhere."""
        try:
            _bound(f"{_PREFIX}{os.getpid()}/{time.monotonic_ns()}").close()
            boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
            return f"{boot} {Path('/proc/self/ns/net').readlink()}"
        except OSError:  # not Linux, or a sandbox
            return ""

    def take(self) -> str:
        """Take the right."""
        if self._sockets:
            return ""
        try:
            self._sockets.append(_bound(self._name))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return self._holder()
        plate = f"{self._name}/{os.getpid()}"
        room = _LONGEST_NAME - len(plate) - 2
        self._sockets.append(_bound(f"{plate}/{self._owner[-room:]}"))
        return ""

    def release(self) -> None:
        """Give the right back; the name plate goes first."""
        while self._sockets:
            self._sockets.pop().close()

    def _holder(self) -> str:
        start = f"@{self._name}/"
        for _ in range(_TRIES):
            try:
                table = _TABLE.read_text(encoding="utf-8", errors="replace")
            except OSError:
                break
            for line in table.splitlines():
                name = line.rpartition(" ")[2]
                if name.startswith(start):
                    pid, _, node = name[len(start) :].partition("/")
                    return f"{node} (process {pid} of this host)"
            time.sleep(_PAUSE)
        return "a process of this host that cannot be named"


def _bound(name: str) -> socket.socket:
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        holder.bind("\0" + name)
    except BaseException:
        holder.close()
        raise
    return holder


LEASE = 1.5
"""A claim that has not been heard for so long has ended, in [s]."""


class ClaimState(Enum):
    """How far a claim has come."""

    WISHED = "wished"
    HELD = "held"
    RELEASED = "released"


@dataclass(frozen=True)
class Claim:
    """One controller's claim of one joint."""

    joint: str
    commands: str  # full name of the topic of its commands
    node: str  # full name of the node that claims
    host: str  # name of its host
    pid: int  # its process
    since_ns: int  # [ns] when its process began, or came back to life, by its host's clock
    realm: str
    state: ClaimState = ClaimState.WISHED  # how far it has come

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

    def receive(self, claim: Claim, now: float) -> None:
        """Take a claim that was told."""
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
