"""Every parameter of law, estimation and feedforward, set on a node while its joint moves."""

from copy import deepcopy

import numpy as np
from harness.loops import loop_settings, pure_loop
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.motion import minimum_jerk
from hpid_ros.nodes.core.middleware import LATCHED
from hpid_ros.nodes.parts.references import to_message

MS = 1_000_000
INERTIA, LOAD, VISCOUS = 0.5, -3.0, 0.8
REST = 1.6  # [s]; then the joint moves
START = {
    "law": "hpid",
    "mu": -0.3,
    "norm__effort_scale": 3.0,
    "norm__floor": 0.1,
    "gains__p": 100.0,
    "gains__i": 400.0,
    "gains__d": 14.0,
    "inertia": INERTIA,
    "wait_for_reference": True,
}
AT_REST = [  # where the laws before and after give the same effort
    {"norm__effort_scale": 6.0},
    {"mu": -0.1},
    {"norm__floor": 0.3},
    {"gains__p": 120.0, "gains__d": 16.0},
]
IN_MOTION = [
    {"velocity_source": "observer"},
    {"observer__bandwidth": 90.0},
    {"observer__degree": 0.2},
    {"observer__innovation_scale": 1e-5},
    {"observer__feed_disturbance": True},
    {"inertia": 0.7},
    {"observer__feed_disturbance": False},
    {"velocity_source": "filtered"},
    {"feedforward__inertia": INERTIA},
    {"feedforward__viscous_friction": VISCOUS},
    {"feedforward__coulomb_friction": 1.5},
    {"feedforward__friction_velocity": 0.5},
    {"feedforward__inertia": 0.0, "feedforward__coulomb_friction": 0.0},
    {"velocity_source": "homogeneous_differentiator"},
    {"velocity_source": "measured"},
]


class Joint:
    """A loaded joint with viscous friction, moved as the efforts say."""

    def __init__(self):
        self.stamp_ns, self.position, self.velocity = 0, 0.0, 0.0

    @property
    def state(self):
        return self.stamp_ns, self.position, self.velocity

    def push(self, effort):
        acceleration = (effort + LOAD - VISCOUS * self.velocity) / INERTIA
        self.velocity += 1e-3 * acceleration
        self.position += 1e-3 * self.velocity
        self.stamp_ns += MS


def test_no_parameter_moves_the_effort_when_it_is_set(harness):
    """The node does what the loop does, to the bit; the loop does what it did without the set."""
    times = [0.0, *np.arange(REST, 6.0)]
    motion = minimum_jerk(
        times, {"elbow": [0.0, *(0.4 - 0.4 * (-1.0) ** np.arange(len(times) - 1))]}
    )
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    publisher.publish(to_message(motion))
    values = {key: value for key, value in START.items() if key != "wait_for_reference"}
    harness.start_controller(**START)
    loop, joint = pure_loop(**values), Joint()
    loop.follow(motion.column("elbow"))

    def run(samples):
        efforts = []
        for _ in range(samples):
            efforts.append(harness.ask(*joint.state))
            assert efforts[-1] == loop.step(*joint.state)
            joint.push(efforts[-1])
        return efforts

    run(1100)
    for change in [*AT_REST, *IN_MOTION]:
        if change is IN_MOTION[0]:
            run(round(REST * 1e3) + 200 - joint.stamp_ns // MS)
            assert abs(joint.velocity) > 0.1
        values |= change
        unchanged = deepcopy(loop)
        assert harness.set_parameters("elbow_controller", **change) == (True, "")
        loop.retune(loop_settings(**values))
        as_before = unchanged.step(*joint.state)
        efforts = run(40)
        most = 0.25  # [N m] of some 10
        if "homogeneous_differentiator" in change.values():
            most = 16.0 * 1.1 * 50.0 * 1e-3  # d, and how far its velocity goes in any sample
        assert abs(efforts[0] - as_before) < most, change
