"""Robots of others in both engines: ``python -m benchmarks.foreign_robots FOLDER|URDF ...``.

Of each URDF it prints a row: what was mended when it was loaded, what cannot be used and why, and
how far the totals of the two engines are from each other. On a fixed base every joint that mimics
none follows a quintic over a part of its range, under a PID with gravity compensation whose gains
are those of its inertia at the start; joints that mimic or that
nothing drives are held. Meshes are not needed.
"""

from __future__ import annotations

import argparse
import logging
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import yaml

from hpid_bench.experiment.batch import RunTask, WorldKeeper, simulate_task
from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.errors import HpidError
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.robot.amendments import amended
from hpid_ros.robot.description import UNDRIVABLE_TYPES, RobotDescription, listed
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.simulation.settings import ENGINES

AGREE = 0.01  # of a total

_RATE = 1000.0  # [Hz]
_DURATION = 1.0  # [s]
_SHARE, _MOST = 0.1, 0.2  # of the range, and [rad] or [m] at most, that a joint moves
_BANDWIDTH = 12.0  # [rad/s] of the loops
_INDICES = ("ivc", "itae")


class Row(NamedTuple):
    """What came of one robot."""

    name: str
    links: int
    joints: int  # that are driven
    mends: tuple[str, ...]
    refusal: str  # empty where both engines ran
    differences: tuple[float, ...]  # of each total of MuJoCo from PyBullet's, relative

    @property
    def agrees(self) -> bool:
        return not self.refusal and all(abs(each) <= AGREE for each in self.differences)


def tried(path: Path) -> Row:
    """Run a robot in both engines."""
    name, links, joints = str(path), 0, 0
    mends: tuple[str, ...] = ()
    try:
        description = RobotDescription.load(path)
        mends = tuple(f"{listed(each.names, 3)}: {each.text}" for each in description.mends)
        links = len(description.links)
        held = _mimics(description)
        moving = [joint for each, joint in description.joints.items() if each not in held]
        joints = len(moving)
        totals = [_totals(path, description, moving, held, engine) for engine in ENGINES]
    except HpidError as error:
        return Row(name, links, joints, mends, str(error), ())
    differences = tuple(
        mujoco / bullet - 1.0 if bullet else math.inf
        for bullet, mujoco in zip(*totals, strict=True)
    )
    return Row(name, links, joints, mends, "", differences)


def _mimics(description: RobotDescription) -> dict[str, float]:
    robot = ElementTree.fromstring(description.xml)
    start = description.start({})
    return {
        name: start.get(name, 0.0)
        for element in robot.findall("joint")
        if (name := element.get("name", "")) not in description.held
        and (
            (element.find("mimic") is not None and name in description.joints)
            or element.get("type") in UNDRIVABLE_TYPES
        )
    }


def _totals(
    path: Path,
    description: RobotDescription,
    joints: Sequence[JointDescription],
    held: dict[str, float],
    engine: str,
) -> list[float]:
    names = [joint.name for joint in joints]
    stiff = amended(description, {}, {}, held)
    start = {name: at for name, at in stiff.start({}).items() if name in names}
    inertias = Dynamics(stiff).joint_inertias(names, start)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.yaml"
        document = _document(path.resolve(), joints, held, start, inertias)
        file.write_text(yaml.safe_dump(document, sort_keys=False))
        experiment = load_experiment(file, engine)
        with WorldKeeper() as keeper:
            run = simulate_task(RunTask.of(experiment, "PID"), keeper)
    overall = run_indices(run).totals
    return [float(overall[key]) for key in _INDICES]


def _document(
    path: Path,
    joints: Sequence[JointDescription],
    held: dict[str, float],
    start: dict[str, float],
    inertias: dict[str, float],
) -> dict[str, Any]:
    w = _BANDWIDTH
    positions: dict[str, list[float]] = {}
    gains: dict[str, dict[str, Any]] = {}
    for joint in joints:
        at, inertia = start.get(joint.name, 0.0), inertias[joint.name]
        room = min(_SHARE * (joint.upper - joint.lower), _MOST)
        end = at + (room if at + room <= joint.upper else -room)
        positions[joint.name] = [at, end, end]
        pid = {"p": 3.0 * w**2 * inertia, "i": 0.2 * w**3 * inertia, "d": 3.0 * w * inertia}
        gains[joint.name] = {"gains": pid}
        if joint.has_zero_effort:
            gains[joint.name] |= {"u_clamp_max": 1e3, "u_clamp_min": -1e3}
    times = [0.0, 0.7 * _DURATION, _DURATION]
    return {
        "name": "foreign",
        "robot": {
            "description": str(path),
            "fixed_base": True,
            "held": held,
            "initial_positions": start,
        },
        "control": {"rate": _RATE},
        "duration": _DURATION,
        "reference": {"kind": "minimum_jerk", "times": times, "positions": positions},
        "controllers": {"common": {"compensation": "gravity"}, "joints": gains},
        "compare": {"PID": {"law": "pid"}},
    }


def urdfs(places: Sequence[Path]) -> Iterator[Path]:
    """Yield files, and of folders all URDFs in them."""
    for place in places:
        if place.is_dir():
            yield from sorted(place.rglob("*.urdf"))
        else:
            yield place


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("places", nargs="+", type=Path, metavar="FOLDER|URDF")
    options = parser.parse_args()
    logging.disable(logging.WARNING)  # the rows say it
    print("| robot | links | joints | mended | IVC, ITAE: MuJoCo over PyBullet |")
    print("|---|---|---|---|---|")
    rows = []
    for path in urdfs(options.places):
        row = tried(path)
        rows.append(row)
        shown = row.refusal or ", ".join(f"{each:+.3%}" for each in row.differences)
        mends = "; ".join(row.mends) or "-"
        print(f"| {row.name} | {row.links} | {row.joints} | {mends} | {shown} |", flush=True)
    ran = sum(not row.refusal for row in rows)
    agree = sum(row.agrees for row in rows)
    print(f"\n{len(rows)} robots, {ran} run in both engines, {agree} agree within {AGREE:.0%}")
    return 0 if agree == len(rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
