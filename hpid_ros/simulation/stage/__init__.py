"""Pictures of bodies that are put somewhere: no physics, no screen."""

from hpid_ros.simulation.stage.stage import Stage, open_stage
from hpid_ros.simulation.stage.view import View

__all__ = ["Stage", "View", "open_stage"]
