"""One controller a joint: an active controller claims it, and a second one is refused.

On one host the kernel decides, at once: by the name of an abstract unix socket, which is taken
atomically and freed when the process ends, however that ends. A second socket of the holder has
its owner in its name, which can be read in the kernel's table even while the holder is frozen.

Between hosts the graph decides: a claim is published again and again on a topic of the joint's
own, and ends when none has come for a lease. First it is a wish, for as long as others need to
answer, and then it is held. A wish yields to a held claim; among equals the order is that of the
records, so that both sides decide alike. Neither does anything when a state comes.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Literal

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.timer import Timer

from hpid_ros.base.errors import ClaimError
from hpid_ros.base.names import claim_topic
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.text import name_text
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import LATCHED, has_shared_memory_alone, held, steady_timer
from hpid_ros.nodes.core.parameters import read

_PREFIX = "hpid_ros/"
_LONGEST_NAME = 107  # bytes of an abstract name, by the kernel
_TABLE = Path("/proc/net/unix")
_TRIES, _PAUSE = 100, 0.002  # [s]; between the two sockets of a holder lies less than that


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
"""A claim of which no message has come for so long has ended, in [s]."""


class ClaimState(Enum):
    """How far a claim has come; the values are on the graph."""

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
    state: ClaimState = ClaimState.WISHED

    @property
    def owner(self) -> tuple[str, str, int, str]:
        return self.realm, self.host, self.pid, self.node

    def yields_to(self, other: Claim) -> bool:
        """Return whether of two claims of one joint it is this one that must go.

        Of two different owners exactly one yields to the other.
        """
        if self.state is not other.state:
            return self.state is ClaimState.WISHED
        return (other.since_ns, *other.owner) < (self.since_ns, *self.owner)


_MOST_CLAIMS = 64  # of others that are known at once


class ReceivedClaims:
    """The claims of others that have not ended."""

    def __init__(self) -> None:
        self._received: dict[tuple[str, str, int, str], tuple[float, Claim]] = {}

    def receive(self, claim: Claim, now: float) -> None:
        self._drop_ended(now)
        if claim.state is ClaimState.RELEASED:
            self._received.pop(claim.owner, None)
        elif claim.owner in self._received or len(self._received) < _MOST_CLAIMS:
            self._received[claim.owner] = now, claim

    def standing(self, now: float) -> Claim | None:
        """Return the claim that stands, the strongest of several; None if there is none."""
        self._drop_ended(now)
        claims = [claim for _, claim in self._received.values()]
        for claim in claims:
            if not any(claim.yields_to(other) for other in claims if other is not claim):
                return claim
        return None

    def _drop_ended(self, now: float) -> None:
        self._received = {
            owner: (at, claim)
            for owner, (at, claim) in self._received.items()
            if now - at <= LEASE
        }


_BEAT = 0.25  # [s]; six of them are a lease
_OVERDUE = 0.75  # [s] since the last message, after which the supervisor's thread publishes
_SETTLES_WITHIN = 0.5  # [s]; a holder on a network that is found at all has answered by then
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # goes on while a host sleeps
_STARTED_NS = time.time_ns()  # one for all joints of a process: all of them win, or none


@dataclass(frozen=True)
class ClaimParameters(Record):
    """What a controller has for itself alone."""

    claim: Literal["joint", "none"] = quantity(
        "joint: one active controller per joint; none: several may command one joint, which only "
        "the bridge reports",
        default="joint",
    )


def claims_joint(node: Node) -> bool:
    """Declare the parameter ``claim`` and tell whether it asks for a joint of the node's own."""
    return read(node, ClaimParameters).claim == "joint"


class JointClaim:
    """The claim of a controller's joint, from activation until the joint has been left."""

    def __init__(
        self,
        node: ClosingNode,
        is_claiming: bool,
        joint: str,
        commands: str,
        lose: Callable[[ClaimError, bool], None],
        what: str = "",
    ) -> None:
        self._what = what or f"joint {joint}"
        self._node, self._is_claiming, self._lose = node, is_claiming, lose
        self._mine: Claim | None = None
        self._timer: Timer | None = None
        self.refusal = ""
        if not self._is_claiming:
            return
        # Graphs of the same domain that do not reach each other have nothing to share.
        self._is_closed = has_shared_memory_alone()
        graph = f"shared memory of user {os.getuid()}" if self._is_closed else "network"
        domain = node.context.get_domain_id()
        name = node.get_fully_qualified_name()
        host, pid = socket.gethostname(), os.getpid()
        realm = HostLock.realm()
        self._lock = HostLock(f"{graph} {domain} {commands} {joint}", name) if realm else None
        if not realm:
            realm = f"{host} {pid} {name}"
            node.get_logger().warning(
                "this system has no abstract unix sockets: two controllers of one joint on this "
                "host find out only once they hear each other"
            )
        self._claim = Claim(joint, commands, name, host, pid, _STARTED_NS, f"{realm} {graph}")
        self._others = ReceivedClaims()
        self._listening_since: float | None = None
        self._published_at = 0.0
        self._publishing = threading.Lock()
        topic = claim_topic(commands, joint)
        self._publisher = node.create_publisher(DiagnosticStatus, topic, LATCHED)
        node.create_subscription(DiagnosticStatus, topic, self._on_claim, LATCHED)

    @property
    def text(self) -> str:
        if not self._is_claiming:
            return "none"
        return "none yet" if self._mine is None else self._mine.state.value

    @property
    def is_settled(self) -> bool:
        return not self._is_claiming or (
            self._mine is not None and self._mine.state is ClaimState.HELD
        )

    def take(self) -> None:
        if not self._is_claiming or self._mine is not None:
            return
        holder = self._lock.take() if self._lock else ""
        other = self._others.standing(_now())
        if not holder and other is not None:
            self._free()
            holder = _named(other)
        if holder:
            raise self._refused(holder)
        self.refusal = ""
        self._listening_since = None
        # In the closed mode there is nobody else.
        state = ClaimState.HELD if self._is_closed else ClaimState.WISHED
        self._mine = self._claim
        self._timer = steady_timer(self._node, _BEAT, self._beat)
        self._become(state)

    def settle(self) -> bool:
        """Hold the joint once others have had the time to answer that it is theirs."""
        if self._mine is not None and self._mine.state is ClaimState.WISHED:
            now = _now()
            if self._listening_since is None:  # the first call while messages are taken
                self._listening_since = now
            if now - self._listening_since >= _SETTLES_WITHIN:
                self._become(ClaimState.HELD)
        return self.is_settled

    def release(self) -> None:
        """Give the joint back, if it was claimed."""
        if self._mine is None:
            return
        self._become(ClaimState.RELEASED)
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        self._free()

    def _free(self) -> None:
        if self._lock is not None:
            self._lock.release()

    def _beat(self) -> None:
        if self._mine is None:
            return
        self._begin_again_after_lease()
        self.settle()
        with self._publishing:
            self._publish()

    def _begin_again_after_lease(self) -> None:
        """Wish again after having stood still: for the others the claim has ended."""
        if self._mine is None or _now() - self._published_at <= LEASE:
            return
        self._listening_since = None
        if self._mine.state is ClaimState.HELD:
            self._claim = replace(self._claim, since_ns=time.time_ns())
        self._become(ClaimState.WISHED)

    def _on_claim(self, message: DiagnosticStatus) -> None:
        try:
            claim = _from_message(message)
        except (KeyError, ValueError):
            self._node.get_logger().warning(
                f"no claim of a joint: {name_text(message.name)}", throttle_duration_sec=5.0
            )
            return
        mine = self._claim
        if claim.realm == mine.realm or (claim.joint, claim.commands) != (
            mine.joint,
            mine.commands,
        ):
            return
        self._others.receive(claim, _now())
        if claim.state is ClaimState.RELEASED or self._mine is None:
            return
        self._begin_again_after_lease()
        if self._mine.yields_to(claim):
            was_held = self._mine.state is ClaimState.HELD
            self._lose(self._refused(_named(claim)), was_held)

    def keep(self) -> float:
        """Publish a held claim where the executor does not, and return when to check again [s].

        On any thread: a node that gives efforts while its executor is stuck holds its joint.
        """
        if not self._is_claiming:
            return math.inf
        with held(self._publishing) as is_held:
            if not is_held:
                return _OVERDUE
            mine, silence = self._mine, _now() - self._published_at
            if mine is None or mine.state is not ClaimState.HELD or silence > LEASE:
                return math.inf  # not held, or held no more: the executor starts again
            if silence < _OVERDUE:
                return _OVERDUE - silence
            self._publish()
            return _OVERDUE

    def _become(self, state: ClaimState) -> None:
        """Go over to another state, and publish it."""
        with self._publishing:
            self._mine = replace(self._claim, state=state)
            self._publish()
            if state is ClaimState.RELEASED:
                self._mine = None
        if state is ClaimState.HELD and self._node.supervisor is not None:
            self._node.supervisor.check_again()

    def _publish(self) -> None:
        """Publish how it stands; with the lock held."""
        assert self._mine is not None
        self._publisher.publish(to_message(self._mine))
        self._published_at = _now()

    def _refused(self, holder: str) -> ClaimError:
        self.refusal = f"{self._what} is commanded by {holder}"
        return ClaimError(
            f"{self._claim.node}: {self.refusal}; one controller at a time may be active, unless "
            f"each has the parameter claim: none"
        )


def _now() -> float:
    return time.clock_gettime(_CLOCK)


def _named(claim: Claim) -> str:
    return f"{claim.node} (process {claim.pid} on host {claim.host})"


def to_message(claim: Claim) -> DiagnosticStatus:
    values = {
        "commands": claim.commands,
        "host": claim.host,
        "pid": str(claim.pid),
        "since [ns]": str(claim.since_ns),
        "realm": claim.realm,
    }
    return DiagnosticStatus(
        name=claim.node,
        hardware_id=claim.joint,
        message=claim.state.value,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


def _from_message(message: DiagnosticStatus) -> Claim:
    values = {pair.key: pair.value for pair in message.values}
    return Claim(
        joint=message.hardware_id,
        commands=values["commands"],
        node=message.name,
        host=values["host"],
        pid=int(values["pid"]),
        since_ns=int(values["since [ns]"]),
        realm=values["realm"],
        state=ClaimState(message.message),
    )
