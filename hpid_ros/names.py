"""Names that several parts of the package must agree on."""

from __future__ import annotations


def controller_name(joint: str) -> str:
    """Return the node name of a joint's controller in a composition, a launch or a run.

    Args:
        joint: Name of the joint.
    """
    return f"{joint}_controller"
