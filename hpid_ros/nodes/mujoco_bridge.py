"""Stands in for the robot, in MuJoCo: efforts in, joint states out."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hpid_ros.nodes.core import executor
from hpid_ros.nodes.parts.bridge import make_nodes, usage

USAGE = usage("mujoco_bridge", "MuJoCo")


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: make_nodes("mujoco"), args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
