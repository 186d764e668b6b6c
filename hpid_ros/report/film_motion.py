"""What moved where in a recorded run: placements of all that is drawn, at given instants.

Positions are replayed, not simulated: each joint stands where it was measured, the base and bricks
where the simulation reported them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.base.yaml_files import load_document
from hpid_ros.messages.messages import read_planar, read_poses
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import RunSeries, seconds_since
from hpid_ros.metrics.measure import RESULT, Source, expanded
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import integrated
from hpid_ros.robot.kinematics import LinkPoses, axis_rotations, link_poses
from hpid_ros.robot.shapes import Body, Shape
from hpid_ros.simulation.gripper import BRICK_POSES
from hpid_ros.simulation.reports import TRUTH
from hpid_ros.simulation.settings import Support, WorldSettings
from hpid_ros.simulation.world_file import world_of

_ENGINES = "engines.json"


class Recorded(NamedTuple):
    """Runs and their world."""

    world: WorldSettings
    runs: tuple[RunSeries, ...]  # the runs, in the result's order
    bags: dict[str, Path]  # the recording of each, by label


def recorded(result: Path, labels: Sequence[str] = ()) -> Recorded:
    """Return the runs of a result."""
    bags = _bags(result)
    for label in labels:
        if label not in bags:
            raise SettingError(f"{result}: {unknown_name('run', label, bags)}")
    chosen = {label: bags[label] for label in labels or bags}
    world = _world(result / "nodes" / next(iter(chosen)) / "world.yaml")
    selection = BagSelection(joints=world.joints)
    runs = tuple(read_run(bag, label, selection=selection) for label, bag in chosen.items())
    return Recorded(world, runs, chosen)


def _bags(result: Path) -> dict[str, Path]:
    if (result / _ENGINES).is_file():
        raise SettingError(f"{result} is of several engines: name one of its folders")
    if not (result / RESULT).is_file():
        raise SettingError(f"{result} is no result folder: it has no {RESULT}")
    sources = expanded(Source(result))
    if any(each.is_saved for each in sources):
        raise SettingError(f"{result} has no recordings any more, or other labels than theirs")
    return {each.label or each.path.name: each.path for each in sources}


def _world(file: Path) -> WorldSettings:
    document = load_document(file, SettingError)
    return world_of(document.values, document).world


_UP = np.array([0.0, 0.0, 1.0])
_SUPPORT, _BRICK = (0.86, 0.87, 0.90), (0.70, 0.28, 0.20)


class Motion(NamedTuple):
    """A run at N instants; a placement is x y z in [m] and a unit quaternion x y z w."""

    robot: Numbers  # placements of the robot's K shapes, (N, K, 7)
    wanted: Numbers | None  # the same where every joint is at its reference
    boxes: Numbers  # placements of supports, then bricks, (N, B, 7)


class Stand(NamedTuple):
    """A robot and what is drawn of it."""

    world: WorldSettings  # the world in which it ran
    description: RobotDescription  # the robot
    shapes: tuple[Shape, ...]

    @property
    def boxes(self) -> list[Body]:
        """Supports, then bricks, as bodies."""
        place = self.world.workplace
        return [
            *(Body("box", each.size, _SUPPORT) for each in place.supports),
            *(Body("box", each.size, _BRICK) for each in place.bricks),
        ]


def motion_of(stand: Stand, run: RunSeries, bag: Path, instants: Numbers) -> Motion:
    """Return where everything was."""
    count = len(instants)
    robot = _placements(
        stand, _columns(run, "position", instants), _true_base(stand, run, bag, instants), count
    )
    wanted = None
    if all(series.has_reference for series in run.joints):
        base = _wanted_base(stand, run, instants)
        wanted = _placements(stand, _columns(run, "reference", instants), base, count)
    return Motion(robot, wanted, _boxes(stand, run, bag, instants))


def _columns(run: RunSeries, what: str, instants: Numbers) -> dict[str, Numbers]:
    """Return what was measured or wanted of each joint at the instants, in [rad]."""
    return {
        each.joint: np.interp(
            instants, seconds_since(each.state_stamps_ns, run.start_ns), getattr(each, what)
        )
        for each in run.joints
    }


def _placements(
    stand: Stand, columns: Mapping[str, Numbers], base: Numbers | None, count: int
) -> Numbers:
    """Return the placements of the shapes for the joints' positions and the base's poses."""
    still = stand.world.initial_positions
    known = stand.description.joints
    positions = {name: np.full(count, still[name]) for name in still if name in known}
    poses = link_poses(stand.description, positions | dict(columns), count)
    rows = [_on_base(_of_shape(poses[each.link], each), base) for each in stand.shapes]
    return np.stack([_row(each) for each in rows], axis=1)


def _of_shape(pose: LinkPoses, shape: Shape) -> LinkPoses:
    return LinkPoses(
        pose.positions + pose.rotations @ shape.position, pose.rotations @ shape.rotation
    )


def _on_base(pose: LinkPoses, base: Numbers | None) -> LinkPoses:
    """Return poses in the world; those of the base are x [m], y [m] and heading [rad], (N, 3)."""
    if base is None:
        return pose
    x, y, heading = base.T
    turns = axis_rotations(_UP, heading)
    positions = np.column_stack([x, y, np.zeros_like(x)])
    return LinkPoses(
        positions + np.einsum("nij,nj->ni", turns, pose.positions), turns @ pose.rotations
    )


def _row(pose: LinkPoses) -> Numbers:
    return np.hstack([pose.positions, Rotation.from_matrix(pose.rotations).as_quat()])


def _true_base(stand: Stand, run: RunSeries, bag: Path, instants: Numbers) -> Numbers | None:
    if stand.world.base is None or stand.world.fixed_base:
        return None
    truth = read_planar(bag, TRUTH)
    return _sampled(instants, seconds_since(truth.stamps_ns, run.start_ns), truth.poses)


def _wanted_base(stand: Stand, run: RunSeries, instants: Numbers) -> Numbers | None:
    """Return where the base would be if its wheels followed their references and did not slip."""
    base, series = stand.world.base, {each.joint: each for each in run.joints}
    if base is None or stand.world.fixed_base or not set(base.joints) <= set(series):
        return None
    left, right = (series[wheel] for wheel in base.joints)
    poses = integrated(
        base,
        *(np.concatenate((each.position[:1], each.reference)) for each in (left, right)),
    )[1:]
    return _sampled(instants, seconds_since(left.state_stamps_ns, run.start_ns), poses)


def _sampled(instants: Numbers, times: Numbers, rows: Numbers) -> Numbers:
    return np.column_stack([np.interp(instants, times, column) for column in rows.T])


def _boxes(stand: Stand, run: RunSeries, bag: Path, instants: Numbers) -> Numbers:
    place, count = stand.world.workplace, len(instants)
    still = [_standing(each, count) for each in (*place.supports, *place.bricks)]
    placements = np.stack(still, axis=1) if still else np.zeros((count, 0, 7))
    reported = read_poses(bag, BRICK_POSES) if place.bricks else None
    if reported is not None:
        when = run.start_ns + np.round(instants * NANOSECONDS).astype(np.int64)
        at = np.searchsorted(reported.stamps_ns, when).clip(0, len(reported.stamps_ns) - 1)
        bricks = np.concatenate([reported.positions, reported.orientations], axis=2)
        placements[:, len(place.supports) :] = bricks[at]
    return placements


def _standing(box: Support, count: int) -> Numbers:
    return np.tile([*box.position, *box.orientation], (count, 1))


def corners(bodies: Sequence[Body], placements: Numbers) -> Numbers:
    """Return points that enclose bodies wherever they are, (M, 3), in [m]."""
    points: Iterable[Numbers] = (
        place[:, None, :3] + _turned(place[:, 3:], _half_edges(body))
        for body, place in zip(bodies, placements.swapaxes(0, 1), strict=True)
    )
    return np.concatenate([each.reshape(-1, 3) for each in points])


_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_MESH = 0.08
"""Half an edge of what a mesh is taken to fill, in [m]: its file is the engine's to read."""


def _half_edges(body: Body) -> Numbers:
    if body.form == "box":
        return np.array(body.size) / 2.0
    if body.form == "sphere":
        return np.full(3, body.size[0])
    if body.form == "cylinder":
        radius, length = body.size
        return np.array([radius, radius, length / 2.0])
    return np.full(3, _MESH)


def _turned(quaternions: Numbers, half: Numbers) -> Numbers:
    """Return the eight corners of a box as it is turned, (N, 8, 3)."""
    turns = Rotation.from_quat(quaternions).as_matrix()
    return np.asarray(np.einsum("nij,cj->nci", turns, _SIGNS * half))
