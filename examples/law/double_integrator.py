"""A unit double integrator under PID and homogeneous PID with the same gains.

Prints when each comes and stays within a milliradian of the target, if it does so within five
seconds. Needs nothing but hpid_ros.
"""

from hpid_ros.control import Gains, HomogeneousPid, Pid, WeightedNorm

GAINS = Gains(p=300.0, i=1000.0, d=30.0)  # three poles at -10 rad/s
PERIOD = 0.001  # [s]


DURATION = 5.0  # [s]


def settling_time(law, start=1.0, tolerance=1e-3):
    """Return when the error stays below the tolerance for good, in [s]; None if it does not."""
    error, error_rate, settled = start, 0.0, 0.0
    for k in range(round(DURATION / PERIOD)):
        effort = law.update(error, error_rate, PERIOD)
        error_rate -= PERIOD * effort
        error += PERIOD * error_rate
        if abs(error) > tolerance:
            settled = (k + 1) * PERIOD
    return settled if abs(error) <= tolerance else None


def verdict(law):
    """Return in words when a law settles."""
    settled = settling_time(law)
    if settled is None:
        return f"does not settle within {DURATION:g} s"
    return f"settles in {settled:.3f} s"


print(f"PID            {verdict(Pid(GAINS))}")
for degree in (-0.2, -0.1, 0.1, 0.2):
    law = HomogeneousPid(gains=GAINS, norm=WeightedNorm(degree, 1.0, 0.1), norm_floor=1e-4)
    print(f"hPID, mu {degree:+.1f} {verdict(law)}")
