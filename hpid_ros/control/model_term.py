"""What a model of the robot adds to one joint's law."""

from __future__ import annotations

from typing import NamedTuple


class ModelTerm(NamedTuple):
    r"""One sample of a model, as one joint's loop needs it.

    The loop's effort, before the limits, is

    .. math:: \tau = g\,(u + a) + \tau_m

    with the law's output u, the reference's acceleration a (0 unless asked for), the gain g and
    the model's own effort :math:`\tau_m`. The law's gains, its integral and ``i_clamp`` are in
    the units of u: efforts where g is 1, accelerations where it is an inertia.

    Attributes:
        gain: g, positive: 1, or in [kg m^2] what one unit of acceleration costs.
        effort: The model's own effort in [N m].
        follows_acceleration: Whether the reference's acceleration is added to the law's output.
    """

    gain: float
    effort: float
    follows_acceleration: bool = False
