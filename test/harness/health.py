"""A controller's ``/diagnostics`` and services."""

from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

NAME = "elbow_controller"
TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "shutdown": Transition.TRANSITION_ACTIVE_SHUTDOWN,
}


class Told:
    """What a node, a controller if none is named, has told of its health."""

    def __init__(self, harness, name=NAME):
        self._name, self._statuses = name, []
        harness.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def _take(self, message):
        self._statuses += [status for status in message.status if self._name in status.name]

    def newest(self):
        """Return the newest figures by name; empty before the first."""
        if not self._statuses:
            return {}
        newest = self._statuses[-1]
        figures = {pair.key: pair.value for pair in newest.values}
        return {"message": newest.message, "level": newest.level, **figures}

    def count(self, key):
        """Return one of the newest figures as a number; 0 before the first."""
        return int(self.newest().get(key, 0))

    def says(self, **figures):
        """Tell whether the newest figures are these; ``_`` stands for a blank."""
        newest = self.newest()
        return all(newest.get(key.replace("_", " ")) == value for key, value in figures.items())


def call(harness, service, name, request, node=NAME):
    """Call one of the controller's services and return the answer."""
    return harness.call(service, f"{node}/{name}", request, again=service is not ChangeState)


def change(harness, label, node=NAME):
    """Ask for a transition as ``ros2 lifecycle set`` does: by its number."""
    request = ChangeState.Request(transition=Transition(id=TRANSITIONS.get(label, 99)))
    return call(harness, ChangeState, "change_state", request, node).success


def state(harness, node=NAME):
    """Return the name of the lifecycle's state."""
    return call(harness, GetState, "get_state", GetState.Request(), node).current_state.label


def is_stopped(process):
    status = Path(f"/proc/{process.pid}/stat").read_text()
    return status.rpartition(")")[2].split()[0] == "T"
