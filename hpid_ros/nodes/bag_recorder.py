"""Records topics into an MCAP bag."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hpid_ros.base.records import names_of
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Usage
from hpid_ros.nodes.core.status import StatusParameters
from hpid_ros.nodes.parts.recorder import BagRecorder, RecorderParameters

USAGE = Usage(
    "bag_recorder",
    "Records topics into a new MCAP bag.",
    "-p bag:=FOLDER",
    names_of(RecorderParameters, StatusParameters),
    ["those of the parameter topics"],
)


def main(args: Sequence[str] | None = None) -> int:
    return executor.run(lambda: [BagRecorder()], args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
