"""The in-process engine and the simulated robot against bare PyBullet.

Bare means: the same built scene, and for each control period what the same motion cannot do
without: set eight torques and step, once for each physics step (Bullet forgets torques after
every step), then read eight joints. It replays the efforts that the loops gave, so both sides
do the same physics; that they end in the same place, to the bit, is checked each time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.measuring import time_per_item
from benchmarks.tracking import tracking
from hpid_ros.control import JointLoop
from hpid_ros.experiment.description import Experiment
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.bullet.connection import captured, pybullet
from hpid_ros.simulation.bullet.model import bullet_urdf
from hpid_ros.simulation.bullet.scene import build_scene
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.world import World

LABEL = "hPID"

_PERIODS, _PERIODS_QUICK = 3000, 500
_MICROSECONDS = 1e6  # in a second

Efforts = Sequence[Sequence[float]]


def group(quick: bool) -> Group:
    """Return the figures of the engine and of the bridge's physics.

    Args:
        quick: Whether a shorter run will do.
    """
    periods = _PERIODS_QUICK if quick else _PERIODS
    contenders: dict[str, Measure] = {}
    figures: list[Figure] = []
    for steps in (None, 1):
        study = _Study(tracking(steps), periods)
        of = f"{study.world.physics_steps} physics steps"
        end = "" if steps is None else f".steps{steps}"
        contenders |= {
            f"run_in_process, {of}": study.in_process,
            f"World.step and read, {of}": study.world_alone,
            f"bare PyBullet, {of}": study.bare,
        }
        bare, against = f"bare PyBullet, {of}", f"bare PyBullet, {of} a period"
        bounds = (Bound("ratio", least=0.7),) if steps is None else ()
        figures += [
            Figure(f"in_process.rate{end}", "periods/s", Source(f"run_in_process, {of}", "rate"),
                   Source(bare, "rate"), against, bounds),
            Figure(f"bridge.step{end}", "us", Source(f"World.step and read, {of}", "time"),
                   Source(bare, "time"), against),
        ]  # fmt: skip
    return Group(contenders, tuple(figures))


class _Study:
    """One experiment, measured with and without the package around PyBullet.

    Args:
        experiment: The experiment.
        periods: Control periods to run.
    """

    def __init__(self, experiment: Experiment, periods: int) -> None:
        self._experiment, self._periods = experiment, periods
        self.world: WorldSettings = experiment.world
        self._efforts: Efforts = ()
        self._end: tuple[float, ...] = ()

    def in_process(self) -> Mapping[str, float]:
        """Measure the whole loop: eight joint loops and the world, without a bag."""
        with World(self.world) as world:
            loops = _loops(self._experiment)
            return _timed(
                lambda: run_in_process(world, loops, self._periods, _ignore), self._periods
            )

    def world_alone(self) -> Mapping[str, float]:
        """Measure the world without loops."""
        self._record()
        with World(self.world) as world:

            def run() -> None:
                for efforts in self._efforts:
                    world.step(efforts)
                    world.read()

            result = _timed(run, self._periods)
            self._require_end(world.true_positions())
        return result

    def bare(self) -> Mapping[str, float]:
        """Measure PyBullet itself."""
        self._record()
        description = RobotDescription.load(self.world.robot_description)
        with captured():
            client = pybullet.connect(pybullet.DIRECT)
        try:
            scene = build_scene(client, bullet_urdf(description), description, self.world)
            run = _bare_run(client, scene.body, scene.driven, self.world, self._efforts)
            result = _timed(run, self._periods)
            states = pybullet.getJointStates(scene.body, scene.driven, physicsClientId=client)
            self._require_end(tuple(state[0] for state in states))
        finally:
            with captured():
                pybullet.disconnect(physicsClientId=client)
        return result

    def _record(self) -> None:
        """Note once which efforts the loops give, and where they lead."""
        if not self._efforts:
            self._efforts, self._end = recorded_efforts(self._experiment, self._periods)

    def _require_end(self, positions: tuple[float, ...]) -> None:
        if positions != self._end:
            raise RuntimeError(f"another motion than the engine's: {positions}, not {self._end}")


def recorded_efforts(experiment: Experiment, periods: int) -> tuple[Efforts, tuple[float, ...]]:
    """Return the efforts that the loops give in each control period, and where they lead.

    Args:
        experiment: The experiment.
        periods: Control periods to run.

    Returns:
        The efforts of the joints in [N m], and their exact positions in the end, in [rad].
    """
    samples: list[Sample] = []
    with World(experiment.world) as world:
        run_in_process(world, _loops(experiment), periods, samples.append)
        return [tuple(sample.efforts) for sample in samples[:periods]], world.true_positions()


def _loops(experiment: Experiment) -> list[JointLoop]:
    loops = [JointLoop(each) for each in experiment.controllers[LABEL]]
    for loop in loops:
        loop.follow(experiment.trajectory.column(loop.settings.joint))
    return loops


def _bare_run(
    client: int, body: int, driven: Sequence[int], world: WorldSettings, efforts: Efforts
) -> Callable[[], None]:
    limits = [
        joint.effort
        for joint in RobotDescription.load(world.robot_description).select(world.joints)
    ]
    torques = [
        [min(max(u, -limit), limit) for u, limit in zip(each, limits, strict=True)]
        for each in efforts
    ]
    steps = range(world.physics_steps)
    set_torques, mode = pybullet.setJointMotorControlArray, pybullet.TORQUE_CONTROL
    step, read = pybullet.stepSimulation, pybullet.getJointStates

    def run() -> None:
        for each in torques:
            for _ in steps:
                set_torques(body, driven, mode, forces=each, physicsClientId=client)
                step(physicsClientId=client)
            read(body, driven, physicsClientId=client)

    return run


def _timed(run: Callable[[], object], periods: int) -> dict[str, float]:
    seconds = time_per_item(run, periods)
    return {"rate": 1.0 / seconds, "time": seconds * _MICROSECONDS}


def _ignore(sample: Sample) -> None:
    """Take a sample and keep nothing of it."""
