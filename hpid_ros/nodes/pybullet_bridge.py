"""Stands in for the robot, in PyBullet: efforts in, joint states out."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hpid_ros.nodes.core import executor
from hpid_ros.nodes.parts.bridge import make_nodes, usage

USAGE = usage("pybullet_bridge", "PyBullet")


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: make_nodes("pybullet"), args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
