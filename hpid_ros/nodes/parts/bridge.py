"""The bridge that stands in for the robot, whatever engine is behind it, and its parameters."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

from rclpy.node import Node
from sensor_msgs.msg import JointState

from hpid_ros.base.errors import (
    ExperimentError,
    HpidError,
    MessageError,
    RunError,
    SettingError,
    reason_of,
)
from hpid_ros.base.names import controller_name
from hpid_ros.base.records import Record, names_of, parameters_of, quantity
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.base.yaml_files import load_document
from hpid_ros.messages.joint_state import SIMULATED, EffortReader, JointStateTemplate
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.middleware import (
    ALL_COMMANDS,
    OFFERED,
    UNNAMED,
    overridable,
    steady_timer,
    subscribe_raw,
)
from hpid_ros.nodes.core.parameters import read, read_one
from hpid_ros.nodes.core.process import Scheduling, schedule
from hpid_ros.nodes.core.status import (
    ERROR,
    OK,
    WARN,
    Diagnostics,
    StatusParameters,
    StatusPipe,
    log_change,
)
from hpid_ros.nodes.core.waiting import Wait, Waiting, described, fits, other_side, unseen
from hpid_ros.nodes.parts.bridge_commanders import Commanders, HeldCommands
from hpid_ros.nodes.parts.bridge_services import (
    BridgeReports,
    BridgeServices,
    BridgeTiming,
    ReportParameters,
    WrenchParameters,
    offer_standard_services,
)
from hpid_ros.nodes.parts.command_interfaces import COMMANDS
from hpid_ros.nodes.parts.recorder import BagRecorder
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.simulation.lockstep import AnswerCounts, Barrier
from hpid_ros.simulation.world import World
from hpid_ros.simulation.world_file import ControlSection, PhysicsSection, WorldFile, world_of

_RESTART_TAKES = 0.2  # [s], at least: the place of one that was killed stays free for so long
_DEFAULT_ROBOT = "urdf/mobile_manipulator.urdf"
OVER_THE_FILE: Mapping[str, tuple[str, type[Record], str]] = {
    "joints": ("robot", RobotSection, "driven"),
    "fixed_base": ("robot", RobotSection, "fixed_base"),
    "payload_mass": ("robot", RobotSection, "payload"),
    "control_rate": ("control", ControlSection, "rate"),
    "answer_timeout": ("control", ControlSection, "answer_timeout"),
    "physics_steps": ("simulation", PhysicsSection, "physics_steps"),
}
"""Parameters that are laid over the file: its section, and what declares them."""


@dataclass(frozen=True)
class WorldFileParameters(Record):
    """The file of a world."""

    world_file: str = quantity(
        "YAML file of the world, for instance an experiment; parameters that are given as "
        "well override it",
        default="",
    )


@dataclass(frozen=True)
class WorldParameters(Record):
    """What holds in place of what the file says."""

    robot_description: str = quantity(
        "URDF of the robot: its XML text, a path, or a path in this package's share folder; "
        "that of world_file if empty",
        default="",
    )
    seed: int | None = quantity(
        "Seed of encoder offsets, noise and homing; the file's, or 0, if left out",
        default=None,
        least=0,
    )
    initial_positions: tuple[float, ...] | None = quantity(
        "Position of each driven joint at the start [rad]; zero, or the file's, if left out",
        default=None,
    )
    encoder_counts: tuple[int, ...] | None = quantity(
        "Encoder counts per revolution of each driven joint; 0 measures exactly", default=None
    )
    gui: bool = quantity("Show the engine's window", default=False)


def read_world_file(node: Node, engine: str) -> WorldFile:
    """Declare the parameters of a world and return what they say."""
    file = read(node, WorldFileParameters).world_file
    asked = read(node, WorldParameters, robot_description="" if file else _DEFAULT_ROBOT)
    robot = asked.robot_description
    document = load_document(find_resource(file), ExperimentError) if file else None
    if not (file or robot.strip()):
        raise SettingError("robot_description must be a URDF or name one, it is empty")
    values = {} if document is None else document.values
    values = _laid_over(node, values, robot, asked.seed, engine)
    found = world_of(values, document)
    world, joints = found.world, found.world.joints
    if asked.initial_positions:
        along = _along(joints, "initial_positions", asked.initial_positions)
        places = {**world.initial_positions, **dict(zip(joints, along, strict=True))}
        world = replace(world, initial_positions=places)
    if asked.encoder_counts:
        world = replace(
            world, encoder_counts=_along(joints, "encoder_counts", asked.encoder_counts)
        )
    # Without a display Bullet would end the process without a word.
    if asked.gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise SettingError("gui needs a display, and the variable DISPLAY names none")
    return found._replace(world=replace(world, gui=asked.gui))


def _laid_over(node: Node, values: Any, robot: str, seed: int | None, engine: str) -> Any:
    """Return a document with the parameters that were given laid over it."""
    if not isinstance(values, dict):
        return values
    values = dict(values) | ({} if seed is None else {"seed": seed})
    given: dict[str, dict[str, Any]] = {"simulation": {"engine": engine}}
    given |= {"robot": {"description": robot}} if robot else {}
    for name, (section, record, key) in OVER_THE_FILE.items():
        spec = replace(parameters_of(record)[key], name=name)
        value = read_one(node, spec, note="; the file's, or its default, if left out")
        if value is not None:
            value = spec.checked(value)
            value = list(value) if name == "joints" else value
            given.setdefault(section, {})[key] = value
    for section, entries in given.items():
        own = values.get(section, {})
        if isinstance(own, dict):
            values[section] = own | entries
    return values


def _along(joints: Sequence[str], name: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """Return the values of an array with one entry for each joint."""
    if len(values) != len(joints):
        raise SettingError(
            f"{name} must have one entry for each of {len(joints)} driven joints, "
            f"not {len(values)}"
        )
    return tuple(values)


@dataclass(frozen=True)
class PaceParameters(Record):
    """When a state is published."""

    mode: Literal["lockstep", "realtime"] = quantity(
        "Pace of the states: lockstep, realtime", default="lockstep"
    )
    duration: float = quantity(
        "Stamp of the last state [s]; 0 runs for ever", default=0.0, least=0.0, most=1e9
    )
    exit_when_done: bool = quantity("End the process after the last state", default=True)
    real_time_factor: float = quantity(
        "Simulated time per wall time in realtime", default=1.0, least=1e-6, most=1e6
    )
    command_timeout: float = quantity(
        "Simulated time for which a command stands in realtime",
        "s",
        default=0.1,
        least=1e-6,
        most=1e6,
    )

    @property
    def is_lockstep(self) -> bool:
        """Whether every state waits for its answers; otherwise the wall clock paces them."""
        return self.mode == "lockstep"

    @property
    def end_ns(self) -> int | None:
        """Stamp of the last state in [ns]; None runs for ever."""
        return round(self.duration * NANOSECONDS) or None


_CONTROLLERS = -1  # are waited for, not a number of subscribers or publishers


class _Present(NamedTuple):
    """How many of something are there, and how many the first state waits for."""

    found: int
    needed: int

    @property
    def is_short(self) -> bool:
        return self.found < self.needed


@dataclass(frozen=True)
class WaitingParameters(Record):
    """What the first state waits for."""

    wait_for_subscribers: int = quantity(
        "Subscribers that states must have first; -1 those of the controllers of all driven "
        "joints, or of what commands them in their place",
        default=_CONTROLLERS,
        least=_CONTROLLERS,
    )
    wait_for_publishers: int = quantity(
        "Publishers that commands must have first; -1 the controllers of all driven joints, or "
        "one that commands them in their place",
        default=_CONTROLLERS,
        least=_CONTROLLERS,
    )


@dataclass(frozen=True)
class RecordParameters(Record):
    """Whether the run is recorded in this process."""

    record: bool = quantity(
        "Run bag_recorder in this process, with its parameters; states and commands come to it "
        "without a subscription",
        default=False,
    )


@dataclass(frozen=True)
class FrameParameters(Record):
    """How frames are called."""

    frame_prefix: str = quantity("Before each frame's name, e.g. of two robots", default="")


_READINESS_PERIOD = 0.01  # [s]
_LOOKS = 8  # at who is missing, in one answer_timeout
_LAST_LOOK = 1.0 - 2.0 / _LOOKS  # of answer_timeout: the next look may be late, the limit holds
_PROGRESS_PERIOD_NS = 100_000_000
_LATE_NS = 500_000_000  # since a state: an answer that is missing then is waited for
_NAMED_AT_MOST = 1000  # joints that commands have named


class RobotBridge(executor.ClosingNode):
    """A simulated robot behind the topics of a real one.

    In ``lockstep`` every state waits for the command of every driven joint that carries its
    stamp, then the physics advance by one control period. In ``realtime`` the wall clock paces
    the states, and each joint gets its newest command.
    """

    def __init__(self, engine: str) -> None:
        super().__init__(f"{engine}_bridge")
        self.require_given("world_file", "robot_description")
        found = read_world_file(self, engine)
        settings = found.world
        self._pace = pace = read(self, PaceParameters)
        self._answer_timeout = found.control.answer_timeout
        everyone = len(settings.joints) if pace.is_lockstep else _CONTROLLERS
        self._waiting = read(
            self, WaitingParameters, wait_for_subscribers=everyone, wait_for_publishers=everyone
        )
        self._status = StatusPipe(self)
        self._world = World(settings)
        driven = self._world.description.select(settings.joints)
        limits = {joint.name: joint.effort for joint in driven}
        self._barrier: Barrier | HeldCommands = (
            Barrier(settings.joints, limits)
            if pace.is_lockstep
            else HeldCommands(settings.joints, round(pace.command_timeout * NANOSECONDS), limits)
        )
        # The silence of a joint's publisher after which another one may command it, in [s].
        patience = (
            min(self._answer_timeout, _RESTART_TAKES)
            if pace.is_lockstep
            else pace.command_timeout / pace.real_time_factor
        )
        self._commanders = Commanders(self, settings.joints, self._barrier.counts, patience)
        self._reader = EffortReader()
        self._template = JointStateTemplate(
            settings.joints,
            SIMULATED,
            position=True,
            velocity=self._world.read_velocities() is not None,
            effort=True,
        )
        self._states = self.create_publisher(
            JointState, "joint_states", OFFERED, qos_overriding_options=overridable()
        )
        self._commands = subscribe_raw(self, COMMANDS, self._on_command, ALL_COMMANDS)
        self._topics = self._states.topic_name, self._commands.topic_name
        self.recorder = BagRecorder(self._topics) if read(self, RecordParameters).record else None
        prefix = read(self, FrameParameters).frame_prefix
        self._reports = BridgeReports(self, self._world, prefix, pace.end_ns)
        self._simulation = BridgeServices(self, self._world, prefix, self._reset, self._resume)
        offer_standard_services(self, self._simulation, self._world)
        self._reported = ""
        self._diagnostics = Diagnostics(self, self._world.description.name)
        self._misread = self._obeyed = 0
        self._is_done = False
        self._is_started = False
        self._timing = BridgeTiming(settings.joints)
        self._stamp_ns = -1
        self._progressed_ns = time.perf_counter_ns()
        self._asked_again = False
        self._readiness = steady_timer(self, _READINESS_PERIOD, self._start_when_ready)
        self._is_short = False
        self._named: set[str] = set()  # joints in commands, while some are waited for
        self._waiting_log = Waiting(self)
        for source in (self._awaited_listeners, self._awaited_commanders, self._awaited_commands):
            self._waiting_log.add(source)
        self._waiting_log.begin()
        steady_timer(self, 1.0, self._report)
        self._scheduling = schedule(self)

    def _start_when_ready(self) -> None:
        has_recorder = self.recorder is None or self.recorder.is_recording
        listeners, commanders = self._present()
        if listeners.is_short or commanders.is_short or not has_recorder:
            now_ns = time.perf_counter_ns()
            if now_ns - self._progressed_ns > NANOSECONDS:
                self._progressed_ns = now_ns
                self._status.send(
                    "waiting", listeners=listeners.found, commanders=commanders.found
                )
            return
        self._readiness.cancel()
        self._is_started = True
        self._status.send("started")
        if self._pace.is_lockstep:
            steady_timer(self, self._answer_timeout / _LOOKS, self._watch)
            self._publish_state()
        else:
            period = self._world.settings.control_period_ns / NANOSECONDS
            self._publish_state()
            steady_timer(self, period / self._pace.real_time_factor, self._resume)

    def _present(self) -> tuple[_Present, _Present]:
        """Return the subscribers of states and the publishers of commands that count.

        Where no numbers are given these are the controllers, who listen and command by their
        joints' names, or what is called otherwise and commands all joints, as a merger does.
        """
        asked = self._waiting
        given = asked.wait_for_subscribers, asked.wait_for_publishers
        if max(given) > _CONTROLLERS:
            found = self._states.get_subscription_count(), self.count_publishers(COMMANDS)
            of_states, of_commands = zip(found, (max(each, 0) for each in given), strict=True)
            return _Present(*of_states), _Present(*of_commands)
        states, commands = self._topics
        listeners, commanders = (
            {end.node_name for end in ends} - {UNNAMED}  # not discovered yet
            for ends in (
                self.get_subscriptions_info_by_topic(states),
                self.get_publishers_info_by_topic(commands),
            )
        )
        controllers = set(map(controller_name, self._barrier.joints))
        if commanders - controllers and not listeners & controllers:
            return _Present(len(listeners), 1), _Present(1, 1)
        if commanders - controllers:
            return _Present(len(listeners & controllers), len(controllers)), _Present(1, 1)
        return (
            _Present(len(listeners & controllers), len(controllers)),
            _Present(len(commanders & controllers), len(controllers)),
        )

    def _awaited_listeners(self) -> Wait | None:
        """Return which subscribers the first state waits for, for the log."""
        if self._is_started:
            return None
        present, _ = self._present()
        if not present.is_short:
            return None
        topic = self._states.topic_name
        what, arrival = _counted(present.needed, "subscriber", "of the states")
        return Wait(what, arrival, topic, lambda _: described(other_side(self, self._states)))

    def _awaited_commanders(self) -> Wait | None:
        """Return which publishers the first state waits for, for the log."""
        if self._is_started:
            return None
        _, present = self._present()
        if not present.is_short:
            return None
        topic = self._commands.topic_name
        what, arrival = _counted(present.needed, "publisher", "of commands")
        return Wait(what, arrival, topic, self._commanders_found)

    def _commanders_found(self, joints: Sequence[str]) -> str:
        view = other_side(self, self._commands)
        names = {end.node.rpartition("/")[2] for end in view.ends}
        missing = [joint for joint in self._barrier.joints if controller_name(joint) not in names]
        line = described(view)
        if not names or len(missing) == len(self._barrier.joints):
            return line
        return f"{line}; there is none called {', '.join(map(controller_name, missing))}"

    def _awaited_commands(self) -> Wait | None:
        """Return which joints are without commands, for the log."""
        if not self._is_started or self._is_done or self._simulation.is_paused:
            return None
        waited_ns = time.perf_counter_ns() - self._timing.published_ns
        late = self._barrier.missing if waited_ns > _LATE_NS else ()
        missing = {*self._barrier.silent, *late}
        joints = tuple(joint for joint in self._barrier.joints if joint in missing)
        self._is_short = bool(joints)
        if not joints:
            self._named.clear()
            return None
        return Wait("commands", "come", self._commands.topic_name, self._commands_found, joints)

    def _commands_found(self, joints: Sequence[str]) -> str:
        view = other_side(self, self._commands)
        others = unseen(joints, self._named - set(self._barrier.joints))
        if not others and fits(view):
            others = "nothing has come for these joints"
        return f"{described(view)}{'; ' * bool(others)}{others}"

    def _on_command(self, raw: bytes) -> None:
        if self.recorder is not None:
            self.recorder.keep(self._topics[1], raw)
        try:
            stamp_ns, names, efforts = self._reader.read(raw)
        except MessageError as error:
            self._misread += 1
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        if self._is_short and len(self._named) < _NAMED_AT_MOST:
            self._named.update(names)
        now = time.perf_counter()
        names, efforts = self._commanders.heed(names, efforts, self._reader.sender, now)
        if not names:
            return
        self._obeyed += self._is_started
        if stamp_ns == self._stamp_ns:
            self._timing.answered(names)
        if self._barrier.answer(stamp_ns, names, efforts):
            self._resume()

    def _resume(self) -> None:
        """Advance if no command is missing and the simulation is not paused."""
        if not self._is_started or self._is_done or self._barrier.missing:
            return
        if self._simulation.may_advance():
            self._advance()

    def _advance(self) -> None:
        efforts = self._barrier.finish()
        if self._pace.end_ns is not None and self._world.time_ns >= self._pace.end_ns:
            self._finish()
            return
        try:
            self._world.step(efforts)
        except HpidError:
            raise
        except Exception as error:  # no matter of the command with which it was due
            raise RunError(f"the simulation failed: {reason_of(error)}") from error
        self._publish_state()

    def _publish_state(self) -> None:
        self._stamp_ns = stamp_ns = self._world.time_ns
        self._barrier.begin(stamp_ns)
        positions = self._world.read()
        self._last_state = self._template.encode(
            stamp_ns,
            position=positions,
            velocity=self._world.read_velocities() or (),
            effort=self._world.applied_efforts(),
        )
        self._timing.published()
        self._commanders.move()
        self._send_state()
        self._reports.sample(stamp_ns, positions)
        self._asked_again = False
        if self._timing.published_ns - self._progressed_ns > _PROGRESS_PERIOD_NS:
            self._progressed_ns = self._timing.published_ns
            self._status.send("progress", stamp_ns=stamp_ns, silent=self._barrier.silent)

    def _send_state(self) -> None:
        self._states.publish(self._last_state)
        if self.recorder is not None:  # while the controllers compute
            self.recorder.keep(self._topics[0], self._last_state)

    def _watch(self) -> None:
        """Ask again when an answer is late, and go on without it when it is too late."""
        waited = (time.perf_counter_ns() - self._timing.published_ns) / NANOSECONDS
        timeout = self._answer_timeout
        if self._barrier.is_abandoned:  # somebody may come back, and needs a state to answer
            self._send_state()
        if not self._barrier.missing or self._is_done:
            return
        if waited > _LAST_LOOK * timeout:
            given_up = self._barrier.time_out()
            line = f"no answer within {timeout} s: {', '.join(given_up)}{self._unstamped()}"
            log_change(self, line, is_warning=True)
            self._status.send("silent", joints=given_up, stamp_ns=self._world.time_ns)
            if not self._barrier.is_abandoned:
                self._resume()
        elif waited > timeout / 2.0 and not self._asked_again:
            self._asked_again = True
            self._send_state()

    def _reset(self) -> None:
        self._world.reset()
        self._is_done = False
        if self._is_started:
            self._publish_state()

    def _finish(self) -> None:
        self._is_done = True
        self._send_summary("finished")
        if self._pace.exit_when_done:
            self.request_stop()

    def _send_summary(self, event: str) -> None:
        """Send a parent the figures of the whole run."""
        self._status.send(
            event,
            states=self._world.time_ns // self._world.settings.control_period_ns + 1,
            counts={joint: vars(counts) for joint, counts in self._barrier.counts.items()},
            commands=self._obeyed,
            foreign=self._barrier.foreign,
            reports=self._reports.counts,
            wall_time=self._timing.elapsed,
            timing=self._timing.whole(),
        )

    def _unstamped(self) -> str:
        """Say whose commands come without the stamp of a state; empty if nobody's do."""
        joints = ", ".join(sorted(self._barrier.unstamped))
        return f"; the stamps of the commands for {joints} are 0" if joints else ""

    def _report(self) -> None:
        silent = self._barrier.silent
        if silent or self._barrier.missing:
            self._waiting_log.begin()
        unanswered = f"no answer from {', '.join(silent)}{self._unstamped()}"
        message = unanswered if silent else "running"
        if self._simulation.is_paused:
            message = "paused"
        if not self._is_started:
            message = "waiting for controllers"
        if message != self._reported:
            self._reported = message
            if silent and self._is_started:  # rclpy wants a line of its own for each severity
                self.get_logger().warning(message)
            else:
                self.get_logger().info(message)
        conflict = self._commanders.conflict()
        values: dict[str, Any] = {
            "simulated time [s]": self._world.time_ns / NANOSECONDS,
            "misread commands": self._misread,
            "commands for other joints": self._barrier.foreign,
            **_totals(self._barrier.counts.values()),
            **self._commanders.values(),
        }
        values |= self._timing.recent(self._world.time_ns) if self._is_started else {}
        values |= self._reports.figures()
        values["scheduling"] = self._scheduling
        level = ERROR if conflict else OK if self._is_started and not silent else WARN
        self._diagnostics.publish(level, conflict or message, values)

    def close(self) -> None:
        """Leave the engine, and send a summary if none has been sent."""
        if self._is_started and not self._is_done:
            self._send_summary("stopped")
        self._world.close()


def _counted(needed: int, what: str, whose: str) -> tuple[str, str]:
    """Return how many of something are needed, and how it is told that they are there."""
    if needed == 1:
        return f"a {what} {whose}", "is there"
    return f"{needed} {what}s {whose}", "are there"


def _totals(counts: Iterable[AnswerCounts]) -> dict[str, int]:
    each = list(counts)
    return {
        "unanswered": sum(count.unanswered for count in each),
        "answers to earlier states": sum(count.stale for count in each),
        "commands from before a reset": sum(count.outdated for count in each),
        "commands not finite": sum(count.invalid for count in each),
        "commands beyond the joint's limit": sum(count.excessive for count in each),
    }


BRIDGE_RECORDS: tuple[type[Record], ...] = (
    WorldFileParameters,
    WorldParameters,
    PaceParameters,
    WaitingParameters,
    RecordParameters,
    ReportParameters,
    FrameParameters,
    WrenchParameters,
    Scheduling,
    StatusParameters,
)
"""What a bridge's parameters are declared by, but for those laid over the file."""


def make_nodes(engine: str) -> list[executor.ClosingNode]:
    """Make a bridge and, if it is asked for, the recorder in its process."""
    bridge = RobotBridge(engine)
    return [bridge] if bridge.recorder is None else [bridge, bridge.recorder]


def usage(name: str, engine: str) -> Usage:
    return Usage(
        name,
        f"Simulates a robot in {engine} behind the topics of a real one.",
        "-p world_file:=FILE",
        [*OVER_THE_FILE, *names_of(*BRIDGE_RECORDS)],
        ["joint_commands", "~/wrench"],
        [
            "joint_states",
            "clock",
            "odom",
            "base_pose_ground_truth",
            "wheel_slip",
            "ee_pose",
            "brick_poses",
            "grip_events",
            "/diagnostics",
        ],
        ["~/pause", "~/step", "~/reset", "~/grip"],
    )
