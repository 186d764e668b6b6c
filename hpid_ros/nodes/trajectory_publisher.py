"""Publishes one reference trajectory, latched, for every controller that is or comes."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from hpid_ros.errors import SettingError, TrajectoryError
from hpid_ros.nodes import executor
from hpid_ros.nodes.parameters import read_only
from hpid_ros.nodes.qos import LATCHED
from hpid_ros.nodes.status_pipe import StatusPipe
from hpid_ros.nodes.trajectories import to_message
from hpid_ros.trajectory import reference_from
from hpid_ros.yaml_files import load_yaml


class TrajectoryPublisher(executor.ClosingNode):
    """Publishes the ``reference`` section of a file on ``joint_trajectory``.

    Raises:
        SettingError: No file was named.
        TrajectoryError: The file has no usable reference.
    """

    def __init__(self) -> None:
        super().__init__("trajectory_publisher")
        path = read_only(
            self, "reference_file", "", "YAML file with a reference section, e.g. an experiment"
        )
        if not path:
            raise SettingError("the parameter reference_file must name a YAML file, it is empty")
        document = load_yaml(str(path), TrajectoryError)
        section = document.get("reference") if isinstance(document, dict) else None
        trajectory = reference_from(section, f"{path}: reference")
        self._publisher = self.create_publisher(
            JointTrajectoryMessage, "joint_trajectory", LATCHED
        )
        self._publisher.publish(to_message(trajectory))
        StatusPipe(self).send("published")
        self.get_logger().info(
            f"published {len(trajectory.points)} points for {len(trajectory.joint_names)} joints"
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the publisher."""
    return executor.run(lambda: [TrajectoryPublisher()], args)


if __name__ == "__main__":
    sys.exit(main())
