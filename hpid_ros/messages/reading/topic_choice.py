"""Which topics of a bag carry states, efforts and references, by names and types."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from hpid_ros.base.errors import BagError, unknown_name
from hpid_ros.base.names import joint_of_controller
from hpid_ros.messages.columns import (
    CONTROLLER_STATE,
    FLOAT64,
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MULTI_DOF_STATE,
)
from hpid_ros.messages.quality import HOLD
from hpid_ros.messages.selection import (
    EFFORT_COMMANDS,
    NO_COMMANDS,
    REFERENCES,
    BagSelection,
    CommandTopic,
)
from hpid_ros.motion.joint_trajectory import JointTrajectory


def find_topic(where: str, name: str, types: Mapping[str, str], allowed: Collection[str]) -> str:
    """Return the full name of a topic."""
    found = matching(name, types)
    if not found:
        raise BagError(f"{where}: {unknown_name('topic', name, types)}")
    if len(found) > 1:
        raise BagError(f"{where}: topic {name!r} could be any of {', '.join(found)}")
    (topic,) = found
    if types[topic] not in allowed:
        raise BagError(
            f"{where}: topic {topic} is {types[topic]}, but must be {' or '.join(allowed)}"
        )
    return topic


def matching(name: str, topics: Collection[str]) -> list[str]:
    """Return the topics that a name can mean, in order: one if it is a full name."""
    bare = name.lstrip("/")
    found = [topic for topic in topics if topic.lstrip("/") == bare]
    if not found and not name.startswith("/"):
        found = [topic for topic in topics if topic.endswith(f"/{bare}")]
    return sorted(found)


def namespace_of(topic: str) -> str:
    """Return the part before the last slash: ``/left`` for ``/left/joint_states``."""
    return topic.rpartition("/")[0]


def last_part(topic: str) -> str:
    return topic.rpartition("/")[2]


def is_below(topic: str, namespace: str) -> bool:
    """Return whether a topic is in a namespace or in one below it."""
    return f"/{topic.lstrip('/')}".startswith(f"{namespace.rstrip('/')}/")


def joint_of(topic: str) -> str:
    """Return the joint of a controller's own topic: ``elbow`` of ``/elbow_controller/command``."""
    return joint_of_controller(last_part(namespace_of(topic)))


FLOATS = (FLOAT64, FLOAT64_MULTI_ARRAY)
REPORTS = (CONTROLLER_STATE, MULTI_DOF_STATE)
"""Types in which controllers of ros2_control report reference and output of each joint."""
_OF_CONTROLLERS = (*REPORTS, JOINT_TRAJECTORY)
_WITHOUT_JOINT = ("control_msgs/msg/PidState", "control_msgs/msg/JointControllerState")
"""Types in which a single PID reports, which name no joint."""
_GOALS = (
    "control_msgs/msg/FollowJointTrajectoryActionGoal",  # of ROS 1
    "control_msgs/msg/FollowJointTrajectoryActionFeedback",
    "control_msgs/action/FollowJointTrajectory_SendGoal_Event",
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage",
)
_EFFORTS_OF_A_JOINT = ("cmd_force", "cmd_effort")
_COMMANDS_OF_A_JOINT = ("command", "commands")
"""Positions, velocities or efforts: only who ran the controllers knows."""
_SPEED_SCALING = "speed_scaling"
"""Of ur_robot_driver's speed_scaling_state_broadcaster, a Float64."""
_COMMANDS_OF_JOINTS = ("joint_commands", "joint_command")
"""The second is Isaac Sim's."""
_NEITHER_STATES_NOR_COMMANDS = ("reference", "terms", "estimate")


class ReferenceTopics(NamedTuple):
    """Topics that say what the joints were to follow."""

    trajectory: tuple[str, ...] = ()  # JointTrajectory, of the controllers
    setpoint: Mapping[str, str] = {}  # Float64, by joint
    sampled: tuple[str, ...] = ()  # JointState with sampled references
    # JointTrajectoryControllerState and MultiDOFStateStamped, with references
    controller_state: tuple[str, ...] = ()
    further: tuple[str, ...] = ()  # JointTrajectory, of other controllers or of planners

    @property
    def trajectories(self) -> tuple[str, ...]:
        return (*self.trajectory, *self.further)


NO_REFERENCES = ReferenceTopics()
"""Nothing says what the joints were to follow."""


@dataclass(frozen=True)
class TopicChoice:
    states: tuple[str, ...]  # of the states; each joint is on one of them
    # of stamped commands, JointState or JointTrajectoryControllerState
    commands: tuple[str, ...] = ()
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    references: ReferenceTopics = NO_REFERENCES
    # whether efforts are wanted, and there is anything that may carry them
    has_commands: bool = True
    reads_velocities: bool = False  # whether those that the states measured are wanted
    is_measured: bool = False  # whether the efforts are those that the states measured
    may_be_measured: bool = False  # whether those are to be taken if nothing else carries efforts
    measured_joints: frozenset[str] = (
        frozenset()
    )  # whose measured efforts are read beside commands
    beside: tuple[str, ...] = ()  # those of the commands that are reports beside joint_commands
    in_doubt: tuple[str, ...] = ()  # topics that may carry efforts, or something else
    others: tuple[str, ...] = ()  # of commands, taken for another robot's, where there are no more
    other_states: tuple[str, ...] = ()  # joint_states that nobody chose or left out
    not_own: tuple[str, ...] = ()  # reports and trajectories that are taken for another robot's
    relays: tuple[str, ...] = ()  # where controllers are asked for relays
    nameless: tuple[str, ...] = ()  # on which a single PID reports without its joint's name
    goals: tuple[str, ...] = ()  # of an action, and its feedback
    speed_scalings: tuple[str, ...] = ()  # how fast trajectories are followed

    def measured(self, joints: Collection[str] | None = None) -> TopicChoice:
        """Return the same with the efforts that the states measured: of some joints, or alone."""
        if joints is not None:
            return replace(self, measured_joints=frozenset(joints), may_be_measured=False)
        return replace(
            self,
            commands=self.states,
            command_topics={},
            is_measured=True,
            may_be_measured=False,
            beside=(),
        )

    @property
    def all(self) -> frozenset[str]:
        references = self.references
        return frozenset(
            (
                *self.states,
                *self.commands,
                *(each.topic for each in self.command_topics.values()),
                *references.trajectories,
                *references.setpoint.values(),
                *references.sampled,
                *references.controller_state,
            )
        )


def choose_topics(where: str, types: Mapping[str, str], selection: BagSelection) -> TopicChoice:
    return _Chooser(where, types, selection).choice()


class _Chooser:
    def __init__(self, where: str, types: Mapping[str, str], selection: BagSelection) -> None:
        self.where, self.selection, self.types = where, selection, types
        if selection.namespace is not None:
            namespace = f"/{selection.namespace.strip('/')}"
            self.types = {name: types[name] for name in types if is_below(name, namespace)}
            if not self.types:
                raise BagError(
                    f"{where}: no topic is below namespace {namespace}; topics: {_listed(types)}"
                )

    def choice(self) -> TopicChoice:
        states = self.states()
        self.near = _common([namespace_of(topic) for topic in states])
        self.others = {
            namespace_of(topic)
            for topic in self.of_type(JOINT_STATE)
            if last_part(topic) == "joint_states" and topic not in states
        }
        explicit = {
            joint: each._replace(topic=self.named(each.topic, FLOATS))
            for joint, each in self.selection.command_topics.items()
        }
        asked = self.selection.commands
        commands, found = self.commands(states, bool(explicit))
        topics = {**found, **explicit}
        are_missed = asked is None and not commands and not topics
        choice = TopicChoice(
            states,
            commands=commands,
            command_topics=topics,
            references=self.references(),
            has_commands=asked != NO_COMMANDS,
            reads_velocities=self.selection.velocities,
            is_measured=commands == states,
            beside=tuple(
                name
                for name in commands
                if self.types[name] in REPORTS and self.types[commands[0]] == JOINT_STATE
            ),
            may_be_measured=asked is None and not explicit,
            in_doubt=self.in_doubt({*commands, *(each.topic for each in topics.values())}),
            others=tuple(
                matching("joint_commands", self.of_type(JOINT_STATE)) if are_missed else ()
            ),
            other_states=tuple(
                name
                for name in self.of_type(JOINT_STATE)
                if self.selection.states is None
                and last_part(name) == "joint_states"
                and name not in (*states, *commands)
            ),
            not_own=tuple(sorted({*self.below(*_OF_CONTROLLERS)} - {*self.own(*_OF_CONTROLLERS)})),
            relays=tuple(
                name for name in self.below(FLOAT64_MULTI_ARRAY) if last_part(name) == "relay"
            ),
            nameless=tuple(self.own(*_WITHOUT_JOINT)),
            goals=tuple(self.own(*_GOALS)),
            speed_scalings=tuple(x for x in self.own(FLOAT64) if last_part(x) == _SPEED_SCALING),
        )
        if are_missed:
            return choice.measured()
        return choice

    def named(self, name: str, allowed: tuple[str, ...]) -> str:
        return find_topic(self.where, name, self.types, allowed)

    def of_type(self, *types: str) -> list[str]:
        return sorted(name for name, kind in self.types.items() if kind in types)

    def below(self, *types: str) -> list[str]:
        """Return the topics of some types in the namespace of the states, the nearest first."""
        found = [name for name in self.of_type(*types) if is_below(name, self.near)]
        return sorted(found, key=lambda name: name.count("/"))

    def own(self, *types: str) -> list[str]:
        """Return :meth:`below` without what is another robot's, which has states of its own."""
        found = self.below(*types)
        return [x for x in found if not any(self.is_of_another(x, each) for each in self.others)]

    def is_of_another(self, topic: str, namespace: str) -> bool:
        return is_below(topic, namespace) and not is_below(f"{self.near}/", namespace)

    def one(self, what: str, found: list[str], option: str) -> str:
        if len(found) > 1:
            raise BagError(
                f"{self.where}: {what} could be any of {', '.join(found)}; "
                f"choose by --namespace, or name the topic ({option})"
            )
        return found[0]

    def states(self) -> tuple[str, ...]:
        if self.selection.states is not None:
            found = [self.named(name, (JOINT_STATE,)) for name in self.selection.states]
            return tuple(dict.fromkeys(found))
        candidates = self.of_type(JOINT_STATE)
        found = matching("joint_states", candidates)
        if not found:
            found = [name for name in candidates if not _is_of_a_controller(name)]
        if not found:
            raise BagError(
                f"{self.where}: no topic of states ({JOINT_STATE}); topics: {self.listed()}"
            )
        return (self.one("the states", found, "--states, several times for one robot's"),)

    def listed(self) -> str:
        return _listed(self.types)

    def commands(
        self, states: tuple[str, ...], has_explicit: bool
    ) -> tuple[tuple[str, ...], dict[str, CommandTopic]]:
        """Return topics with stamps, and those of single joints without; none if there is none."""
        asked = self.selection.commands
        if asked == NO_COMMANDS:
            return (), {}
        if asked not in (None, EFFORT_COMMANDS):
            named = self.named(asked, (JOINT_STATE, *REPORTS))
            return (states if named in states else (named,)), {}
        candidates = self.of_type(JOINT_STATE)
        here = f"{self.near}/joint_commands"
        found = [here] if here in candidates else matching("joint_commands", candidates)
        are_several = len([x for x in candidates if last_part(x) == "joint_states"]) > 1  # robots
        if asked is None and are_several:
            found = [each for each in found if self.is_near(each)]
        reports = tuple(self.own(*REPORTS))
        if found and asked is None and len(states) > 1:  # as its states, so its commands
            own = tuple(name for name in found if is_below(name, self.near))
            return (*own, *reports) if own else (), {}
        if found and asked is None:
            return (self.one("the commands", found, "--commands"), *reports), {}
        wanted: tuple[str, ...] = _EFFORTS_OF_A_JOINT
        if asked == EFFORT_COMMANDS:
            wanted += _COMMANDS_OF_A_JOINT
        floats = {
            joint_of(name): CommandTopic(name)
            for name in reversed(self.below(*FLOATS))
            if last_part(name) in wanted
        }
        if asked == EFFORT_COMMANDS:
            if not floats:
                raise BagError(
                    f"{self.where}: no topic of a controller's commands, such as "
                    f"/elbow_controller/commands ({FLOAT64}, {FLOAT64_MULTI_ARRAY}); topics: "
                    f"{self.listed()}"
                )
            return (), floats
        if floats or reports or has_explicit:
            return reports, floats
        found = [
            name
            for name in candidates
            if name not in states
            and _may_be_commands(name)
            and (self.is_near(name) or not are_several)
        ]
        return (self.one("the commands", found, "--commands"),) if found else (), {}

    def is_near(self, topic: str) -> bool:
        """Return whether a topic is below the states' namespace, or in one above it.

        What has states of its own there is another robot.
        """
        if any(is_below(each, self.near) and is_below(topic, each) for each in self.others):
            return False
        return is_below(topic, self.near) or is_below(f"{self.near}/", namespace_of(topic))

    def in_doubt(self, taken: Collection[str]) -> tuple[str, ...]:
        """Return topics without names of joints that may carry efforts, or something else."""
        return tuple(
            name
            for name in self.below(*FLOATS)
            if last_part(name) in _COMMANDS_OF_A_JOINT and name not in taken
        )

    def references(self) -> ReferenceTopics:
        asked = self.selection.reference
        if isinstance(asked, JointTrajectory) or asked == HOLD:
            return NO_REFERENCES
        if asked not in REFERENCES:
            return self.named_reference(asked)
        here = f"{self.near}/joint_trajectory"
        trajectories = self.own(JOINT_TRAJECTORY)
        nearest = (here,) if here in trajectories else tuple(trajectories)
        found = ReferenceTopics(
            nearest,
            {
                joint_of(name): name
                for name in reversed(self.below(FLOAT64))
                if last_part(name) == "setpoint"
            },
            tuple(name for name in self.own(JOINT_STATE) if last_part(name) == "reference"),
            tuple(self.own(*REPORTS)),
            tuple(name for name in trajectories if name not in nearest),
        )
        if asked == "auto":
            return found
        wanted = getattr(found, asked)
        if not wanted:
            raise BagError(f"{self.where}: no {asked} as reference; topics: {self.listed()}")
        if asked == "trajectory":
            return NO_REFERENCES._replace(trajectory=wanted, further=found.further)
        return NO_REFERENCES._replace(**{asked: wanted})

    def named_reference(self, name: str) -> ReferenceTopics:
        allowed = (JOINT_TRAJECTORY, FLOAT64, JOINT_STATE, *REPORTS)
        topic = self.named(name, allowed)
        kind = self.types[topic]
        if kind == FLOAT64:
            joints = self.selection.joints or ()
            joint = joints[0] if len(joints) == 1 else joint_of(topic)
            return ReferenceTopics(setpoint={joint: topic})
        if kind == JOINT_TRAJECTORY:
            return ReferenceTopics(trajectory=(topic,))
        if kind == JOINT_STATE:
            return ReferenceTopics(sampled=(topic,))
        return ReferenceTopics(controller_state=(topic,))


def _common(namespaces: Sequence[str]) -> str:
    """Return the namespace that others share: ``/robot`` of ``/robot/arm`` and ``/robot/hand``."""
    parts = [namespace.split("/") for namespace in namespaces]
    shared = []
    for level in zip(*parts, strict=False):
        if len(set(level)) > 1:
            break
        shared.append(level[0])
    return "/".join(shared)


def _is_of_a_controller(topic: str) -> bool:
    """Return whether a JointState topic is a controller's output by its name."""
    return last_part(topic) in (*_NEITHER_STATES_NOR_COMMANDS, *_COMMANDS_OF_JOINTS)


def _may_be_commands(topic: str) -> bool:
    """Return whether a JointState topic that is not the states' may be commands by its name."""
    last = last_part(topic)
    return last not in _NEITHER_STATES_NOR_COMMANDS and "state" not in last


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({types[name]})" for name in sorted(types)) or "none"
