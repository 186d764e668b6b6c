"""The engines against each other; the in-process loop and the simulated robot against them bare.

Bare means: the same built scene, and for each control period what the same motion cannot do
without: set eight torques and step, in Bullet once for each physics step (it forgets torques
after every step), then read eight joints. It replays the efforts that the loops gave, so both
sides do the same physics; that they end in the same place, to the bit, is checked each time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

import mujoco

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.measuring import time_per_item
from benchmarks.tracking import tracking
from hpid_bench.experiment.description import Experiment, following_loops
from hpid_ros.control import JointLoop
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.mujoco import MujocoPhysics
from hpid_ros.simulation.settings import WorldSettings, installed_engines
from hpid_ros.simulation.world import World

LABEL = "hPID"

_PERIODS, _PERIODS_QUICK = 3000, 500
_MICROSECONDS = 1e6  # in a second
_NAMES = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}

Efforts = Sequence[Sequence[float]]


def group(quick: bool) -> Group:
    """Return the figures of the engines, of the in-process loop and of the bridge's physics."""
    periods = _PERIODS_QUICK if quick else _PERIODS
    contenders: dict[str, Measure] = {}
    figures: list[Figure] = []
    for engine in installed_engines():
        for steps in (None, 1):
            study = _Study(tracking(steps, engine=engine), periods)
            contenders |= study.contenders()
            figures += study.figures("" if steps is None else f".steps{steps}")
    if "pybullet" in installed_engines():
        figures += _between_engines()
    return Group(contenders, tuple(figures))


def _between_engines() -> list[Figure]:
    """Return what MuJoCo saves: a physics step, and a period of the whole loop."""
    bullet, own = (
        _label(tracking(None, engine=engine).world) for engine in ("pybullet", "mujoco")
    )
    steps = Source(f"bare {bullet}", "step"), Source(f"bare {own}", "step")
    return [
        Figure("engine.step", "us", *steps,
               "a bare step of PyBullet, over MuJoCo's", (Bound("ratio", least=10.0),)),
        Figure("engine.rate", "periods/s", Source(f"run_in_process, {own}", "rate"),
               Source(f"run_in_process, {bullet}", "rate"), f"{bullet}, ours {own}",
               (Bound("ratio", least=12.0),)),
    ]  # fmt: skip


def _label(world: WorldSettings) -> str:
    return f"{_NAMES[world.engine]}, {world.physics_steps} physics steps"


class _Study:
    """One experiment, measured with and without the package around its engine."""

    def __init__(self, experiment: Experiment, periods: int) -> None:
        self._experiment, self._periods = experiment, periods
        self._world: WorldSettings = experiment.world
        self._label = _label(self._world)
        self._samples: list[Sample] = []
        self._end: tuple[float, ...] = ()

    def contenders(self) -> dict[str, Measure]:
        """Return what is measured, by name."""
        return {
            f"run_in_process, {self._label}": self.in_process,
            f"World.step and read, {self._label}": self.world_alone,
            f"bare {self._label}": self.bare,
            f"bare {self._label}, and loops": self.bare_and_loops,
        }

    def figures(self, end: str) -> list[Figure]:
        """Return the figures of this engine and number of steps."""
        end = f".{self._world.engine}{end}"
        bare, against = Source(f"bare {self._label}", "time"), f"bare {self._label} a period"
        both = Source(f"bare {self._label}, and loops", "time")
        ours = Source(f"run_in_process, {self._label}", "time")
        is_at_floor = self._world.engine == "mujoco" and self._world.physics_steps > 1
        bounds = (Bound("ratio", most=1.25),) if is_at_floor else ()
        return [
            Figure(f"in_process.period{end}", "us", ours, both,
                   f"{against}, and eight times JointLoop.step", bounds),
            Figure(f"bridge.step{end}", "us",
                   Source(f"World.step and read, {self._label}", "time"), bare, against),
        ]  # fmt: skip

    def in_process(self) -> Mapping[str, float]:
        """Measure the whole loop: eight joint loops and the world, without a bag."""
        with World(self._world) as world:
            loops = _loops(self._experiment)
            return self._timed(lambda: run_in_process(world, loops, self._periods, _ignore))

    def world_alone(self) -> Mapping[str, float]:
        """Measure the world without loops."""
        efforts = self._efforts()
        with World(self._world) as world:

            def run() -> None:
                for each in efforts:
                    world.step(each)
                    world.read()

            result = self._timed(run)
            self._require_end(world.true_positions())
        return result

    def bare(self) -> Mapping[str, float]:
        """Measure the engine itself."""
        description = RobotDescription.load(self._world.robot_description)
        limits = [joint.effort for joint in description.select(self._world.joints)]
        torques = [
            [min(max(u, -limit), limit) for u, limit in zip(each, limits, strict=True)]
            for each in self._efforts()
        ]
        with ExitStack() as stack:
            make = _bare_mujoco if self._world.engine == "mujoco" else _bare_bullet
            run, places = make(stack, description, self._world, torques)
            result = self._timed(run)
            self._require_end(tuple(places()))
        return result

    def bare_and_loops(self) -> Mapping[str, float]:
        """Measure the engine itself and the loops by themselves, one after the other."""
        loops = _loops(self._experiment)
        stepped = [loop.step for loop in loops]
        self._efforts()

        def run() -> None:
            for sample in self._samples[: self._periods]:
                for step, position in zip(stepped, sample.positions, strict=True):
                    step(sample.stamp_ns, position)

        both = self.bare()["time"] + self._timed(run)["time"]
        return {"time": both, "rate": _MICROSECONDS / both}

    def _efforts(self) -> Efforts:
        """Note once which efforts the loops give, and where they lead."""
        if not self._samples:
            self._samples, self._end = _recorded(self._experiment, self._periods)
        return [sample.efforts for sample in self._samples[: self._periods]]

    def _require_end(self, positions: tuple[float, ...]) -> None:
        if positions != self._end:
            raise RuntimeError(f"another motion than the loop's: {positions}, not {self._end}")

    def _timed(self, run: Callable[[], object]) -> dict[str, float]:
        seconds = time_per_item(run, self._periods)
        period = seconds * _MICROSECONDS
        return {"rate": 1.0 / seconds, "time": period, "step": period / self._world.physics_steps}


def recorded_efforts(experiment: Experiment, periods: int) -> Efforts:
    """Return the efforts that the loops give in each control period, in [N m]."""
    samples, _ = _recorded(experiment, periods)
    return [tuple(sample.efforts) for sample in samples[:periods]]


def _recorded(experiment: Experiment, periods: int) -> tuple[list[Sample], tuple[float, ...]]:
    """Return what the loops saw and gave, and where it led, in [rad]."""
    samples: list[Sample] = []
    with World(experiment.world) as world:
        run_in_process(world, _loops(experiment), periods, samples.append)
        return samples, world.true_positions()


def _loops(experiment: Experiment) -> list[JointLoop]:
    return following_loops(experiment.controllers[LABEL], experiment.trajectory)


def _bare_bullet(
    stack: ExitStack, description: RobotDescription, world: WorldSettings, torques: Efforts
) -> tuple[Callable[[], None], Callable[[], Sequence[float]]]:
    """Return what steps PyBullet through all efforts, and what tells where the joints are."""
    import pybullet

    from hpid_ros.simulation.bullet import BulletPhysics

    physics = BulletPhysics(world, description)
    stack.callback(physics.close)
    client, body, driven = physics.client, physics.body, physics.driven
    steps = range(world.physics_steps)
    set_torques, mode = client.setJointMotorControlArray, pybullet.TORQUE_CONTROL
    step, read = client.stepSimulation, client.getJointStates

    def run() -> None:
        for each in torques:
            for _ in steps:
                set_torques(body, driven, mode, forces=each)
                step()
            read(body, driven)

    return run, lambda: [state[0] for state in read(body, driven)]


def _bare_mujoco(
    stack: ExitStack, description: RobotDescription, world: WorldSettings, torques: Efforts
) -> tuple[Callable[[], None], Callable[[], Sequence[float]]]:
    """Return what steps MuJoCo through all efforts, and what tells where the joints are."""
    physics = MujocoPhysics(world, description)
    stack.callback(physics.close)
    model, data, steps = physics.model, physics.data, world.physics_steps
    positions = [int(model.joint(name).qposadr[0]) for name in world.joints]
    velocities = [int(model.joint(name).dofadr[0]) for name in world.joints]
    step = mujoco.mj_step

    def run() -> None:
        for each in torques:
            data.qfrc_applied[velocities] = each
            step(model, data, steps)
            data.qpos[positions].tolist()

    return run, lambda: data.qpos[positions].tolist()


def _ignore(sample: Sample) -> None:
    """Take a sample and keep nothing of it."""
