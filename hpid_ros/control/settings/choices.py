"""The choices of a joint loop, each declared once: what a parameter that names one may say."""

from __future__ import annotations

from typing import Literal

LawName = Literal["hpid", "pid"]
"""The homogeneous PID, or the linear one."""

NormType = Literal["weighted", "canonical"]
"""Homogeneous norms, see :mod:`hpid_ros.control.norms`."""

Discretization = Literal["explicit", "semi_implicit"]
"""Steps of the law, see :mod:`hpid_ros.control.homogeneous_pid`."""

AntiWindupStrategy = Literal["none", "conditional_integration", "back_calculation"]
"""What the integral does while the effort is limited, as in control_toolbox."""

VelocitySourceName = Literal["measured", "filtered", "homogeneous_differentiator", "observer"]
"""Where a velocity comes from, see :mod:`hpid_ros.control.estimation`."""

StateClock = Literal["wall", "simulated"]
"""What stamps the states; a simulated clock can be paused."""

Compensation = Literal["none", "gravity", "decoupling"]
"""What of a model of the robot a loop's effort takes into account."""
