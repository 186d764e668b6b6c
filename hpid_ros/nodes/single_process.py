"""The simulated robot and all its controllers in one process, on the same nodes and topics."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hpid_ros.nodes import joint_controllers
from hpid_ros.nodes.bag_recorder import BagRecorder
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.process import read_choice, read_only
from hpid_ros.nodes.parts.bridge import RobotBridge
from hpid_ros.simulation.settings import ENGINES, default_engine


class SingleProcess(executor.ClosingNode):
    """Says whether this process also records."""

    def __init__(self) -> None:
        super().__init__("single_process")
        self.records: bool = read_only(
            self, "record", False, "Run bag_recorder in this process too, with its parameters"
        )
        text = f"Of the bridge: {', '.join(ENGINES)}"
        self.engine = read_choice(self, "engine", default_engine(), text, ENGINES)


def make_nodes() -> list[executor.ClosingNode]:
    """Make the bridge, one controller for each joint of ``joint_controllers``, and a recorder."""
    process = SingleProcess()
    nodes = [process, RobotBridge(process.engine), *joint_controllers.make_nodes()]
    # The last to be closed: it keeps what the others still say.
    return [*nodes, BagRecorder()] if process.records else nodes


USAGE = Usage(
    "single_process",
    "Runs a bridge and joint_controllers in one process, with record also bag_recorder; "
    "their --help tells their parameters, topics and services.",
    "--params-file FILE",
    ["record", "engine"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(make_nodes, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
