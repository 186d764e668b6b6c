"""An index of one's own, for every joint of a bag: how long the error stays above a bound.

    python examples/recordings/own_index.py [BAG]

``read_run`` gives arrays; an index is a function of them. To have it in tables and reports, see
*How to add an index* in CONTRIBUTING.md.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from write_bag import write_bag

from hpid_ros.messages.run import read_run

BOUND = 0.05  # [rad]


def time_above(series, bound=BOUND):
    """Return how long a joint is farther than a bound from its reference, in [s]."""
    periods = np.diff(series.state_stamps_ns) * 1e-9
    return float(periods[np.abs(series.error[:-1]) > bound].sum())


def main(bag):
    """Print the index of every joint of a bag."""
    for series in read_run(bag, "run").joints:
        print(f"{series.joint:10} {time_above(series):.3f} s above {BOUND:g} rad")


if len(sys.argv) > 1:
    main(sys.argv[1])
else:
    with TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag")
        main(Path(folder) / "bag")
