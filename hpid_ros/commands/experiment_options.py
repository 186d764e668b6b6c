"""Options that the commands which run experiments have in common."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_ros.resources import find_resource

if TYPE_CHECKING:
    import argparse

    from hpid_ros.experiment.description import Experiment

DEFAULT_EXPERIMENT = "config/experiments/paper.yaml"
"""What runs if no file is named."""


def add_experiment(parser: argparse.ArgumentParser) -> None:
    """Add the experiment's file, which may be left out, to the parser."""
    parser.add_argument(
        "experiment", nargs="?", metavar="FILE", help="experiment file (the paper's comparison)"
    )


def named_experiment(file: str | None) -> Experiment:
    """Return the experiment of a file, or the paper's if none is named.

    Raises:
        SettingError: It cannot be read.
    """
    from hpid_ros.experiment.description import load_experiment

    return load_experiment(file or find_resource(DEFAULT_EXPERIMENT))


def add_joints(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add ``--joint``, which may be repeated, to the parser; ``purpose`` says what for."""
    parser.add_argument("--joint", action="append", default=[], metavar="NAME", help=purpose)


def add_output(parser: argparse.ArgumentParser, default: str) -> None:
    """Add ``--output`` and ``--force`` to the parser; ``default`` is the folder in words."""
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help=f"folder (results/{default}-TIME)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def output_folder(options: argparse.Namespace, name: str) -> Path:
    """Return the folder that ``--output`` names, or ``results/NAME-TIME``."""
    return options.output or Path("results") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
