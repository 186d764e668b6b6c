"""The action server: goals and their answers as messages.

``control_msgs`` has no package on PyPI and is imported here, when a server is made. rclpy's server
runs a goal in a callback that returns its result; this one returns at the end, and until then
nothing waits in it: a callback that awaits something ends the EventsExecutor of Jazzy.

It keeps requests in ``_goal_request``, answers in ``_execute_goal_request``,
``_execute_cancel_request`` and ``_send_result_response``, by ``_handle``, and has no public way to
send an answer again. As in :mod:`.rclpy_internals`, no
other module touches them; it is apart because rclpy's actions take long to import.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration, Time
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectoryPoint

from hpid_ros.base.errors import SettingError, reason_of
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.messages.bounds import GOALS_KEPT
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import UNNAMED, full_name, steady_timer
from hpid_ros.nodes.core.services import Answers
from hpid_ros.nodes.parts.goal_follower import CANCELLED, Feedback
from hpid_ros.nodes.parts.goals import GoalError, GoalRequest, GoalResult, ResultCode

Sent = Callable[[Callable[[], None]], AbstractContextManager[None]]


class DeferringServer(ActionServer):
    """An action server whose goals are executed when their result is there.

    It answers also a client that is not matched yet, each answer in a block of ``sent``.
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


def forget_request(handle: Any) -> None:
    """Free what a goal asked for: rclpy would keep it until the result expires."""
    handle._goal_request = None


_ACTION = "~/follow_joint_trajectory"
_RESULTS_KEPT = 10  # [s], rcl_action's own default; rclpy's is a quarter of an hour
_RECEIVED_WITHIN = 0.25  # [s] for the last results: answers of services are not acknowledged
_POINT, _TOLERANCE, _NAME, _NUMBER = 340, 340, 64, 8  # bytes that each costs, a third in Python
_GOALS_AT_ONCE = 1000

_REPLACED = GoalResult(ResultCode.INVALID_GOAL, "replaced by a new goal before it began")
_ENDED = GoalResult(ResultCode.INVALID_GOAL, "the node ends")
_ARRAYS = ("positions", "velocities", "accelerations", "effort")


def size_of(goal: Any) -> int:
    """Return the bytes that a goal costs while it is kept, in proportion to those of its message.

    Python's objects count as a third of what they are: 64 MiB are 200 000 points, or 64 MiB of
    numbers.
    """
    trajectory, other = goal.trajectory, goal.multi_dof_trajectory
    names = [*trajectory.joint_names, *other.joint_names]
    numbers = sum(
        len(each.positions) + len(each.velocities) + len(each.accelerations) + len(each.effort)
        for each in trajectory.points
    )
    objects = len(trajectory.points) + sum(
        1 + len(each.transforms) + len(each.velocities) + len(each.accelerations)
        for each in other.points
    )
    tolerances = [*goal.path_tolerance, *goal.goal_tolerance]
    names += [each.name for each in tolerances]
    texts = sum(map(len, names)) + _NAME * len(names)
    return texts + _NUMBER * numbers + _POINT * objects + _TOLERANCE * len(tolerances)


def request_of(goal: Any) -> GoalRequest:
    """Read a goal; this takes a while where it has many points."""
    if goal.multi_dof_trajectory.points or goal.multi_dof_trajectory.joint_names:
        raise GoalError("multi_dof_trajectory cannot be followed, only trajectory")
    duration = goal.goal_time_tolerance
    return GoalRequest.of(
        serialize_message(goal.trajectory),
        tuple(goal.path_tolerance),
        tuple(goal.goal_tolerance),
        (duration.sec * NANOSECONDS + duration.nanosec) * SECONDS_PER_NANOSECOND,
    )


def fill_feedback(message: Any, names: Sequence[str], feedback: Feedback) -> Any:
    seconds, nanoseconds = divmod(feedback.stamp_ns, NANOSECONDS)
    message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
    message.joint_names = list(names)
    message.desired = _point(feedback.desired, feedback.since_start_ns)
    message.actual = _point(feedback.actual, feedback.since_start_ns)
    message.error = _point(feedback.error, feedback.since_start_ns)
    return message


def _point(joints: Sequence[Sequence[float]], since_start_ns: int) -> JointTrajectoryPoint:
    seconds, nanoseconds = divmod(since_start_ns, NANOSECONDS)
    arrays = dict(zip(_ARRAYS, map(list, zip(*joints, strict=True)), strict=False))
    return JointTrajectoryPoint(
        time_from_start=Duration(sec=seconds, nanosec=nanoseconds), **arrays
    )


def action_type() -> Any:
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError:
        raise SettingError(
            "control_msgs is not installed, which has the action FollowJointTrajectory: install "
            "ros-jazzy-control-msgs, or build it from source (it has no package on PyPI)"
        ) from None
    return FollowJointTrajectory


class GoalServer:
    """Takes goals from clients, one at a time, the newest first, and answers how they end.

    Goals are read on a thread. All else is called on the executor's, and calls back there.
    """

    def __init__(
        self,
        node: ClosingNode,
        begin: Callable[[GoalRequest], None],
        cancel: Callable[[], None],
        note: Callable[[GoalResult], None],
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
        self._server = DeferringServer(
            Answers(node).sent,
            node,
            self._type,
            _ACTION,
            lambda _: self._type.Result(),
            # An error in a task would end the executor.
            goal_callback=node.guarded(_ACTION, self._answer),
            handle_accepted_callback=node.guarded(_ACTION, self._accept),
            cancel_callback=node.guarded(_ACTION, self._answer_cancel),
            result_timeout=_RESULTS_KEPT,
        )

    def namesakes(self) -> list[str]:
        """Return full names of the nodes of other action servers of this name, as in the graph.

        A client's goal goes to all of them, and it gets the answers of all.
        """
        ends = self._node.get_publishers_info_by_topic(f"{self.name}/_action/status")
        named = [full_name(end) for end in ends if end.node_name != UNNAMED]  # yet
        names, own = sorted(named), self._node.get_fully_qualified_name()
        if own in names:
            names.remove(own)  # once: another one may have the same name
        return names

    def send_feedback(self, feedback: Feedback, names: tuple[str, ...]) -> None:
        if self._active is not None:
            message = fill_feedback(self._type.Feedback(), names, feedback)
            self._active.publish_feedback(message)

    def end(self, result: GoalResult) -> None:
        handle, self._active = self._active, None
        if handle is not None:
            self._finish(handle, result)

    def leave(self) -> Future | None:
        """Take no more goals."""
        self._is_leaving = True
        self._replace_waiting(_ENDED)
        self._left = Future() if self._ending else None
        return self._left

    def destroy(self) -> None:
        """Let the middleware forget the action: what it holds would keep the node on the graph."""
        self._server.destroy()

    def close(self) -> None:
        """Read no more goals."""
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _answer(self, goal: Any) -> GoalResponse:
        """Reject goals of a flood; all others get a result that says what is wrong with them."""
        now = time.monotonic()
        while self._kept and self._kept[0][0] < now - _RESULTS_KEPT:
            self._kept.popleft()
        size = size_of(goal)
        is_full = sum(each for _, each in self._kept) + size > GOALS_KEPT
        if self._is_leaving or is_full or len(self._kept) >= _GOALS_AT_ONCE:
            self.rejected += 1
            return GoalResponse.REJECT
        self._kept.append((now, size))
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
        forget_request(handle)
        self._node.hand_over(self._take, handle, found)

    def _take(self, handle: ServerGoalHandle, found: GoalRequest | Exception) -> None:
        if handle is not self._waiting:
            return
        self._waiting = None
        try:
            if isinstance(found, Exception):
                raise found
            self._begin(found)  # which ends the one before
        except GoalError as error:
            self._finish(handle, error.result)
            return
        except Exception as error:  # of any kind: the goal is refused
            self._finish(handle, GoalError(reason_of(error)).result)
            return
        self._active = handle

    def _answer_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        # What follows from it is done in a task, so when the goal is canceling. One that is about
        # to end is not rejected: of those cancelled together rclpy would pass over the next one.
        if handle is self._waiting:
            self._replace_waiting(CANCELLED)
        elif handle is self._active:
            self._cancel()
        return CancelResponse.ACCEPT

    def _replace_waiting(self, result: GoalResult) -> None:
        handle, self._waiting = self._waiting, None
        if handle is not None:
            self._finish(handle, result)

    def _finish(self, handle: ServerGoalHandle, result: GoalResult) -> None:
        self._ending += 1
        forget_request(handle)
        self._note(result)
        self._server.notify_execute(handle, partial(self._conclude, result))

    def _conclude(self, result: GoalResult, handle: ServerGoalHandle) -> Any:
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
                steady_timer(self._node, _RECEIVED_WITHIN, self._note_left)
        return self._type.Result(error_code=int(result.code), error_string=result.text)

    def _note_left(self) -> None:
        """Note that clients have had time for their results."""
        if self._left is not None and not self._ending and not self._left.done():
            self._left.set_result(None)
