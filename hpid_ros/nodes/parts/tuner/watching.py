"""Samples of the controllers that somebody looks at."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Mapping
from typing import NamedTuple

from rclpy.node import Node

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.live.graph import Samples
from hpid_ros.live.sampling import Heard, JointSampler
from hpid_ros.live.streams import ControlClock, MessageColumns, Part, bare_numbers, joint_numbers
from hpid_ros.nodes.parts.tuner.streams import Streams
from hpid_ros.nodes.parts.tuner.topics import JOINT_STATE, ControllerTopics, Topic

_STAMP_OFFSET = 4  # of a message with a header, in bytes


class Watched(NamedTuple):
    """A controller that is looked at."""

    joint: str
    topics: ControllerTopics


class Watching:
    """Takes samples; every method may be called from any thread.

    A topic that several controllers share is subscribed to, taken and decoded once.
    """

    def __init__(self, node: Node) -> None:
        self._lock = threading.Lock()
        self._streams = Streams(node)
        self._watched: dict[str, Watched] = {}
        self._samplers: dict[str, JointSampler] = {}
        self._clocks: dict[Topic, ControlClock] = {}
        self._columns: dict[Topic, MessageColumns] = {}

    def watch(self, watched: Mapping[str, Watched]) -> None:
        """Take samples of these controllers from now on, and of no others."""
        with self._lock:
            if watched == self._watched:
                return
            topics = {topic for each in watched.values() for topic in each.topics if topic}
            self._streams.listen(topics)
            self._columns = {
                topic: self._columns.get(topic) or MessageColumns(topic.type) for topic in topics
            }
            states = {each.topics.states for each in watched.values()}
            self._clocks = {topic: self._clocks.get(topic, ControlClock()) for topic in states}
            self._samplers = {
                node: self._samplers[node]
                if self._is_same(node, each)
                else JointSampler(self._clocks[each.topics.states])
                for node, each in watched.items()
            }
            self._watched = dict(watched)

    def _is_same(self, node: str, watched: Watched) -> bool:
        before = self._watched.get(node)
        return before is not None and (before.joint, before.topics.states) == (
            watched.joint,
            watched.topics.states,
        )

    def listens_to(self, topic: Topic) -> bool:
        """Tell whether a topic is subscribed to."""
        with self._lock:
            return topic in self._columns

    def take(self) -> dict[str, Samples]:
        """Return what came since the last call, by node."""
        with self._lock:
            # What answers a state is taken before the states: so the state is there, too.
            parts: dict[Topic, list[Part]] = {}
            for which in ("commands", "reference", "states"):
                topics = {getattr(each.topics, which) for each in self._watched.values()}
                for topic in topics - {None}:
                    parts[topic] = self._columns[topic].read(self._streams.take(topic))
            return {
                node: self._samplers[node].take(_heard(each, parts))
                for node, each in self._watched.items()
            }

    def time_of(self, node: str) -> float:
        """Return the time now on the control clock of a controller, in [s]; nan if unknown."""
        with self._lock:
            if node not in self._samplers:
                return math.nan
            clock = self._samplers[node].clock
            if clock.last_ns is None:
                return math.nan
            newest = self._streams.peek(self._watched[node].topics.states)
            stamp_ns = clock.last_ns if newest is None else _stamp_ns(newest, clock.last_ns)
            return clock.now(stamp_ns) if stamp_ns >= clock.last_ns else math.nan

    def close(self) -> None:
        """Take no more."""
        self.watch({})
        self._streams.close()


def _heard(watched: Watched, parts: Mapping[Topic, list[Part]]) -> Heard:
    joint, topics = watched
    is_bare = topics.commands is not None and topics.commands.type != JOINT_STATE
    commands = parts[topics.commands] if topics.commands else []
    return Heard(
        joint_numbers(parts[topics.states], joint),
        joint_numbers([] if is_bare else commands, joint),
        bare_numbers(commands if is_bare else []),
        joint_numbers(parts[topics.reference], joint),
    )


def _stamp_ns(raw: bytes, otherwise: int) -> int:
    if len(raw) < _STAMP_OFFSET + 8:
        return otherwise
    order = "<" if raw[1] else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, _STAMP_OFFSET)
    return int(seconds * NANOSECONDS + nanoseconds)
