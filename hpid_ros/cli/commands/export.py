"""``hpid export``: the loop of each joint as source for a microcontroller."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_output, write_file
from hpid_ros.cli.commands import DONE
from hpid_ros.cli.options import (
    add_joints,
    first_homogeneous,
    loop_file,
    require_controller,
    require_joints,
)

if TYPE_CHECKING:
    from hpid_ros.control.settings import LoopSettings


_PRECISIONS = ("double", "single")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "export",
        description="Write the loop of each joint as self-contained C99: a header and a source "
        "with law, norm, limits, anti-windup and velocity filter, and a program that replays "
        "what Python answers to a thousand states and prints the largest deviation.",
        epilog="docs/export.md says what the C code holds and what stays with the node.",
    )
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="parameter file of controllers, or experiment"
    )
    parser.add_argument("--c", action="store_true", required=True, help="in C99")
    add_joints(parser, "export this joint; may be repeated (all)")
    parser.add_argument(
        "--controller",
        metavar="LABEL",
        help="of an experiment (its first with a homogeneous loop)",
    )
    parser.add_argument(
        "--precision",
        choices=_PRECISIONS,
        default="double",
        help="of the numbers (double); a macro in the header can say another",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder to write into"
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Export, then write: all files or, where one cannot be, none."""
    from hpid_ros.tuning.c_export import c_files, require_distinct

    loops = _chosen(_loops(options.file, options.controller), options.joint)
    require_distinct([each.joint for each in loops])
    _refuse_in_the_way(options, loops)
    files = [c_files(each, options.precision, options.file.name) for each in loops]
    for each in files:
        for name, text in each.items():
            _write(options.output / name, text)
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
    from hpid_ros.tuning.c_export import file_names

    folder: Path = options.output
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder} is no folder; name one with -o")
    for loop in loops:
        for name in file_names(loop.joint):
            refuse_output(folder / name, force=options.force, inputs=[options.file], option="-o")


def _write(path: Path, text: str) -> None:
    try:
        write_file(path, text)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot write {path}: {reason}") from None
