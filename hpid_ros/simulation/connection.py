"""A simulation of PyBullet's own, for as long as it is needed."""

from __future__ import annotations

from types import TracebackType

from hpid_ros.simulation.bullet import captured, pybullet


class Connection:
    """Holds PyBullet's client; closing it frees the simulation.

    Args:
        gui: Show PyBullet's window.
    """

    def __init__(self, gui: bool) -> None:
        self._client = -1
        with captured():
            self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from PyBullet; a second call does nothing."""
        client, self._client = self._client, -1
        if client >= 0:
            with captured():
                pybullet.disconnect(physicsClientId=client)
