"""What is read of a bag: its metadata, and topics, joints, references, clock and window.

A recorder that was slower than what it recorded, or frozen for a while, knows from the middleware
how many messages it never got. Where it stood still for longer than a publisher's lease (an hour
with the profile of an experiment, else 20 s) the two forget each other, and nobody counts: how
long it stood still is told, too. The stamps of a stream show all that as gaps, where they are
regular.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpid_ros.base.errors import BagError, SettingError, unknown_name
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.messages.series import HOLD
from hpid_ros.motion.joint_trajectory import JointTrajectory

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@functools.cache
def jazzy_types() -> Typestore:
    """Return Jazzy's message definitions; building them takes some 50 ms, once."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def encode_joint_trajectory(trajectory: JointTrajectory) -> bytes:
    """Return a trajectory as a serialised ``trajectory_msgs/msg/JointTrajectory``."""
    types = jazzy_types()
    time, duration, header, point_type, message_type = (
        types.types[name]
        for name in (
            "builtin_interfaces/msg/Time",
            "builtin_interfaces/msg/Duration",
            "std_msgs/msg/Header",
            "trajectory_msgs/msg/JointTrajectoryPoint",
            JOINT_TRAJECTORY,
        )
    )
    points = [
        point_type(
            positions=np.array(point.positions),
            velocities=np.array(point.velocities),
            accelerations=np.array(point.accelerations),
            effort=np.array([]),
            time_from_start=duration(*divmod(point.time_from_start_ns, NANOSECONDS)),
        )
        for point in trajectory.points
    ]
    stamp = time(*divmod(trajectory.stamp_ns, NANOSECONDS))
    message = message_type(
        header=header(stamp=stamp, frame_id=""),
        joint_names=list(trajectory.joint_names),
        points=points,
    )
    return bytes(types.serialize_cdr(message, JOINT_TRAJECTORY))


METADATA = "metadata.yaml"
_KEY = "rosbag2_bagfile_information"


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return the information of a bag."""
    path = folder / METADATA
    if not path.is_file():
        raise BagError(f"{METADATA} is {'no file' if path.exists() else 'missing'}")
    document = load_yaml(path, BagError)
    metadata = document.get(_KEY) if isinstance(document, Mapping) else None
    if not isinstance(metadata, dict):
        raise BagError(f"cannot read {path}: it does not say {_KEY}")
    return metadata


def custom_data(bag: Path) -> Mapping[str, object]:
    """Return the texts that a recording was given; none for a damaged one.

    A single file has those of the folder in which it is, if that folder's metadata name it.
    """
    folder = bag if bag.is_dir() else bag.parent
    try:
        metadata = read_metadata(folder)
    except BagError:  # what is wrong with a bag is said when it is read
        return {}
    if folder is not bag and bag.name not in _files(metadata):
        return {}
    custom = metadata.get("custom_data")
    return custom if isinstance(custom, Mapping) else {}


def _files(metadata: Mapping[str, Any]) -> set[str]:
    named = metadata.get("relative_file_paths")
    return {Path(str(name)).name for name in named} if isinstance(named, list) else set()


def counts_of(metadata: Mapping[str, Any]) -> dict[str, int]:
    """Return how many messages of each topic the metadata counts."""
    counts: dict[str, int] = {}
    try:
        for each in metadata["topics_with_message_count"]:
            name, count = each["topic_metadata"]["name"], int(each["message_count"])
            counts[str(name)] = counts.get(str(name), 0) + count
    except (KeyError, TypeError, ValueError, OverflowError):
        return {}
    return counts


MISSED = "hpid_ros/missed_messages"
"""Name of the entry with the counts: JSON, by topic."""

STOOD_STILL = "hpid_ros/stood_still"
"""Name of the entry with the time that the recorder stood still, in [s]."""


def missed_entries(missed: Mapping[str, int], stood_still: float) -> dict[str, str]:
    """Return the entries for the metadata."""
    counts = json.dumps(dict(missed), sort_keys=True)
    return {MISSED: counts, STOOD_STILL: f"{stood_still:.3f}"}


def missed_messages(metadata: Mapping[str, str]) -> dict[str, int]:
    """Return the messages that a bag's recorder missed, by topic; only those that missed some."""
    try:
        entry = json.loads(metadata.get(MISSED, "{}"))
    except (ValueError, RecursionError):
        return {}
    if not isinstance(entry, dict):
        return {}
    return {topic: count for topic, count in entry.items() if type(count) is int and count > 0}


def time_stood_still(metadata: Mapping[str, str]) -> float:
    """Return how long a bag's recorder stood still, in [s]; zero if it did not or did not say."""
    try:
        seconds = float(metadata.get(STOOD_STILL, "0"))
    except ValueError:
        return 0.0
    return seconds if math.isfinite(seconds) and seconds > 0.0 else 0.0


SLIDES = "hpid_ros/slides"
"""Name of the entry with the joints that slide, whose units are m and N: JSON, a list."""


def slides_entry(slides: Collection[str]) -> dict[str, str]:
    """Return the entry for the metadata; none where no joint slides."""
    return {SLIDES: json.dumps(sorted(slides))} if slides else {}


def recorded_slides(metadata: Mapping[str, object]) -> frozenset[str]:
    """Return the joints that a bag's recorder knew to slide."""
    try:
        entry = json.loads(str(metadata.get(SLIDES, "[]")))
    except (ValueError, RecursionError):
        return frozenset()
    return frozenset(filter(_is_text, entry)) if isinstance(entry, list) else frozenset()


def _is_text(value: object) -> bool:
    return isinstance(value, str)


PARAMETERS = "hpid_ros/controllers"
"""Name of the entry with the parameters of the controllers as they began: a ROS parameter file."""


CLOCKS = ("header", "receive")
"""Where the time of states and stamped commands comes from.

``header`` is the stamp in the message, ``receive`` the time at which the recorder got it.
"""

REFERENCES = ("auto", "trajectory", "setpoint", "sampled", "controller_state", HOLD)
"""Kinds of reference: found in this order; see :class:`BagSelection`."""

NO_COMMANDS = "none"
"""As ``commands``: read no efforts."""

EFFORT_COMMANDS = "effort"
"""As ``commands``: what controllers publish on ``~/command`` or ``~/commands`` are efforts."""

Reference = str | JointTrajectory
"""A name of :data:`REFERENCES`, a topic, or the reference itself."""

_MAPPING = re.compile(r"(?P<joint>[^=]+)=(?P<topic>[^=\[\]]+)(\[(?P<element>\d+)\])?")


class CommandTopic(NamedTuple):
    """Where one joint's efforts are."""

    topic: str  # full name of the topic
    element: int = 0  # place in the data of a Float64MultiArray


@dataclass(frozen=True)
class BagSelection:
    """What is read from a bag, and on which clock. What is left out is found by name, then type.

    Topic names are full with a leading slash; without one their last parts are enough.

    Attributes:
        joints: Only these joints, in this order; all that are commanded or have a reference if
            None.
        namespace: Only topics below this namespace, for instance ``"/left"``: which of several
            robots.
        states: Topics of the states (``sensor_msgs/JointState``), each joint on one of them; a
            single name is one topic.
        commands: Topic of the efforts: ``sensor_msgs/JointState`` or
            ``control_msgs/JointTrajectoryControllerState`` (its output). The topic of the states
            gives their measured efforts, which are taken, too, where nothing else carries any.
            ``"effort"`` takes the numbers of ``*_controller/commands`` for efforts, which
            neither their names nor their types tell. ``"none"`` reads no efforts.
        command_topics: Topics with the efforts of single joints (``std_msgs/Float64``,
            ``std_msgs/Float64MultiArray``), by joint.
        reference: A name of :data:`REFERENCES`, or a topic: ``trajectory`` is
            ``trajectory_msgs/JointTrajectory``, ``setpoint`` a controller's
            ``std_msgs/Float64``, ``sampled`` its ``~/reference``, ``controller_state`` the
            reference of a ``JointTrajectoryControllerState``, ``hold`` the first position of
            each joint. ``auto`` takes the first of these, but for ``hold``, that the joint has.
            A trajectory is one that was followed from the first state on.
        clock: One of :data:`CLOCKS`. Commands without a stamp have their receive time in either.
        start: Begin of the window, seconds since the first state of any joint, in [s].
        end: End of the window (inclusive), likewise.
        separates_runs: Whether stamps that go back by a second or more begin another run, which
            then follows the one before after a gap; else all are put in the order of their stamps.

    Raises:
        SettingError: An unknown clock, an empty or reversed window, an empty name.
    """

    joints: Sequence[str] | None = None
    namespace: str | None = None
    states: str | Sequence[str] | None = None
    commands: str | None = None
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    reference: Reference = "auto"
    clock: str = "header"
    start: float | None = None
    end: float | None = None
    separates_runs: bool = False

    def __post_init__(self) -> None:
        if self.joints is not None:
            object.__setattr__(self, "joints", tuple(self.joints))
            if not self.joints or len(set(self.joints)) < len(self.joints):
                raise SettingError(f"joints must name each joint once, got {list(self.joints)}")
        object.__setattr__(self, "command_topics", dict(self.command_topics))
        if isinstance(self.states, str):
            object.__setattr__(self, "states", (self.states,))
        elif self.states is not None:
            object.__setattr__(self, "states", tuple(self.states))
        for name in ("namespace", "states", "commands", "reference"):
            value = getattr(self, name)
            if value == "" or (name == "states" and value is not None and not all(value or [""])):
                raise SettingError(f"{name} must not be an empty text")
        if self.clock not in CLOCKS:
            raise SettingError(unknown_name("clock", self.clock, CLOCKS))
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise SettingError(f"{name} must be zero or more seconds, got {value}")
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise SettingError(f"start must be before end, got {self.start} s and {self.end} s")


def parse_command_topics(texts: Sequence[str]) -> dict[str, CommandTopic]:
    """Return the mapping that options like ``elbow=/elbow_controller/commands[0]`` give."""
    topics: dict[str, CommandTopic] = {}
    for text in texts:
        match = _MAPPING.fullmatch(text)
        if match is None:
            raise SettingError(f"must be JOINT=TOPIC or JOINT=TOPIC[ELEMENT], got {text!r}")
        joint = match["joint"]
        if joint in topics:
            raise SettingError(f"joint {joint!r} has two command topics, the second in {text!r}")
        topics[joint] = CommandTopic(match["topic"], int(match["element"] or 0))
    return topics
