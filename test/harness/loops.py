"""Joint loops without ROS."""

from hpid_ros.control import JointLoop, LoopSettings


def pure_loop(**parameters):
    """Return the loop of a joint; in the names of parameters ``__`` stands for a dot."""
    values = {"joint": "elbow", **parameters}
    return JointLoop(
        LoopSettings.from_parameters({k.replace("__", "."): v for k, v in values.items()})
    )
