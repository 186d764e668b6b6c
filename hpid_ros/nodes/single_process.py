"""The simulated robot and all its controllers in one process, on the same nodes and topics."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from hpid_ros.base.records import Record, names_of, quantity
from hpid_ros.nodes import joint_controllers
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.parts import bridge
from hpid_ros.simulation.settings import ENGINES, default_engine


@dataclass(frozen=True)
class ProcessParameters(Record):
    """What else runs in this process."""

    engine: str = quantity(
        f"Physics engine of the bridge: {', '.join(ENGINES)}", default=ENGINES[0], choices=ENGINES
    )


def make_nodes() -> list[executor.ClosingNode]:
    """Make the bridge, one controller for each joint of ``joint_controllers``, and a recorder.

    Nodes are closed in this order.
    """
    process = executor.ClosingNode("single_process")
    asked = read(process, ProcessParameters, engine=default_engine())
    robot, *recorder = bridge.make_nodes(asked.engine)
    return [process, robot, *joint_controllers.make_nodes(), *recorder]


USAGE = Usage(
    "single_process",
    "Runs a bridge and joint_controllers in one process; "
    "their --help tells their parameters, topics and services.",
    "--params-file FILE",
    names_of(ProcessParameters),
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(make_nodes, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
