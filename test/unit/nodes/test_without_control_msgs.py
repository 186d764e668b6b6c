"""What needs control_msgs says so in one line where it is missing, and nothing else needs it."""

import subprocess
import sys

WITHOUT = "import sys; sys.modules['control_msgs'] = None; "


def test_the_action_server_names_what_is_missing_in_one_line():
    program = WITHOUT + "from hpid_ros.nodes import follow_joint_trajectory as node; "
    program += "sys.exit(node.main(['x', '--ros-args', '-p', 'joints:=[elbow]']))"
    ended = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.strip().splitlines()
    assert line.startswith("control_msgs is not installed")
    assert "ros-jazzy-control-msgs" in line
