#!/usr/bin/env bash
# Every command of the container has ROS, the venv and the workspace around it.
set -eo pipefail
source "/opt/ros/$ROS_DISTRO/setup.bash"
source "$WORKSPACE/venv/bin/activate"
source "$WORKSPACE/install/setup.bash"
exec "$@"
