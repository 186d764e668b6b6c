"""The error of the base's odometry: ``python -m benchmarks.slip``.

Drives two paths with the linear PID of tracking.yaml, on the floor as it is and on slippery ones,
with finer and coarser physics, and prints the table of docs/base.md.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from hpid_bench.experiment.compare import compute
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import NoProgress, run_without_ros
from hpid_ros.base.errors import SettingError
from hpid_ros.base.resources import find_resource, share_folder
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.metrics.task import BaseFigures

_LABEL = "PID"
_REST = 0.5  # [s] after the path
_WHEELS = {
    "left_wheel": "wheel_left_joint",
    "right_wheel": "wheel_right_joint",
    "wheel_separation": 0.5,
    "wheel_radius": 0.075,
}
_FRICTION = re.compile(r'<lateral_friction value="0\.9"/>')


class Drive(NamedTuple):
    """One path on one floor."""

    name: str  # in a few words
    times: Sequence[float]  # of the poses in [s]
    poses: Sequence[Sequence[float]]  # x [m], y [m], heading [rad]
    directions: Sequence[str]  # of each leg
    steps: int = 4  # physics steps in a control period
    friction: float = 0.9  # of the wheels on the floor


_GENTLE = Drive(
    "gentle",
    (0.0, 3.0, 5.0, 6.5),
    ((0.0, 0.0, 0.0), (0.6, 0.2, 0.6), (0.6, 0.2, -0.4), (0.3, 0.35, -0.4)),
    ("forward", "forward", "backward"),
)
_HARD = Drive(
    "0.8 m in 0.7 s, then 2 rad in 0.8 s",
    (0.0, 0.7, 1.5),
    ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (0.8, 0.0, 2.0)),
    ("forward", "forward"),
)
DRIVES = (
    _GENTLE,
    _GENTLE._replace(name="gentle, 1 step", steps=1),
    _GENTLE._replace(name="gentle, 16 steps", steps=16),
    _GENTLE._replace(name="gentle, wheels' friction 0.3 instead of 0.9", friction=0.3),
    _GENTLE._replace(name="gentle, friction 0.1", friction=0.1),
    _GENTLE._replace(name="gentle, friction 0.05", friction=0.05),
    _HARD,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slip", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.parse_args(arguments)
    print("| | way | slip left, right, sideways | odometry's end against truth |")
    print("|---|---|---|---|")
    for drive in DRIVES:
        with tempfile.TemporaryDirectory(prefix="hpid_slip_") as folder:
            figures = driven(drive, Path(folder))
        mm = [1e3 * s for s in (figures.slip_left, figures.slip_right, figures.slip_lateral)]
        end = figures.odometry
        print(
            f"| {drive.name} | {figures.path_length:.2f} m "
            f"| {mm[0]:.3g}, {mm[1]:.3g}, {mm[2]:.2g} mm "
            f"| {1e3 * end.final_position:.2g} mm, {1e3 * end.final_heading:.2g} mrad |",
            flush=True,
        )
    return 0


def driven(drive: Drive, folder: Path) -> BaseFigures:
    """Return the base's figures of one path."""
    path = folder / "drive.yaml"
    path.write_text(yaml.safe_dump(_document(drive, folder)), encoding="utf-8")
    experiment = load_experiment(path)
    run_without_ros(experiment, _LABEL, folder / "bag", NoProgress())
    return compute(experiment, {_LABEL: folder / "bag"}).base[_LABEL]


def _document(drive: Drive, folder: Path) -> dict[str, Any]:
    file = share_folder() / "config" / "experiments" / "tracking.yaml"
    document: dict[str, Any] = load_yaml(file, SettingError)
    robot = document["robot"]
    urdf = find_resource(robot["description"]).read_text(encoding="utf-8")
    slippery = folder / "robot.urdf"
    wanted = f'<lateral_friction value="{drive.friction}"/>'
    slippery.write_text(_FRICTION.sub(wanted, urdf), encoding="utf-8")
    robot["description"] = str(slippery)
    arm = [joint for joint in document["reference"]["positions"] if joint.startswith("arm")]
    path = {
        "kind": "base_path",
        "base": _WHEELS,
        "times": list(drive.times),
        "poses": [list(pose) for pose in drive.poses],
        "directions": list(drive.directions),
    }
    still = {
        "kind": "minimum_jerk",
        "times": [0.0, drive.times[-1]],
        "positions": {joint: [robot["initial_positions"].get(joint, 0.0)] * 2 for joint in arm},
    }
    document["reference"] = {"kind": "combined", "parts": [path, still]}
    document["duration"] = drive.times[-1] + _REST
    document["simulation"] = {"physics_steps": drive.steps}
    document["compare"] = {_LABEL: {"law": "pid"}}
    return document


if __name__ == "__main__":
    sys.exit(main())
