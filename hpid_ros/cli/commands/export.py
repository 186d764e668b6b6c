"""``hpid export``: the loop of each joint as source for a microcontroller."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_output
from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import (
    first_homogeneous,
    loop_file,
    require_controller,
    require_joints,
    write_output,
)
from hpid_ros.control.settings import LoopSettings
from hpid_ros.tuning.c_export import c_files, file_names, require_distinct


def run(options: argparse.Namespace) -> int:
    """Export, then write: all files or, where one cannot be, none."""
    loops = _chosen(_loops(options.file, options.controller), options.joint)
    require_distinct([each.joint for each in loops])
    _refuse_in_the_way(options, loops)
    files = [c_files(each, options.precision, options.file.name) for each in loops]
    for each in files:
        for name, text in each.items():
            write_output(options.output / name, text)
    for loop, each in zip(loops, files, strict=True):
        header, source, *_, test = each
        print(f"{loop.joint}: {header}, {source}; to check it: {test}")
    print(f"written: {options.output}")
    return DONE


def _loops(file: Path, label: str | None) -> Sequence[LoopSettings]:
    """Return the loops of one controller."""
    experiment, parameters = loop_file(file)
    if label is not None:
        require_controller(experiment, label, file)
    if experiment is None:
        return list(parameters.loops.values())
    return experiment.controllers[label] if label else first_homogeneous(experiment)


def _chosen(loops: Sequence[LoopSettings], joints: Sequence[str]) -> list[LoopSettings]:
    """Return the loops of the joints that are named, or all if none is."""
    require_joints(joints, loops)
    return [each for each in loops if not joints or each.joint in joints]


def _refuse_in_the_way(options: argparse.Namespace, loops: Sequence[LoopSettings]) -> None:
    """Refuse a folder that is none, and files that are there."""
    folder: Path = options.output
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder} is no folder; name one with -o")
    for loop in loops:
        for name in file_names(loop.joint):
            refuse_output(folder / name, force=options.force, inputs=[options.file], option="-o")
