"""Decentralised joint control on ROS 2 with the homogeneous PID.

One ROS 2 node drives one joint; the node is a thin shell around one pure object, the
:class:`~hpid_ros.control.JointLoop`. The same loop runs on a robot, in the PyBullet robot and
inside a study without ROS, and gives the same numbers.
"""

__version__ = "0.1.0"
