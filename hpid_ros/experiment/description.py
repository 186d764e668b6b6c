"""An experiment file, checked as a whole before anything starts."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hpid_ros.base.errors import ExperimentError, TrajectoryError
from hpid_ros.base.names import require_label
from hpid_ros.base.resources import find_resource
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import LoopSettings
from hpid_ros.documents.sections import Section
from hpid_ros.documents.yaml_files import Document, load_document
from hpid_ros.experiment.controllers import controllers_from, judged_from, models_of
from hpid_ros.planning import BrickPlan, planned_reference
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import ENGINES, WorldSettings
from hpid_ros.simulation.world_file import read_world
from hpid_ros.trajectory import JointTrajectory


@dataclass(frozen=True)
class Experiment:
    """One robot, one reference, and the controllers to compare on them."""

    name: str  # name of the experiment
    text: str  # the file as it stands, merged with what it extends
    path: Path  # where it stands
    duration: float  # [s] stamp of the last state
    seed: int  # seed of everything that is drawn by chance
    answer_timeout: float  # [s] wall time that lock-step waits for one answer
    world: WorldSettings  # the simulated robot
    trajectory: JointTrajectory  # the reference of every joint
    controllers: Mapping[str, tuple[LoopSettings, ...]]
    judged: tuple[str, ...]  # the joints that studies and searches look at, in the world's order
    plan: BrickPlan | None = None  # the brick task behind the reference; None for any other kind
    # the files that it was read from: its own, and those that it extends
    files: tuple[Path, ...] = ()
    # whether the file, or who read it, says who computes the physics
    is_engine_chosen: bool = True

    @property
    def engine_note(self) -> str:
        """Who computes the physics, in a line, where nobody chose and it is not the usual one."""
        engine = self.world.engine
        if self.is_engine_chosen or engine == ENGINES[0]:
            return ""
        return f"{engine} computes the physics: PyBullet is not installed (pip install pybullet)"

    @property
    def periods(self) -> int:
        """Control periods of the run; it has one state more."""
        return round(self.duration * NANOSECONDS / self.world.control_period_ns)

    @property
    def end_effector(self) -> str:
        """The link that the task is about: the hand among bricks, else the robot's last link."""
        if self.world.workplace.bricks:
            return self.world.workplace.gripper.link
        return self.description.last_link

    @property
    def description(self) -> RobotDescription:
        """The robot, with all that the file knows better."""
        return RobotDescription.load(self.world.robot_description)

    @property
    def slides(self) -> frozenset[str]:
        """The driven joints that slide: their units are m and N."""
        return self.description.slides.intersection(self.world.joints)

    @property
    def frictions(self) -> dict[str, float]:
        """Coulomb friction of the driven joints, in [N m]."""
        joints = self.description.joints
        return {name: joints[name].friction for name in self.world.joints}

    def are_slides(self, joints: Sequence[str]) -> tuple[bool, ...]:
        """Return of each of these joints whether it slides."""
        slides = self.slides
        return tuple(joint in slides for joint in joints)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that a run of it reads: its own, and the robot's."""
        robot = str(self.world.robot_description)
        return self.files if robot.lstrip().startswith("<") else (*self.files, Path(robot))

    @property
    def digest(self) -> str:
        """SHA-256 of the file, of the robot's and its models' descriptions, as hexadecimal.

        Another engine than PyBullet counts, too: it need not be named in the file.
        """
        digest = hashlib.sha256(self.text.encode())
        digest.update(self.description.xml.encode())
        for model in models_of(self.controllers):
            digest.update(model.encode())
        if self.world.engine != "pybullet":
            digest.update(self.world.engine.encode())
        return digest.hexdigest()


def load_experiment(path: str | Path, engine: str | None = None) -> Experiment:
    """Read an experiment file."""
    document = load_document(path, ExperimentError)
    with document.blaming(ExperimentError):
        root = Section(_with_engine(document.values, engine), "", ExperimentError)
        experiment = _experiment(document, root)
        root.finish()
    return experiment


def load_reference(path: str | Path) -> JointTrajectory:
    """Return the reference of a file: an experiment, or any file with a ``reference`` section."""
    document = load_document(path, ExperimentError)
    with document.blaming(TrajectoryError):
        return planned_reference(
            document.values,
            "reference",
            lambda name: RobotDescription.load(find_resource(name, document.folders)),
        ).trajectory


def _with_engine(values: Any, engine: str | None) -> Any:
    """Return a document in which ``simulation.engine`` is another one."""
    if engine is None or not isinstance(values, Mapping):
        return values
    simulation = values.get("simulation", {})
    if not isinstance(simulation, Mapping):
        return values
    return {**values, "simulation": {**simulation, "engine": engine}}


def _experiment(document: Document, root: Section) -> Experiment:
    world, control, reference = read_world(root, document.folders)
    if reference is None:
        raise ExperimentError("reference is missing")
    duration = root.number("duration", above=0.0, most=1e5)
    _require_before_end(world, reference.plan, duration)
    if round(duration * NANOSECONDS) % world.control_period_ns:
        raise ExperimentError(f"duration {duration} s is not a whole number of control periods")
    return Experiment(
        name=require_label(root.text("name"), root.place("name"), ExperimentError),
        text=document.text,
        path=document.files[0],
        files=document.files,
        duration=duration,
        seed=world.seed,
        answer_timeout=control.answer_timeout,
        world=world,
        trajectory=reference.trajectory,
        plan=reference.plan,
        controllers=controllers_from(root, world),
        judged=judged_from(root, world.joints),
        is_engine_chosen=root.section("simulation", {}).values.get("engine") is not None,
    )


def _require_before_end(world: WorldSettings, plan: BrickPlan | None, duration: float) -> None:
    """Refuse what would happen after the end."""
    moments = [
        *((f"payload[{k}].time", each.time) for k, each in enumerate(world.disturbances.payload)),
        *(
            (f"wrenches[{k}].from", each.start)
            for k, each in enumerate(world.disturbances.wrenches)
        ),
    ]
    for place, moment in moments:
        if moment >= duration:
            raise ExperimentError(
                f"disturbances.{place} {moment:g} s is not before the end, {duration:g} s"
            )
    if plan is not None and plan.duration > duration:
        raise ExperimentError(
            f"duration {duration:g} s ends before the brick task, which takes {plan.duration:g} s"
        )
