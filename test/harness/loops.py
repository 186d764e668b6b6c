"""Joint loops without ROS."""

import math

from hpid_ros.control import JointLoop, LoopSettings

# Another value of each parameter, all of them possible together.
OTHER_VALUES = {
    **{"joint": "k", "law": "pid", "gains.p": 30.0, "gains.i": 4.0, "gains.d": 5.0, "mu": 0.1},
    **{"norm.type": "canonical", "norm.error_scale": 0.3, "norm.rate_weight": 0.2},
    **{"norm.floor": 0.01, "norm.cap": 50.0, "u_clamp_max": 9.0, "u_clamp_min": -8.0},
    **{"i_clamp_max": 7.0, "i_clamp_min": -6.0, "antiwindup_strategy": "back_calculation"},
    **{"tracking_time_constant": 0.4, "velocity_source": "homogeneous_differentiator"},
    **{"velocity_filter_time_constant": 0.01, "acceleration_bound": 40.0},
    **{"discretization": "semi_implicit", "encoder_wrap": 6.28, "angle_wraparound": True},
    **{"position_step_max": 0.2, "effort_rate_max": 300.0, "velocity_max": 3.0},
    **{"soft_stop.margin": 0.1, "soft_stop.k_position": 4.0, "soft_stop.k_velocity": 3.0},
    **{"takeover_time": 0.3, "fallback_effort": 1.0, "state_timeout": 0.2},
    **{"state_clock": "simulated", "control_period": 0.002, "encoder_resolution": 1e-4},
    **{"inertia": 1.5, "compensation": "gravity", "model.description": "arm.urdf"},
    **{"model.payload": 2.0, "model.payload_link": "hook", "model.mass_scale": 1.1},
    **{"model.locked_joints": "a,b", "model.left_wheel": "l", "model.right_wheel": "r"},
    **{"model.wheel_radius": 0.1, "model.wheel_separation": 0.4},
    **{"observer.bandwidth": 90.0, "observer.degree": -0.1},
    **{"observer.innovation_scale": 1e-3, "observer.feed_disturbance": True},
    **{"feedforward.inertia": 0.4, "feedforward.viscous_friction": 0.1},
    **{"feedforward.coulomb_friction": 0.5, "feedforward.friction_velocity": 0.02},
    **{"feedforward.trajectory_effort": False, "model.effort_filter_time_constant": 0.02},
}
IN_EFFORT = {"norm.effort_scale": 3.0}  # not beside scales of the joint's own
STOPS = {"position_max": 2.0, "position_min": -3.0}  # not where angles wrap around
TURNS = {"multi_turn": True}  # nor this


def loop_settings(*, gains=None, **parameters):
    """Return the settings of a joint's loop; ``__`` in a parameter's name stands for a dot."""
    values = {"joint": "elbow", **{k.replace("__", "."): v for k, v in parameters.items()}}
    if gains is not None:
        values |= {f"gains.{term}": getattr(gains, term) for term in "pid"}
    return LoopSettings.from_parameters(values)


def pure_loop(motion=None, **parameters):
    """Return the loop of a joint, see :func:`loop_settings`, which follows a motion."""
    loop = JointLoop(loop_settings(**parameters))
    if motion is not None:
        loop.follow(motion)
    return loop


def loops_with(**common):
    """Return :func:`loop_settings` and :func:`pure_loop`, these parameters given beforehand."""

    def settings(**changes):
        return loop_settings(**common | changes)

    def loop_on(motion=None, **changes):
        return pure_loop(motion, **common | changes)

    return settings, loop_on


class Joint:
    """A joint of constant inertia under a load and friction, at rest; exact without friction."""

    def __init__(self, inertia, load=0.0, position=0.0, viscous=0.0, coulomb=0.0):
        self.inertia, self.load, self.viscous, self.coulomb = inertia, load, viscous, coulomb
        self.position, self.velocity, self.stamp_ns = position, 0.0, 0

    def push(self, effort, dt=1e-3):
        """Move under an effort for some time in [s]."""
        steps = 20 if self.coulomb else 4 if self.viscous else 1
        h = dt / steps
        for _ in range(steps):
            friction = self.viscous * self.velocity
            friction += self.coulomb * math.tanh(self.velocity / 1e-3)
            acceleration = (effort + self.load - friction) / self.inertia
            self.position += h * (self.velocity + 0.5 * h * acceleration)
            self.velocity += h * acceleration
        self.stamp_ns += round(dt * 1e9)


def drive(loop, joint, samples, periods=(1e-3,)):
    """Step the loop on the joint, and return its efforts."""
    efforts = []
    for k in range(samples):
        efforts.append(loop.step(joint.stamp_ns, joint.position, joint.velocity))
        joint.push(efforts[-1], periods[k % len(periods)])
    return efforts
