"""What a process that ``hpid`` starts is to do: a JSON file that was made for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rclpy.node import Node

from hpid_ros.base.errors import SettingError
from hpid_ros.nodes.ros.parameters import read_only


def read_order(node: Node) -> dict[str, Any]:
    """Return what the file says that the parameter ``plan_file`` names."""
    file = str(read_only(node, "plan_file", "", "JSON file that hpid has written"))
    try:
        return dict(json.loads(Path(file).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise SettingError(f"plan_file {file!r} cannot be read: {error}") from None
