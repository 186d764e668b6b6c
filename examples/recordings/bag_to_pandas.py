"""Every joint of a bag as a pandas table: time, position, reference, error, effort.

    python examples/recordings/bag_to_pandas.py [BAG]

The package does without pandas; where it is missing the columns are shown as they are.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from write_bag import write_bag

from hpid_ros.messages.run import read_run


def columns(series):
    """Return one joint's columns; the effort is that of the command in force at each state."""
    stamps_ns = series.state_stamps_ns
    last = np.searchsorted(series.command_stamps_ns, stamps_ns, side="right") - 1
    found = {
        "time": (stamps_ns - stamps_ns[0]) * 1e-9,
        "position": series.position,
        "effort": np.append(series.effort, np.nan)[last],  # none yet: place -1
    }
    if series.has_reference:
        found |= {"reference": series.reference, "error": series.error}
    return found


def main(bag):
    """Print what each joint's table says at its end."""
    joints = {each.joint: columns(each) for each in read_run(bag, "run").joints}
    try:
        import pandas
    except ImportError:
        print("pandas is not installed (pip install pandas): the columns as NumPy has them")
        for joint, found in joints.items():
            last = ", ".join(f"{name} {values[-1]:.4g}" for name, values in found.items())
            print(f"{joint:10} {len(found['time'])} rows, the last: {last}")
        return
    tables = {joint: pandas.DataFrame(found) for joint, found in joints.items()}
    print(pandas.concat(tables, names=["joint", "row"]).groupby("joint").tail(2))


if len(sys.argv) > 1:
    main(sys.argv[1])
else:
    with TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag")
        main(Path(folder) / "bag")
