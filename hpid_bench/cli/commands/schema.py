"""``hpid schema``: the JSON Schema of experiment files."""

from __future__ import annotations

import argparse
import json

from hpid_bench.cli.commands import DONE
from hpid_bench.experiment.description import experiment_schema


def run(options: argparse.Namespace) -> int:
    print(json.dumps(experiment_schema(), indent=2))
    return DONE
