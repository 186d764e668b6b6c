"""The goals of an action's clients: which is waiting, which is followed, and how each ended.

``control_msgs`` has no package on PyPI and is imported here, when a server is made. rclpy's server
runs a goal in a callback that returns its result; this one returns at the end, and until then
nothing waits in it: a callback that awaits something ends the EventsExecutor of Jazzy.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from hpid_ros.base.errors import SettingError
from hpid_ros.goals import CANCELLED, Feedback, GoalError, GoalRequest, Result, ResultCode
from hpid_ros.nodes.parts.action.messages import fill_feedback, request_of
from hpid_ros.nodes.ros.executor import ClosingNode
from hpid_ros.nodes.ros.steady_timer import steady_timer

_ACTION = "~/follow_joint_trajectory"
_RESULTS_KEPT = 10  # [s], rcl_action's own default; rclpy's is a quarter of an hour
_HEARD_WITHIN = 0.25  # [s] for the last results: nobody acknowledges the answer of a service
_POINTS_AT_ONCE = 200_000  # of all goals that are kept; a point costs about a kilobyte
_GOALS_AT_ONCE = 1000

_REPLACED = Result(ResultCode.INVALID_GOAL, "replaced by a new goal before it began")
_ENDED = Result(ResultCode.INVALID_GOAL, "the node ends")


def action_type() -> Any:
    """Return ``control_msgs/action/FollowJointTrajectory``.

    Raises:
        SettingError: control_msgs is not installed.
    """
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError:
        raise SettingError(
            "control_msgs is not installed, which has the action FollowJointTrajectory: install "
            "ros-jazzy-control-msgs, or build it from source (it has no package on PyPI)"
        ) from None
    return FollowJointTrajectory


class _DeferredServer(ActionServer):
    """An action server whose goals are executed when somebody has their result."""

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class GoalServer:
    """Takes goals from clients, one at a time, the newest first, and tells how they end.

    Goals are read on a thread. All else is called on the executor's, and calls back there.

    Args:
        node: The node that serves.
        begin: Called with each goal; returns how the one before it has ended, None if there was
            none. Raises a :class:`.GoalError` for one that is not obeyed.
        cancel: Called when the client of the goal that is followed cancels it; it shall end it.
        note: Called with the result of every goal.

    Raises:
        SettingError: control_msgs is not installed.
    """

    def __init__(
        self,
        node: ClosingNode,
        begin: Callable[[GoalRequest], Result | None],
        cancel: Callable[[], None],
        note: Callable[[Result], None],
    ) -> None:
        self._type = action_type()
        self._node, self._begin, self._cancel, self._note = node, begin, cancel, note
        self._reader = ThreadPoolExecutor(1, "goals")
        self._waiting: ServerGoalHandle | None = None
        self._active: ServerGoalHandle | None = None
        self._ending = 0
        self._is_leaving = False
        self._left: Future | None = None
        self._kept: deque[tuple[float, int]] = deque()
        self.rejected = 0
        self.name = node.resolve_topic_name(_ACTION)
        """Full name of the action."""
        self._server = _DeferredServer(
            node,
            self._type,
            _ACTION,
            lambda _: self._type.Result(),
            goal_callback=self._answer,
            handle_accepted_callback=self._accept,
            cancel_callback=self._answer_cancel,
            result_timeout=_RESULTS_KEPT,
        )

    def tell(self, feedback: Feedback, names: tuple[str, ...]) -> None:
        """Send feedback to the client of the goal that is followed.

        Args:
            feedback: How it is doing.
            names: All joints, in the order of the feedback.
        """
        if self._active is not None:
            message = fill_feedback(self._type.Feedback(), names, feedback)
            self._active.publish_feedback(message)

    def end(self, result: Result) -> None:
        """End the goal that is followed.

        Args:
            result: How it ended.
        """
        handle, self._active = self._active, None
        if handle is not None:
            self._finish(handle, result)

    def leave(self) -> Future | None:
        """Take no more goals.

        Returns:
            What is done when all goals have their results and clients had time to hear of
            them; None if there are none.
        """
        self._is_leaving = True
        self._replace_waiting(_ENDED)
        self._left = Future() if self._ending else None
        return self._left

    def close(self) -> None:
        """Read no more goals."""
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _answer(self, goal: Any) -> GoalResponse:
        """Reject goals of a flood; all others get a result that says what is wrong with them."""
        now = time.monotonic()
        while self._kept and self._kept[0][0] < now - _RESULTS_KEPT:
            self._kept.popleft()
        points = len(goal.trajectory.points)
        most = sum(each for _, each in self._kept) + points > _POINTS_AT_ONCE
        if self._is_leaving or most or len(self._kept) >= _GOALS_AT_ONCE:
            self.rejected += 1
            return GoalResponse.REJECT
        self._kept.append((now, points))
        return GoalResponse.ACCEPT

    def _accept(self, handle: ServerGoalHandle) -> None:
        self._replace_waiting(_REPLACED)
        self._waiting = handle
        handle.execute()
        self._reader.submit(self._read, handle)

    def _read(self, handle: Any) -> None:
        """Read a goal on the reader's thread, if it is still the newest."""
        if self._waiting is None or handle is not self._waiting:
            return
        found: GoalRequest | Exception
        try:
            found = request_of(handle.request)
        except Exception as error:
            found = error
        self._node.hand_over(self._take, handle, found)

    def _take(self, handle: ServerGoalHandle, found: GoalRequest | Exception) -> None:
        if handle is not self._waiting:
            return
        self._waiting = None
        try:
            if isinstance(found, Exception):
                raise found
            replaced = self._begin(found)
        except GoalError as error:
            self._finish(handle, error.result)
            return
        if replaced is not None:
            self.end(replaced)
        self._active = handle

    def _answer_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        # What follows from it is done in a task, so when the goal is canceling.
        if handle is self._waiting:
            self._replace_waiting(CANCELLED)
        elif handle is self._active:
            self._cancel()
        else:
            return CancelResponse.REJECT
        return CancelResponse.ACCEPT

    def _replace_waiting(self, result: Result) -> None:
        handle, self._waiting = self._waiting, None
        if handle is not None:
            self._finish(handle, result)

    def _finish(self, handle: ServerGoalHandle, result: Result) -> None:
        self._ending += 1
        self._note(result)
        self._server.notify_execute(handle, partial(self._conclude, result))

    def _conclude(self, result: Result, handle: ServerGoalHandle) -> Any:
        """Put a goal into its last state and return its result, as rclpy wants it."""
        try:
            if result is CANCELLED and handle.is_cancel_requested:
                handle.canceled()
            elif result is not CANCELLED and result.code is ResultCode.SUCCESSFUL:
                handle.succeed()
            else:
                handle.abort()
        finally:
            self._ending -= 1
            if self._left is not None and not self._ending:
                steady_timer(self._node, _HEARD_WITHIN, self._tell_left)
        return self._type.Result(error_code=int(result.code), error_string=result.text)

    def _tell_left(self) -> None:
        """Tell whoever waits for it that clients have had time for their results."""
        if self._left is not None and not self._ending and not self._left.done():
            self._left.set_result(None)
