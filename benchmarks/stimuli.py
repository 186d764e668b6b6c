"""Effort and motion of a joint when something goes wrong: ``python -m benchmarks.stimuli [NAME]``.

A driver with wall-clock stamps plays a joint of 1 kg m^2 under a load at 500 Hz; a controller of
its own process drives it along a trajectory. Then one thing happens, and the commands tell: the
effort before, its largest step from one command to the next, and how long until it was zero (or
the fallback effort, which is zero here). Exit codes: 0 measured, 1 a controller could not be
started, 2 unusable arguments, 130 interrupted.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from benchmarks.processes import exit_code
from hpid_bench.experiment.processes import (
    NodeGroup,
    NodeProcess,
    Process,
    closed_environment,
    own_domain,
)
from hpid_ros.base.errors import RunError, SettingError, unknown_name
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED, RARE

JOINT, NODE = "elbow", "elbow_controller"
OTHERS = ("a", "b", "c", "d", "e")
_PERIOD = 0.002  # [s]
_INERTIA, _LOAD = 1.0, -8.0  # [kg m^2, N m]
_GAINS = {"gains.p": 100.0, "gains.i": 150.0, "gains.d": 20.0}
_SPEED, _LENGTH = 0.5, 20.0  # [rad/s, s] of the trajectory
_RUN_IN, _AFTER, _WITHIN = 1.5, 1.0, 30.0  # [s]
_LONGEST = 0.1  # [s]; longer there is no command of the loop: that is what is measured
PACE = 400.0
"""How fast the effort may move with a reference that glides back onto its motion, in [N m/s]."""


@dataclass(frozen=True)
class Command:
    """One command as it came: when, on the steady clock in [s], and its effort in [N m]."""

    at: float
    effort: float


@dataclass
class Felt:
    """What a joint felt."""

    before: float  # the effort before in [N m]
    # the largest change from one command to the next after it, down to zero not counted, in [N m]
    step: float
    # likewise, of each change no more than exceeds :data:`PACE` for the time between the two
    # commands: on a busy machine the reference moves on meanwhile
    sudden: float
    to_zero: float = math.nan  # time until the effort was zero in [s]; NaN if it never was
    note: str = ""  # what else was seen
    # how late the driver was at worst in [s]: what it saw then is this machine's doing
    late: float = 0.0


@dataclass
class Driver:
    """The joint and its driver, as one node of this process."""

    node: rclpy.node.Node
    executor: SingleThreadedExecutor
    group: NodeGroup
    position: float = 0.3
    velocity: float = 0.0
    effort: float = 0.0
    commands: list[Command] = field(default_factory=list)
    reported: Callable[[float], float] = field(default=lambda position: position)
    is_told: bool = True
    is_braked: bool = False
    late: float = 0.0

    def __post_init__(self) -> None:
        self._template = JointStateTemplate([JOINT], position=True, velocity=True)
        self.states = self.node.create_publisher(JointState, "joint_states", OFFERED)
        self._trajectories = self.node.create_publisher(
            JointTrajectory, "joint_trajectory", LATCHED
        )
        self.node.create_subscription(
            JointState, "joint_commands", self._on_command, RARE, raw=True
        )
        self._due = self._lived = time.monotonic()

    def _on_command(self, raw: bytes) -> None:
        self.effort = decode_joint_state(raw).effort[0]
        self.commands.append(Command(time.monotonic(), self.effort))

    def start(self, name: str = NODE, **parameters: object) -> NodeProcess:
        """Start a controller of the joint and wait until it answers."""
        values = {"joint": JOINT, "law": "pid", **_GAINS, **parameters}
        arguments = [part for key, value in values.items() for part in ("-p", f"{key}:={value}")]
        process = self.group.start(name, "joint_controller", arguments)
        count = len(self.commands)
        self.until(lambda: len(self.commands) > count, f"{name} to answer")
        return process

    def run_in(self, **parameters: object) -> Process:
        """Start a controller and let the joint follow a trajectory until it does so steadily."""
        process = self.start(NODE, **parameters).process
        self.follow()
        self.live(_RUN_IN)
        return process

    def until(self, condition: Callable[[], bool], what: str, within: float = _WITHIN) -> None:
        """Let the joint live until a condition holds."""
        deadline = time.monotonic() + within
        while not condition():
            if time.monotonic() > deadline:
                raise RunError(f"waited {within:g} s in vain for {what}")
            self._live()

    def live(self, seconds: float) -> None:
        """Let the joint live for so long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._live()

    def _live(self) -> None:
        """One period: the joint moves, its state is told, commands are heard."""
        self._due = max(self._due + _PERIOD, time.monotonic() - 10 * _PERIOD)
        while (left := self._due - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)
        now = time.monotonic()
        self.late = max(self.late, now - self._due)
        # A late period is a long one; while a flood is sent the joint stands still.
        dt, self._lived = min(now - self._lived, 10 * _PERIOD), now
        if self.is_braked or not self.commands:
            self.velocity = 0.0
        else:
            self.velocity += dt * (self.effort + _LOAD) / _INERTIA
        self.position += dt * self.velocity
        if self.is_told:
            self.tell()

    def tell(self) -> None:
        """Publish the joint's state, stamped by the wall clock."""
        position = self.reported(self.position)
        self.states.publish(
            self._template.encode(time.time_ns(), position=[position], velocity=[self.velocity])
        )

    def follow(self, points: int = 2, *, is_mixed: bool = False) -> None:
        """Send a trajectory of six joints; the arrays differ from point to point if mixed."""
        message = JointTrajectory(joint_names=[JOINT, *OTHERS])
        for k in range(points):
            share = k / (points - 1)
            at = round(share * _LENGTH * 1e9)
            point = JointTrajectoryPoint(
                positions=[self.position + share * _SPEED * _LENGTH] * 6,
                velocities=[_SPEED] * 6 if not (is_mixed and k % 2) else [],
            )
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(at, 1_000_000_000)
            message.points.append(point)
        self._trajectories.publish(message)

    def set(self, name: str, value: float) -> None:
        """Set one parameter of the controller."""
        client = self.node.create_client(
            SetParametersAtomically, f"{NODE}/set_parameters_atomically"
        )
        self.until(client.service_is_ready, "the parameters")
        kind = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        future = client.call_async(
            SetParametersAtomically.Request(parameters=[Parameter(name=name, value=kind)])
        )
        self.until(future.done, "the answer to a set")
        if not future.result().result.successful:
            raise RunError(future.result().result.reason)

    def felt(self, since: float, note: str = "") -> Felt:
        """Return what the commands tell since an instant on the steady clock."""
        last = [each for each in self.commands if each.at < since][-1:]
        after = [each for each in self.commands if each.at >= since]
        zero = next((each.at - since for each in after if each.effort == 0.0), math.nan)
        steps = [
            (abs(b.effort - a.effort), min(b.at - a.at, _LONGEST))
            for a, b in pairwise([*last, *after])
            if b.effort != 0.0
        ]
        return Felt(
            last[0].effort if last else math.nan,
            max((step for step, _ in steps), default=0.0),
            max((step - PACE * dt for step, dt in steps), default=0.0),
            zero,
            note,
            self.late,
        )


def freeze(driver: Driver) -> Felt:
    """Stop the controller's process for 1.5 s and let it go on; the joint is held meanwhile."""
    process = driver.run_in()
    since = time.monotonic()
    process.send_signal(signal.SIGSTOP)
    driver.is_braked = True
    driver.live(1.5)
    driver.is_braked = False
    process.send_signal(signal.SIGCONT)
    driver.live(_AFTER)
    return driver.felt(since)


def silence(driver: Driver) -> Felt:
    """The driver stops telling states, and then repeats the last one."""
    driver.run_in()
    stamp_ns, position = time.time_ns(), driver.position
    repeat = driver._template.encode(stamp_ns, position=[position], velocity=[0.0])
    driver.states.publish(repeat)
    driver.is_told = False
    driver.live(0.004)
    since = time.monotonic()
    driver.live(0.3)
    heard = len(driver.commands)
    for _ in range(100):
        driver.states.publish(repeat)
        driver.live(_PERIOD)
    efforts = {each.effort for each in driver.commands[heard:]}
    return driver.felt(since, f"repeats after it get {sorted(efforts)} N m")


def flood(driver: Driver) -> Felt:
    """40 trajectories of 4999 points with differing arrays, and then no more states."""
    driver.run_in()
    last = time.monotonic()
    for _ in range(40):
        driver.follow(4999, is_mixed=True)
    driver.is_told = False
    since = time.monotonic()
    driver.until(lambda: driver.effort == 0.0, "the fallback", within=60.0)
    return driver.felt(since, f"sending them took {since - last:.1f} s")


def flood_and_signal(driver: Driver) -> Felt:
    """The same flood, and SIGTERM in the middle of it."""
    process = driver.run_in()
    for _ in range(40):
        driver.follow(4999, is_mixed=True)
    since = time.monotonic()
    process.send_signal(signal.SIGTERM)
    driver.until(lambda: process.poll() is not None, "the end", within=60.0)
    driver.live(0.1)
    return driver.felt(since, f"exit code {process.returncode}")


def _signalled(number: signal.Signals) -> Callable[[Driver], Felt]:
    def stimulus(driver: Driver) -> Felt:
        process = driver.run_in()
        since = time.monotonic()
        process.send_signal(number)
        driver.live(_AFTER)
        seen = driver.felt(since)
        if process.poll() is None:
            state = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
            seen.note = "stopped" if state == "T" else "goes on"
            process.send_signal(signal.SIGCONT)
        else:
            seen.note = f"exit code {process.returncode}"
        return seen

    return stimulus


def rival(driver: Driver) -> Felt:
    """A second controller of the same joint is started."""
    driver.run_in()
    since = time.monotonic()
    second = driver.group.start(
        "rival", "joint_controller", ["-p", f"joint:={JOINT}", "-p", "gains.p:=500.0"]
    )
    driver.until(lambda: second.process.poll() is not None, "the rival to give up")
    driver.live(_AFTER)
    return driver.felt(since, f"exit code of the second {second.process.returncode}")


def wrap(driver: Driver) -> Felt:
    """The encoder begins anew at pi, and the controller knows that it does."""
    driver.reported = lambda position: (position + math.pi) % math.tau - math.pi
    driver.position = 2.2
    driver.run_in(encoder_wrap=math.tau)
    since = time.monotonic()
    driver.live(2.0)
    return driver.felt(since, f"the joint is at {driver.position:.2f} rad")


def jump(driver: Driver) -> Felt:
    """The encoder is set to another zero, 1 rad away."""
    driver.run_in(velocity_max=5.0)
    since = time.monotonic()
    driver.reported = lambda position: position + 1.0
    driver.live(_AFTER)
    return driver.felt(since)


def glitch(driver: Driver) -> Felt:
    """One position is 1 rad off."""
    driver.run_in(velocity_max=5.0)
    since = time.monotonic()
    driver.reported = lambda position: position + 1.0
    driver.tell()
    driver.reported = lambda position: position
    driver.live(_AFTER)
    return driver.felt(since)


def estimator(driver: Driver) -> Felt:
    """``velocity_filter_time_constant`` is set from 5 to 6 ms in motion."""
    driver.run_in(velocity_source="filtered")
    since = time.monotonic()
    driver.set("velocity_filter_time_constant", 0.006)
    driver.live(_AFTER)
    return driver.felt(since)


STIMULI: dict[str, Callable[[Driver], Felt]] = {
    "freeze of 1.5 s": freeze,
    "silence, then repeats": silence,
    "flood of trajectories, then silence": flood,
    "flood of trajectories, SIGTERM": flood_and_signal,
    **{
        number.name: _signalled(number)
        for number in (
            signal.SIGTERM,
            signal.SIGINT,
            signal.SIGHUP,
            signal.SIGTSTP,
            signal.SIGQUIT,
            signal.SIGUSR1,
            signal.SIGALRM,
        )
    },
    "second controller": rival,
    "encoder wraps": wrap,
    "encoder set to another zero": jump,
    "one wrong position": glitch,
    "velocity filter retuned": estimator,
}
"""What can happen, by name."""


@contextmanager
def a_joint() -> Iterator[Driver]:
    """Give a joint on a domain of its own, in the closed mode."""
    with own_domain() as domain, tempfile.TemporaryDirectory(prefix="hpid_stimuli_") as folder:
        environment = closed_environment(domain)
        before = dict(os.environ)
        os.environ.update(environment)
        context = rclpy.Context()
        no_signals = SignalHandlerOptions.NO
        rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=no_signals)
        node = rclpy.create_node("joint", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            with NodeGroup(environment, Path(folder)) as group:
                yield Driver(node, executor, group)
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
            os.environ.clear()
            os.environ.update(before)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the stimuli that the arguments name and print them as a table."""
    names = list(sys.argv[1:] if arguments is None else arguments) or list(STIMULI)

    def run() -> int:
        for name in names:
            if name not in STIMULI:
                raise SettingError(unknown_name("stimulus", name, STIMULI))
        print("| what happens | effort before [N m] | largest step [N m] | to zero [ms] | |")
        print("|---|---|---|---|---|")
        for name in names:
            with a_joint() as driver:
                felt = STIMULI[name](driver)
            to_zero = "-" if math.isnan(felt.to_zero) else f"{1e3 * felt.to_zero:.0f}"
            print(
                f"| {name} | {felt.before:.1f} | {felt.step:.1f} | {to_zero} | {felt.note} |",
                flush=True,
            )
        return 0

    return exit_code("stimuli", run)


if __name__ == "__main__":
    sys.exit(main())
