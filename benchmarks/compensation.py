"""The cost of a model's term: from a state's bytes to what the loop needs, eight joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import pinocchio

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.measuring import time_per_item
from hpid_ros.base.resources import share_folder
from hpid_ros.control import LoopSettings
from hpid_ros.messages.joint_state import JointStateTemplate, RobotReader
from hpid_ros.robot.compensation import compensators
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import build_model

JOINT = "arm_joint_3"
PERIOD_NS = 1_000_000
GAINS = {"gains.p": 300.0, "gains.i": 1000.0, "gains.d": 30.0}
WHEELS = {"model.left_wheel": "wheel_left_joint", "model.right_wheel": "wheel_right_joint"}

_MICROSECONDS = 1e6  # in a second
_SAMPLES, _SAMPLES_QUICK = 20_000, 3_000
_LONGEST = 60.0  # [us] a sample


def group(quick: bool) -> Group:
    """Return the figures of the models' terms."""
    count = _SAMPLES_QUICK if quick else _SAMPLES
    bare = "Pinocchio's calls alone"
    contenders: dict[str, Measure] = {
        "decoupling, fixed base": _term("decoupling", {}, count),
        "decoupling, rolling base": _term("decoupling", WHEELS, count),
        "gravity": _term("gravity", {}, count),
        f"{bare}, fixed base": _bare(_dynamics(), count),
        f"{bare}, rolling base": _bare(_dynamics(pinocchio.JointModelPlanar()), count),
        f"{bare}, gravity": _bare(_gravity(), count),
    }
    names = {
        "decoupling": "decoupling, fixed base",
        "decoupling.rolling": "decoupling, rolling base",
        "gravity": "gravity",
    }
    peers = dict(zip(names, ("fixed base", "rolling base", "gravity"), strict=True))
    return Group(
        contenders,
        tuple(
            Figure(
                f"compensation.{name}",
                "us",
                Source(ours, "time"),
                Source(f"{bare}, {peers[name]}", "time"),
                bare,
                (Bound("ours", most=_LONGEST),),
            )
            for name, ours in names.items()
        ),
    )


def _states(joints: tuple[str, ...], count: int) -> list[bytes]:
    """Return serialised states of a robot that moves, without velocities."""
    template = JointStateTemplate(joints, position=True, effort=True)
    places = range(len(joints))
    return [
        template.encode(
            k * PERIOD_NS,
            position=[0.5 * math.sin(0.002 * k + place) for place in places],
            effort=[5.0 * math.cos(0.002 * k + place) for place in places],
        )
        for k in range(count)
    ]


def _term(kind: str, model: Mapping[str, object], count: int) -> Measure:
    """Return the measurement of one joint's term, as its node computes it."""
    settings = LoopSettings.from_parameters(
        {"joint": JOINT, "velocity_source": "filtered", "compensation": kind, **GAINS, **model}
    )
    robot = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
    states = _states(tuple(robot.joints), count)

    def measure() -> Mapping[str, float]:
        (compensator,) = compensators([settings], robot.xml)
        if compensator is None:
            raise RuntimeError("there is no model")
        reader, term = RobotReader(compensator.states.joints), compensator.term
        terms = []

        def run() -> None:
            for k, raw in enumerate(states):
                terms.append(term(k * PERIOD_NS, *reader.read(raw)))

        seconds = time_per_item(run, count)
        if None in terms or len(set(terms)) < count // 2:
            raise RuntimeError("the model did not give a term for each state")
        return {"time": seconds * _MICROSECONDS}

    return measure


def _model(root: pinocchio.JointModel | None = None) -> pinocchio.Model:
    robot = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
    return build_model(robot, root)


def _dynamics(root: pinocchio.JointModel | None = None) -> Callable[[], object]:
    """Return mass matrix, bias and a solution, by nothing but the libraries' calls."""
    model = _model(root)
    data, configuration = model.createData(), pinocchio.neutral(model)
    velocity = np.full(model.nv, 0.3)

    def call() -> object:
        mass = pinocchio.crba(model, data, configuration)
        bias = pinocchio.nonLinearEffects(model, data, configuration, velocity)
        return np.linalg.solve(mass, bias)

    return call


def _gravity() -> Callable[[], object]:
    model = _model()
    data, configuration = model.createData(), pinocchio.neutral(model)
    return lambda: pinocchio.computeGeneralizedGravity(model, data, configuration)


def _bare(call: Callable[[], object], count: int) -> Measure:
    def measure() -> Mapping[str, float]:
        def run() -> None:
            for _ in range(count):
                call()

        return {"time": time_per_item(run, count) * _MICROSECONDS}

    return measure
