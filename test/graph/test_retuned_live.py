"""Parameters set on a node while its joint moves do what they do to its loop, to the last bit."""

import math

from harness.loops import loop_settings, pure_loop
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.motion import minimum_jerk
from hpid_ros.nodes.core.middleware import LATCHED
from hpid_ros.nodes.parts.references import to_message

MS = 1_000_000
VALUES = {"law": "hpid", "mu": -0.3, "norm__effort_scale": 3.0, "norm__floor": 0.1}
VALUES |= {"gains__p": 100.0, "gains__i": 400.0, "gains__d": 14.0, "inertia": 0.5}
CHANGES = [  # that they make no jump is the loop's: test_safety_loop.py
    {"norm__effort_scale": 6.0, "mu": -0.1},
    {"gains__p": 120.0, "gains__d": 16.0},
    {"velocity_source": "observer"},
    {"observer__bandwidth": 90.0, "observer__feed_disturbance": True},
    {"inertia": 0.7},
    {"velocity_source": "filtered", "feedforward__inertia": 0.5},
    {"feedforward__viscous_friction": 0.8, "feedforward__coulomb_friction": 1.5},
    {"velocity_source": "homogeneous_differentiator"},
    {"velocity_source": "measured"},
]


def test_a_node_that_is_retuned_in_motion_does_what_its_loop_does(harness):
    motion = minimum_jerk([0.0, 1.0, 2.0], {"elbow": [0.0, 0.4, -0.4]})
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    publisher.publish(to_message(motion))
    harness.start_controller(**VALUES, wait_for_reference=True)
    values, loop = dict(VALUES), pure_loop(**VALUES)
    loop.follow(motion.column("elbow"))
    stamps = iter(range(2000))
    for change in [{}, *CHANGES]:
        if change:
            values |= change
            assert harness.set_parameters("elbow_controller", **change) == (True, "")
            loop.retune(loop_settings(**values))
        for at in (next(stamps) for _ in range(150)):
            state = at * MS, 0.2 * math.sin(3e-3 * at), 0.6 * math.cos(3e-3 * at)
            assert harness.ask(*state) == loop.step(*state)
