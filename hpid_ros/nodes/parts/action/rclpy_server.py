"""The private parts of rclpy's action server that ours needs, read in rclpy 7.1.5 and 7.1.6.

It answers in ``_execute_goal_request``, ``_execute_cancel_request`` and ``_send_result_response``,
by ``_handle``, and has no public way to send an answer again. As in :mod:`.rclpy_internals`, no
other module touches them; it is apart because rclpy's actions take long to import.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future

Sent = Callable[[Callable[[], None]], AbstractContextManager[None]]


class DeferringServer(ActionServer):
    """An action server whose goals are executed when somebody has their result.

    And one that answers a client that is not matched yet, too: in a block of :attr:`sent`.
    """

    _handle: Any
    _goal_handles: dict[bytes, ServerGoalHandle]
    _node: Node

    def __init__(self, sent: Sent, *arguments: Any, **options: Any) -> None:
        self._sent = sent
        super().__init__(*arguments, **options)

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Run a callback with a goal; without one there is nothing to run."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)

    async def _execute_goal_request(self, taken: tuple[Any, Any]) -> None:
        header, request = taken
        answer = self.action_type.Impl.SendGoalService.Response()
        with self._sent(lambda: self._handle.send_goal_response(header, answer)):
            await super()._execute_goal_request(taken)
        answer.accepted = bytes(request.goal_id.uuid) in self._goal_handles
        answer.stamp = self._node.get_clock().now().to_msg()

    async def _execute_cancel_request(self, taken: tuple[Any, Any]) -> None:
        handle, self._handle = self._handle, _Cancels(self._handle, self._sent)
        try:
            await super()._execute_cancel_request(taken)
        finally:
            self._handle = handle

    def _send_result_response(self, header: Any, future: Future) -> None:
        send = partial(super()._send_result_response, header, future)
        with self._sent(send):
            send()


class _Cancels:
    """The handle of an action server that sends the answer to a cancel again."""

    def __init__(self, handle: Any, sent: Sent) -> None:
        self._handle, self._sent = handle, sent

    def __getattr__(self, name: str) -> Any:
        return getattr(self._handle, name)

    def send_cancel_response(self, *arguments: Any) -> None:
        send = partial(self._handle.send_cancel_response, *arguments)
        with self._sent(send):
            send()
