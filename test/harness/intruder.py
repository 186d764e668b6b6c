"""Tries for some seconds to command a joint and to set a gain; prints what it reached as JSON.

Arguments: how long at most in [s]; "set" to end with the gain, else with both; the user to become.
"""

import json
import os
import sys
import time

import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import JointState

SECONDS, UNTIL, USER = float(sys.argv[1]), sys.argv[2], int(sys.argv[3])
ELSEWHERE = 199  # a domain that no experiment takes


def become(user):
    """Change the user for good, when all libraries are loaded: he may not read their folders."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ELSEWHERE)
    node = rclpy.create_node("elsewhere", context=context)
    node.create_publisher(JointState, "joint_commands", 10)
    client = node.create_client(SetParameters, "set_parameters")
    client.service_is_ready()
    rclpy.executors.SingleThreadedExecutor(context=context).spin_once(timeout_sec=0.0)
    node.destroy_node()
    rclpy.shutdown(context=context)
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)


def main():
    if os.getuid() != USER:
        become(USER)
    rclpy.init(args=[])
    node = rclpy.create_node("intruder")
    commands = node.create_publisher(JointState, "joint_commands", 10)
    client = node.create_client(SetParameters, "/elbow_controller/set_parameters")
    gain = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=999.0)
    request = SetParameters.Request(parameters=[Parameter(name="gains.p", value=gain)])
    reached = {"listeners": 0, "set": False, "user": os.getuid()}
    future = None
    end = time.monotonic() + SECONDS
    while time.monotonic() < end and not (
        reached["set"] and (reached["listeners"] or UNTIL == "set")
    ):
        rclpy.spin_once(node, timeout_sec=0.05)
        commands.publish(JointState(name=["elbow"], effort=[99.0]))
        reached["listeners"] = max(reached["listeners"], commands.get_subscription_count())
        if future is None and client.service_is_ready():
            future = client.call_async(request)
        if future is not None and future.done():
            reached["set"] = future.result().results[0].successful
    print(json.dumps(reached))


main()
