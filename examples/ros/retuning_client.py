"""Retuning a running controller: what is taken, what is refused and why.

    python examples/ros/retuning_client.py [NODE]

A set of parameters is taken as a whole, between two samples, or refused as a whole with the
reason. Without the name of a node this starts a controller of its own; NODE keeps gains.p 60,
gains.d 5 and mu 0.1: name one of a simulated joint.
"""

import subprocess
import sys

import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

SETS = (
    {"mu": -0.1},
    {"gains.p": 60.0, "gains.d": 5.0, "mu": 0.1},
    {"mu": 0.6},  # out of range
    {
        "gains.p": 80.0,
        "u_clamp_max": -20.0,
    },  # below u_clamp_min: neither is set
)


def start(name):
    """Start a controller under a name and return its process."""
    values = {"joint": "elbow", "gains.p": 40.0, "gains.i": 130.0, "gains.d": 4.0}
    values |= {"norm.error_scale": 0.3, "u_clamp_max": 10.0, "u_clamp_min": -10.0}
    options = [text for key, value in values.items() for text in ("-p", f"{key}:={value}")]
    command = [sys.executable, "-m", "hpid_ros.nodes.joint_controller", "--ros-args", *options]
    return subprocess.Popen([*command, "-r", f"__node:={name}"])


def set_all(node, client, values):
    """Set parameters at once and return the answer."""
    parameters = [
        Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
    ]
    future = client.call_async(SetParametersAtomically.Request(parameters=parameters))
    rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
    return future.result().result


def main(name):
    """Send the sets to a controller."""
    node = rclpy.create_node("retuning")
    client = node.create_client(SetParametersAtomically, f"/{name}/set_parameters_atomically")
    if not client.wait_for_service(timeout_sec=20.0):
        sys.exit(f"no node /{name} answers")
    for values in SETS:
        answer = set_all(node, client, values)
        said = ", ".join(f"{key} = {value:g}" for key, value in values.items())
        print(f"{said}: {'taken' if answer.successful else f'refused: {answer.reason}'}")
    node.destroy_node()


if __name__ == "__main__":
    rclpy.init()
    if len(sys.argv) > 1:
        main(sys.argv[1].lstrip("/"))
    else:
        process = start("elbow_controller")
        try:
            main("elbow_controller")
        finally:
            process.terminate()
            process.wait()
    rclpy.shutdown()
