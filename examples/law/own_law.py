"""A law of one's own: the PID with Clegg's integrator, which empties when the error changes sign.

A law is an object with ``answer(error, error_rate, dt)``, which returns its proportional and
derivative terms and the increment of its integral, and a few more methods that it has from
``Pid``: ``update`` takes the increment and returns the effort. Here it drives a unit double
integrator beside the PID with the same gains.

Source: J. C. Clegg, A nonlinear integrator for servomechanisms, 1958.
"""

from hpid_ros.control import Gains, Pid

GAINS = Gains(p=300.0, i=1000.0, d=30.0)
PERIOD, DURATION = 0.001, 3.0  # [s]


class CleggPid(Pid):
    """PID whose integral begins anew at every zero of the error."""

    __slots__ = ("_last_error",)

    def __init__(self, gains):
        super().__init__(gains)
        self._last_error = 0.0

    def answer(self, error, error_rate, dt):
        """Return what a sample gives; the arguments are those of ``Pid.answer``."""
        if error * self._last_error < 0.0:
            self.restore_integral(0.0)
        self._last_error = error
        return super().answer(error, error_rate, dt)


def response(law, start=1.0):
    """Return the errors of a double integrator that starts ``start`` away from its target."""
    error, error_rate, errors = start, 0.0, []
    for _ in range(round(DURATION / PERIOD)):
        error_rate -= PERIOD * law.update(error, error_rate, PERIOD)
        error += PERIOD * error_rate
        errors.append(error)
    return errors


for name, law in (("PID", Pid(GAINS)), ("Clegg", CleggPid(GAINS))):
    errors = response(law)
    absolute = PERIOD * sum(map(abs, errors))
    print(f"{name:6} overshoot {-min(errors):.4f}, integral of |e| {absolute:.4f}")
