"""The effect of one controller's end on the others: ``python -m benchmarks.faults [--minutes M]``.

Runs eight controllers in lock-step for M minutes of simulated time, in episodes. At random one of
them is killed and restarted, ended and restarted, or frozen and thawed. Each episode is compared
with the undisturbed run of the same experiment. Exit codes: 0 all bounds kept, 1 one was not, 2
unusable arguments, 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.episodes import Episode, run_episode, sines, undisturbed
from benchmarks.processes import FAILED, exit_code
from hpid_ros.base.errors import SettingError

EPISODE = 30.0  # [s] of simulated time
_HEADER = (
    " episode  faults  states  others [rad]  settled [rad]  takeover [N m]  longest cycle [s]"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as long as the arguments say and print what came of it."""
    options = _parser().parse_args(arguments)

    def run() -> int:
        if not options.minutes > 0.0:
            raise SettingError(f"--minutes must be positive, not {options.minutes:g}")
        with tempfile.TemporaryDirectory(prefix="hpid_faults_") as name:
            return _run(Path(name), options.minutes, options.seed)

    return exit_code("faults", run)


def _run(folder: Path, minutes: float, seed: int) -> int:
    length = min(EPISODE, 60.0 * minutes)
    episodes = max(1, round(60.0 * minutes / length))
    experiment = sines(folder, length)
    calm = undisturbed(experiment)
    results: list[Episode] = []
    print(_HEADER)
    for number in range(episodes):
        place = folder / f"episode_{number}"
        result = run_episode(experiment, calm, place, seed + number)
        results.append(result)
        print(
            f"{number + 1:8d}{len(result.faults):8d}{result.states:8d}{result.others:14.4f}"
            f"{result.unsettled:15.4f}{result.takeover:16.3f}{result.longest_cycle:19.3f}",
            flush=True,
        )
        for line in result.broken():
            print(f"         not kept: {line}", flush=True)
    faults = [fault for result in results for fault in result.faults]
    counts = Counter(fault.kind for fault in faults)
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))
    print(f"{len(faults)} faults ({kinds}) in {episodes * length / 60.0:g} min of simulated time")
    return FAILED if any(result.broken() for result in results) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="of simulated time, 10 if not given"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    return parser


if __name__ == "__main__":
    sys.exit(main())
