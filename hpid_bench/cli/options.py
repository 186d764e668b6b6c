"""Options that several commands share, and the loops that a file holds."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_bench.experiment.result_folder import system_errors
from hpid_ros.base.errors import ExperimentError, HpidError, SettingError, require_known
from hpid_ros.base.files import write_file
from hpid_ros.base.names import joint_of_controller
from hpid_ros.base.records import Section, take_record
from hpid_ros.base.resources import find_resource
from hpid_ros.base.text import shown
from hpid_ros.base.yaml_files import load_document, load_yaml
from hpid_ros.control.parameter_files import ParameterFile, parameters_from
from hpid_ros.control.settings import LARGEST_EFFORT, LoopSettings
from hpid_ros.metrics.measure import sliding_joints as slides_of_bag
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.robot.description import GivenRobot, RobotDescription
from hpid_ros.robot.dynamics import inertia_ranges
from hpid_ros.robot.joint_description import UNLIMITED
from hpid_ros.robot.loop_settings import on_robot
from hpid_ros.simulation.settings import ENGINES, require_engine
from hpid_ros.stability.gain_check import Loop, judged_inertia
from hpid_ros.stability.margins import LoopFamily, loop_family

DEFAULT_EXPERIMENT = "config/experiments/paper.yaml"  # what runs if no file is named


def chosen_engine(options: argparse.Namespace) -> str | None:
    """Return who is to compute the physics; None as the file says."""
    engine: str | None = options.engine
    if engine is not None:
        require_known("engine", [engine], ENGINES)
        require_engine(engine)
    return engine


def print_engine_note(experiments: Iterable[Experiment]) -> None:
    """Say which engine computes where none was chosen and PyBullet is not installed."""
    for note in dict.fromkeys(each.engine_note for each in experiments):
        if note:
            print(f"hpid: {note}", file=sys.stderr)


def warn_uncontrolled(experiments: Iterable[Experiment]) -> None:
    """Warn of joints without gains: they are driven, and nothing holds them."""
    uncontrolled = dict.fromkeys(
        settings.joint
        for experiment in experiments
        for settings in loops_of(experiment)
        if settings.gains.p == settings.gains.i == settings.gains.d == 0.0
    )
    if uncontrolled:
        print(
            f"hpid: {', '.join(uncontrolled)}: gains p, i and d are 0, the law gives no effort; "
            "hpid gains computes some",
            file=sys.stderr,
        )


def warn_unlimited(robot: RobotDescription, loops: Iterable[LoopSettings]) -> None:
    """Warn of joints that nothing limits, neither the robot's description nor their loops.

    Those are refused whose limit is 0.
    """
    loops = list(loops)
    for settings in loops:
        if settings.joint in robot.joints:
            robot.joints[settings.joint].require_effort(settings)
    unlimited = dict.fromkeys(
        settings.joint
        for settings in loops
        if settings.effort.largest == LARGEST_EFFORT
        and settings.joint in robot.joints
        and math.isinf(robot.joints[settings.joint].effort)
    )
    if unlimited:
        print(
            f"hpid: warning: {', '.join(map(shown, unlimited))}: no effort limit, neither in the "
            "URDF nor as u_clamp_max: nothing says what the motor can give, and a controller with "
            "this URDF does not start",
            file=sys.stderr,
        )


def print_undriven(experiment: Experiment) -> None:
    """Say which joints of an experiment's robot nobody drives."""
    line = experiment.description.undriven(experiment.world.joints)
    if line:
        print(f"hpid: {line}", file=sys.stderr)


def loops_of(experiment: Experiment) -> Iterator[LoopSettings]:
    """Yield the loops of all controllers of an experiment."""
    for loops in experiment.controllers.values():
        yield from loops


def named_experiment(file: str | None, engine: str | None = None) -> Experiment:
    """Return the experiment of a file, or the paper's if none is named."""
    return load_experiment(file or find_resource(DEFAULT_EXPERIMENT), engine)


def experiment_to_run(options: argparse.Namespace) -> Experiment:
    """Return the experiment that the options name, in the engine that they name."""
    experiment = named_experiment(options.experiment, chosen_engine(options))
    require_engine(experiment.world.engine)
    warn_uncontrolled([experiment])
    warn_unlimited(experiment.description, loops_of(experiment))
    print_undriven(experiment)
    return experiment


def output_folder(options: argparse.Namespace, name: str) -> Path:
    """Return the folder that ``--output`` names, or ``results/NAME-TIME``."""
    return options.output or Path("results") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"


@contextmanager
def progress(console: Console, noun: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show how many are done, their rate and the remaining time; nothing to a file."""
    columns = (
        TextColumn(noun, style="bold"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as shown:
        task = shown.add_task("", total=total, rate="", note="")

        def advanced(note: str) -> None:
            shown.advance(task)
            speed = shown.tasks[0].finished_speed or shown.tasks[0].speed
            rate = f"{speed:.2f} {noun}/s" if speed else ""
            shown.update(task, rate=rate, note=note)

        yield advanced


@contextmanager
def joint_progress(
    console: Console, what: str, joints: int, is_logged: bool = False
) -> Iterator[Callable[[Sequence[str]], None]]:
    """Show how many joints are done."""
    with progress(console, "joints", joints) as advanced:
        done = 0

        def note(names: Sequence[str]) -> None:
            nonlocal done
            for name in names:
                done += 1
                advanced(f"{what}: {name}")
                if is_logged and not console.is_terminal:
                    line = f"{what}: {name} ({done} of {joints})"
                    console.print(line, soft_wrap=True)

        yield note


_POSES = 200


def load_robot(name: str) -> GivenRobot:
    """Return the robot of a URDF, of an experiment file or of what ``hpid identify`` wrote."""
    robot = _load_robot(find_resource(name))
    robot.description.require_sound()
    return robot


def _load_robot(file: Path) -> GivenRobot:
    if file.suffix not in (".yaml", ".yml"):
        plain = RobotDescription.load(file)
        return GivenRobot(str(file), plain, initial_positions=plain.start({}))
    identified = identified_robot(file)
    if identified is not None:
        return identified

    experiment = load_experiment(file)
    world, description = experiment.world, experiment.description
    source = str(world.robot_description)
    wheels = tuple(world.base.joints) if world.base is not None else ()
    start = world.initial_positions
    return GivenRobot(source, description, world.fixed_base, start, world.joints, wheels)


def identified_robot(file: Path) -> GivenRobot | None:
    """Return the robot of a file that is no experiment but says of a robot what one would."""
    document = load_document(file, SettingError)
    values = document.values
    if not isinstance(values, Mapping) or "robot" not in values or "compare" in values:
        return None
    with document.blaming(SettingError):
        section = Section(values["robot"], "robot", SettingError)
        robot = take_record(RobotSection, section)
        section.finish()
        known = robot.load(
            lambda name: RobotDescription.load(find_resource(name, document.folders))
        )
    start = known.start(robot.initial_positions)
    return GivenRobot(known.xml, known, robot.fixed_base, start)


def write_output(path: Path, content: str | bytes) -> None:
    with system_errors(f"cannot write {path}", SettingError):
        write_file(path, content)


InertiaPair = tuple[float, float]


def inertias_from(
    options: argparse.Namespace, joints: Sequence[str], poses: Sequence[Mapping[str, float]] = ()
) -> dict[str, InertiaPair]:
    """Return the least and the largest inertia that the options say, by joint."""
    of_all, said = _given(options.inertia)
    of_one: dict[str, InertiaPair] = {}
    for each in (text for texts in options.inertia for text in texts if _is_file(text)):
        in_file = _of_file(Path(each))
        of_one |= {joint: in_file[joint] for joint in joints if joint in in_file}
    of_one |= said
    require_known("joint in --inertia", of_one, joints)
    if of_all and options.urdf:
        raise SettingError(
            "--inertia takes JOINT=M or JOINT=LOW:HIGH with --urdf, which says that of the others"
        )
    if of_all:
        found = dict.fromkeys(joints, of_all)
    elif options.urdf:
        asked = [joint for joint in joints if joint not in of_one]
        found = _of_robot(options, asked, poses) if asked else {}
    else:
        found = {}
    found |= of_one
    for joint, (low, high) in found.items():
        if not 0.0 < low <= high < math.inf:
            raise SettingError(
                f"the inertia of {joint!r} must be positive and finite, its least value not above "
                f"its largest, not {low:g} to {high:g} kg m^2"
            )
    return found


def _given(inertias: Sequence[Sequence[str]]) -> tuple[InertiaPair | None, dict[str, InertiaPair]]:
    """Return what ``--inertia`` says of all joints, and of single ones."""
    numbers: list[float] = []
    of_one: dict[str, InertiaPair] = {}
    for text in (each for texts in inertias for each in texts if not _is_file(each)):
        joint, is_named, value = text.rpartition("=")
        try:
            found = [float(each) for each in (value.split(":") if is_named else [value])]
        except ValueError:
            found = []
        if len(found) not in (1, 2) or (is_named and not joint):
            raise SettingError(
                f"--inertia takes M, LOW HIGH, JOINT=M or JOINT=LOW:HIGH, not {text!r}"
            )
        if is_named:
            of_one[joint] = (found[0], found[-1])
        else:
            numbers += found
    if len(numbers) > 2:
        raise SettingError(
            f"--inertia takes one number, or the least and the largest, not {len(numbers)}"
        )
    return ((numbers[0], numbers[-1]) if numbers else None), of_one


def _is_file(text: str) -> bool:
    return text.endswith((".yaml", ".yml"))


def _of_file(file: Path) -> dict[str, InertiaPair]:
    """Return the inertias that a file's ``controllers`` section has, by joint."""
    values = load_document(file, SettingError).values
    try:
        joints = values["controllers"]["joints"]
        found = {
            name: float(each["inertia"]) for name, each in joints.items() if "inertia" in each
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        found = {}
    if not found:
        raise SettingError(f"--inertia {file}: it has no controllers.joints.JOINT.inertia")
    return {name: (value, value) for name, value in found.items()}


def _of_robot(
    options: argparse.Namespace, joints: Sequence[str], poses: Sequence[Mapping[str, float]]
) -> dict[str, InertiaPair]:
    wanted = _POSES if options.poses is None else options.poses
    try:
        robot = load_robot(options.urdf)
        if poses and options.poses is None:
            known = [{**robot.initial_positions, **pose} for pose in poses]
            return inertia_ranges(robot.description, joints, options.payload, known)
        return inertia_ranges(robot.description, joints, options.payload, wanted)
    except ExperimentError:  # names the file itself
        raise
    except HpidError as error:
        raise SettingError(f"{options.urdf}: {error}") from None


def parameter_file(path: Path) -> ParameterFile:
    """Read a file of controllers' parameters; say what of ros2_control's own is not taken."""
    return _with_remarks(parameters_from(load_yaml(path, SettingError), str(path)))


def _with_remarks(file: ParameterFile) -> ParameterFile:
    for line in file.remarks:
        print(f"hpid: {shown(line)}", file=sys.stderr)
    return file


def loop_file(path: Path) -> tuple[Experiment | None, ParameterFile]:
    """Read a file of loops: those of an experiment have the names of their controllers."""
    document = load_document(path, SettingError).values
    if not isinstance(document, Mapping) or "compare" not in document:
        return None, _with_remarks(parameters_from(document, str(path)))
    experiment = load_experiment(path)
    loops = {
        f"{label} {each.joint}": each
        for label, settings in experiment.controllers.items()
        for each in settings
    }
    return experiment, ParameterFile(loops, {})


def require_controller(experiment: Experiment | None, label: str, file: Path) -> None:
    if experiment is None:
        raise SettingError(f"--controller is for experiments, and {file} is none")
    require_known("controller", [label], experiment.controllers)


def first_homogeneous(experiment: Experiment) -> tuple[LoopSettings, ...]:
    """Return the loops of the first homogeneous controller, or else of the first."""
    controllers = list(experiment.controllers.values())
    homogeneous = [each for each in controllers if any(loop.is_homogeneous for loop in each)]
    return (homogeneous or controllers)[0]


class JointPlants(NamedTuple):
    """What margins need to know of a robot's joints beside their inertia."""

    friction: Mapping[str, float] = {}  # [N m s/rad] viscous, by joint; 0 for others
    delays: Mapping[str, float] = {}  # [s] of the drives, by joint; 0 for others
    has_velocities: bool = True  # whether the states have them

    @classmethod
    def of(cls, experiment: Experiment) -> JointPlants:
        world = experiment.world
        period = world.control_period_ns * 1e-9
        return cls(
            viscous_frictions(experiment.description),
            {
                joint: drive.delay * period
                for joint, drive in zip(world.joints, world.drives, strict=False)
            },
            world.velocity != "none",
        )

    def family(
        self,
        settings: LoopSettings,
        inertia: InertiaPair,
        delay: float,
        largest_norm: float | None = None,
    ) -> LoopFamily:
        """Return the frozen loops of a joint; ``delay`` comes on top of its drive's, in [s]."""
        if settings.velocity.is_measured and not self.has_velocities:
            # nothing measures it: the controller filters differences
            settings = settings.with_parameters({"velocity_source": "filtered"})
        joint = settings.joint
        delay += self.delays.get(joint, 0.0)
        return loop_family(settings, inertia, self.friction.get(joint, 0.0), delay, largest_norm)


def viscous_frictions(robot: RobotDescription) -> dict[str, float]:
    """Return the viscous friction of a robot's joints, in [N m s/rad]."""
    return {name: joint.damping for name, joint in robot.joints.items()}


def shown_name(name: str) -> str:
    """Return a loop's name as tables have it."""
    space, mark, node = name.strip("/").rpartition("/")
    return f"{space}{mark}{joint_of_controller(node)}"


def judged_loops(
    options: argparse.Namespace, file: ParameterFile, experiment: Experiment | None
) -> list[Loop]:
    """Return loops with the inertias to judge them on; warn of those that nothing limits.

    With a robot they are judged as a controller runs them on it.
    """
    loops = list(file.loops.values())
    if options.urdf:
        robot = load_robot(options.urdf)
        warn_unlimited(robot.description, loops)
        limits = robot.description.joints
        loops = [on_robot(each, limits.get(each.joint, UNLIMITED), robot.source) for each in loops]
    elif experiment is not None:
        warn_unlimited(experiment.description, loops)
    known = {**file.inertias, **inertias_from(options, [each.joint for each in loops])}
    return [(each, judged_inertia(each, known.get(each.joint))) for each in loops]


def sliding_joints_from(
    options: argparse.Namespace, experiment: Experiment | None
) -> frozenset[str]:
    """Return the joints that slide: by ``--urdf``, the experiment's robot, or ``--bag``."""
    if options.urdf:
        return load_robot(options.urdf).description.slides
    if experiment is not None:
        return experiment.slides
    bag = getattr(options, "bag", None)
    if bag is None:
        return frozenset()

    return slides_of_bag(bag, None).slides
