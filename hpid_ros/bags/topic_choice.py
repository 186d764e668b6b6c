"""Which topics of a bag are a run's states, commands and references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from hpid_ros.bags.layouts import CONTROLLER_STATE, FLOAT64, FLOAT64_MULTI_ARRAY, JOINT_STATE
from hpid_ros.bags.message_types import JOINT_TRAJECTORY
from hpid_ros.bags.selection import NO_COMMANDS, REFERENCES, BagSelection, CommandTopic
from hpid_ros.bags.topic_names import (
    find_topic,
    is_below,
    joint_of,
    last_part,
    matching,
    namespace_of,
)
from hpid_ros.errors import BagError

_FLOATS = (FLOAT64, FLOAT64_MULTI_ARRAY)
_COMMANDS_OF_A_JOINT = ("command", "commands", "cmd_force", "cmd_effort")
_NEITHER_STATES_NOR_COMMANDS = ("reference", "terms")


class ReferenceTopics(NamedTuple):
    """Topics that say what the joints were to follow.

    Attributes:
        trajectory: JointTrajectory.
        setpoint: Float64, by joint.
        sampled: JointState with sampled references.
        controller_state: JointTrajectoryControllerState with references.
    """

    trajectory: tuple[str, ...] = ()
    setpoint: Mapping[str, str] = {}
    sampled: tuple[str, ...] = ()
    controller_state: tuple[str, ...] = ()


NO_REFERENCES = ReferenceTopics()
"""Every joint holds its first position."""


@dataclass(frozen=True)
class TopicChoice:
    """The topics of a run.

    Attributes:
        states: Of the states.
        commands: Of stamped commands, JointState or JointTrajectoryControllerState.
        command_topics: Where single joints' commands without stamps are, by joint.
        references: Of the references.
        has_commands: Whether efforts are wanted.
    """

    states: str
    commands: tuple[str, ...] = ()
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    references: ReferenceTopics = NO_REFERENCES
    has_commands: bool = True

    @property
    def all(self) -> frozenset[str]:
        """All topics that are read."""
        references = self.references
        return frozenset(
            (
                self.states,
                *self.commands,
                *(each.topic for each in self.command_topics.values()),
                *references.trajectory,
                *references.setpoint.values(),
                *references.sampled,
                *references.controller_state,
            )
        )


def choose_topics(where: str, types: Mapping[str, str], selection: BagSelection) -> TopicChoice:
    """Find the topics of a run.

    Args:
        where: The bag, for errors.
        types: Types of its topics by full name.
        selection: What is asked for.

    Raises:
        BagError: A topic that was named is not there or of a wrong type, or what is needed
            cannot be found or could be any of several.
    """
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
        self.near = namespace_of(states)
        explicit = {
            joint: each._replace(topic=self.named(each.topic, _FLOATS))
            for joint, each in self.selection.command_topics.items()
        }
        commands, found = self.commands(states, bool(explicit))
        return TopicChoice(
            states,
            commands=commands,
            command_topics={**found, **explicit},
            references=self.references(),
            has_commands=self.selection.commands != NO_COMMANDS,
        )

    def named(self, name: str, allowed: tuple[str, ...]) -> str:
        return find_topic(self.where, name, self.types, allowed)

    def of_type(self, *types: str) -> list[str]:
        return sorted(name for name, kind in self.types.items() if kind in types)

    def below(self, *types: str) -> list[str]:
        """Return the topics of some types in the namespace of the states."""
        return [name for name in self.of_type(*types) if is_below(name, self.near)]

    def one(self, what: str, found: list[str], option: str) -> str:
        if len(found) > 1:
            raise BagError(
                f"{self.where}: {what} could be any of {', '.join(found)}; "
                f"choose by namespace or name the topic ({option})"
            )
        return found[0]

    def states(self) -> str:
        if self.selection.states is not None:
            return self.named(self.selection.states, (JOINT_STATE,))
        candidates = self.of_type(JOINT_STATE)
        found = matching("joint_states", candidates)
        if not found:
            found = [name for name in candidates if not _is_of_a_controller(name)]
        if not found:
            raise BagError(
                f"{self.where}: no topic of states ({JOINT_STATE}); topics: {self.listed()}"
            )
        return self.one("the states", found, "states")

    def listed(self) -> str:
        return _listed(self.types)

    def commands(
        self, states: str, has_explicit: bool
    ) -> tuple[tuple[str, ...], dict[str, CommandTopic]]:
        """Return topics with stamps, and those of single joints without."""
        asked = self.selection.commands
        if asked == NO_COMMANDS:
            return (), {}
        if asked is not None:
            return (self.named(asked, (JOINT_STATE, CONTROLLER_STATE)),), {}
        candidates = self.of_type(JOINT_STATE)
        here = f"{self.near}/joint_commands"
        found = [here] if here in candidates else matching("joint_commands", candidates)
        if found:
            return (self.one("the commands", found, "commands"),), {}
        floats = {
            joint_of(name): CommandTopic(name)
            for name in self.below(*_FLOATS)
            if last_part(name) in _COMMANDS_OF_A_JOINT
        }
        reports = tuple(self.below(CONTROLLER_STATE))
        if floats or reports or has_explicit:
            return reports, floats
        found = [
            name for name in candidates if name != states and not _is_of_a_controller(name, False)
        ]
        if found:
            return (self.one("the commands", found, "commands"),), {}
        raise BagError(
            f"{self.where}: no topic of commands; name it (commands), say where each joint's are "
            f"(command_topics), or read without ({NO_COMMANDS!r}); topics: {self.listed()}"
        )

    def references(self) -> ReferenceTopics:
        asked = self.selection.reference
        if asked == "hold":
            return NO_REFERENCES
        if asked not in REFERENCES:
            return self.named_reference(asked)
        here = f"{self.near}/joint_trajectory"
        trajectories = self.below(JOINT_TRAJECTORY)
        found = ReferenceTopics(
            (here,) if here in trajectories else tuple(trajectories),
            {
                joint_of(name): name
                for name in self.below(FLOAT64)
                if last_part(name) == "setpoint"
            },
            tuple(name for name in self.below(JOINT_STATE) if last_part(name) == "reference"),
            tuple(self.below(CONTROLLER_STATE)),
        )
        if asked == "auto":
            return found
        wanted = getattr(found, asked)
        if not wanted:
            raise BagError(f"{self.where}: no {asked} as reference; topics: {self.listed()}")
        return NO_REFERENCES._replace(**{asked: wanted})

    def named_reference(self, name: str) -> ReferenceTopics:
        allowed = (JOINT_TRAJECTORY, FLOAT64, JOINT_STATE, CONTROLLER_STATE)
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


def _is_of_a_controller(topic: str, commands_too: bool = True) -> bool:
    """Tell whether a JointState topic is a controller's output by its name."""
    last = last_part(topic)
    return last in _NEITHER_STATES_NOR_COMMANDS or (commands_too and last == "joint_commands")


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({types[name]})" for name in sorted(types)) or "none"
