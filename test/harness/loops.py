"""Joint loops without ROS."""

from hpid_ros.control import JointLoop, LoopSettings


def loop_settings(*, gains=None, **parameters):
    """Return the settings of a joint's loop.

    In the names of parameters ``__`` stands for a dot; ``gains`` are those of ``gains.p`` to
    ``gains.d``.
    """
    values = {"joint": "elbow", **{k.replace("__", "."): v for k, v in parameters.items()}}
    if gains is not None:
        values |= {f"gains.{term}": getattr(gains, term) for term in "pid"}
    return LoopSettings.from_parameters(values)


def pure_loop(**parameters):
    """Return the loop of a joint, see :func:`loop_settings`."""
    return JointLoop(loop_settings(**parameters))
