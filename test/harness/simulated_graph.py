"""A graph without ROS for the live page: joint loops on joints that are nothing but inertia."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from hpid_bench.live.known_controllers import (
    Answer,
    Change,
    Health,
    RunningController,
    RunningGraph,
    Samples,
)
from hpid_ros.base.errors import HpidError
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import PARAMETERS
from hpid_ros.robot.joint_description import UNLIMITED

PERIOD_NS = 1_000_000
_OF_NODE = {
    **{name: each.default for name, each in PARAMETERS.items()},
    **{"robot_description": "", "introspection_rate": 20.0, "require_certificate": False},
}
_LONGEST = 2.0  # [s] that is caught up at once
_STEP, _EVERY = 0.1, 2.0  # [rad, s] of the reference


class SimulatedJoint:
    """One joint, its loop, and a reference that steps to and fro."""

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        self.loop = JointLoop(settings)
        self.position = self.velocity = 0.0
        self.is_active = True
        self.stamp_ns = 0

    def run(self, until_ns: int) -> Samples:
        """Go on to a time, and return what was seen on the way."""
        states, efforts, references = [], [], []
        while self.stamp_ns < until_ns:
            self.stamp_ns += PERIOD_NS
            at = self.stamp_ns * 1e-9
            effort = 0.0
            if self.is_active:
                if self.stamp_ns % round(_EVERY * 1e9) == 0:
                    is_up = round(at / _EVERY) % 2
                    self.loop.follow(Setpoint(_STEP * is_up))
                effort = self.loop.step(self.stamp_ns, self.position, self.velocity)
                efforts.append((at, effort))
                if self.stamp_ns % 50_000_000 == 0:
                    references.append((at, *self.loop.following.reference))
            states.append((at, self.position, self.velocity))
            acceleration = effort / self.settings.inertia
            self.position += 1e-3 * self.velocity + 0.5e-6 * acceleration
            self.velocity += 1e-3 * acceleration
        arrays = (np.array(states), np.array(efforts), np.array(references))
        shapes = ((-1, 3), (-1, 2), (-1, 3))
        return Samples(*(a.reshape(s) for a, s in zip(arrays, shapes, strict=True)))


def loop_settings(joint: str, inertia: float = 0.5, **more: object) -> LoopSettings:
    """Return settings by a rule, for a joint of an inertia."""
    values = {
        "joint": joint,
        "gains.p": 200.0 * inertia,
        "gains.i": 500.0 * inertia,
        "gains.d": 20.0 * inertia,
        "inertia": inertia,
        "mu": -0.2,
        "norm.type": "canonical",
        "norm.effort_scale": 3.0,
        "norm.floor": 0.1,
        "u_clamp_max": 50.0,
        "u_clamp_min": -50.0,
        "velocity_max": 5.0,
    }
    return LoopSettings.from_parameters({**values, **more})


class SimulatedGraph:
    """A :class:`~hpid_bench.live.graph_client.GraphClient` of such joints, by the wall clock."""

    def __init__(self, joints: Mapping[str, LoopSettings]) -> None:
        self.joints = {node: SimulatedJoint(each) for node, each in joints.items()}
        self.gone: set[str] = set()
        self.sets: list[tuple[str, dict[str, object]]] = []
        self.transitions: list[tuple[str, str]] = []
        self.refusals: dict[str, str] = {}
        self._watched: tuple[str, ...] = ()
        self._changes: list[Change] = []
        self._began = time.monotonic()

    def controllers(self) -> dict[str, RunningController]:
        return {
            node: RunningController(
                node,
                {**_OF_NODE, **joint.settings.to_parameters()},
                joint.settings,
                UNLIMITED,
                "active" if joint.is_active else "inactive",
                Health(0, "following a reference", {"missed samples": "0"}, time.monotonic()),
                node not in self.gone,
            )
            for node, joint in sorted(self.joints.items())
        }

    def watch(self, nodes: Sequence[str]) -> None:
        self._watched = tuple(nodes)

    def take(self) -> dict[str, Samples]:
        now_ns = round((time.monotonic() - self._began) * 1e9)
        return {node: self._samples(self.joints[node], now_ns) for node in self._watched}

    def _samples(self, joint: SimulatedJoint, now_ns: int) -> Samples:
        joint.stamp_ns = max(
            joint.stamp_ns, now_ns - round(_LONGEST * 1e9) // PERIOD_NS * PERIOD_NS
        )
        joint.stamp_ns -= joint.stamp_ns % PERIOD_NS
        return joint.run(now_ns)

    def changes(self) -> list[Change]:
        found, self._changes = self._changes, []
        return found

    def set(self, node: str, values: Mapping[str, object]) -> Future[Answer]:
        self.sets.append((node, dict(values)))
        joint = self.joints[node]
        if self.refusals.get(node):
            return _done(Answer(False, self.refusals[node]))
        try:
            settings = joint.settings.with_parameters(values)
        except HpidError as error:
            return _done(Answer(False, str(error)))
        joint.settings = settings
        joint.loop.retune(settings)
        self._changes.append(Change(node, dict(values), joint.stamp_ns * 1e-9))
        return _done(Answer(True))

    def change_state(self, node: str, transition: str) -> Future[Answer]:
        self.transitions.append((node, transition))
        joint = self.joints[node]
        joint.is_active = transition == "activate"
        if joint.is_active:
            joint.loop.release()
        return _done(Answer(True))

    def running(self, nodes: Sequence[str], state_of: Callable) -> RunningGraph:
        seen = self.controllers()
        states = [(seen[node], *state_of(node)) for node in nodes]
        return RunningGraph.of(
            [replace(each, position=at, effort=effort) for each, at, effort in states],
            "/joint_states",
            has_commands=True,
        )


def _done(answer: Answer) -> Future[Answer]:
    future: Future[Answer] = Future()
    future.set_result(answer)
    return future


def arm(count: int = 3) -> dict[str, LoopSettings]:
    """Return settings of several joints, the later ones lighter, by node."""
    return {
        f"/arm_joint_{n}_controller": loop_settings(f"arm_joint_{n}", 0.8 * math.pow(0.5, n))
        for n in range(1, count + 1)
    }
