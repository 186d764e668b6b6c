"""``hpid schema``: the JSON Schema of experiment files."""

from __future__ import annotations

import argparse
import json
from typing import Any

from hpid_ros.cli.commands import DONE

_EXAMPLES = """\
examples:
  hpid schema > experiment.schema.json

An editor with a YAML language server completes and checks a file whose first
line is
  # yaml-language-server: $schema=experiment.schema.json
"""


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "schema",
        description="Print the JSON Schema (draft 2020-12) with which editors complete and\n"
        "check experiment files.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Print the schema."""
    from hpid_ros.experiment.description import experiment_schema

    print(json.dumps(experiment_schema(), indent=2))
    return DONE
