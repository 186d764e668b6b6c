"""Clients of FollowJointTrajectory, and joints whose controllers are real processes."""

import time
from types import SimpleNamespace

from builtin_interfaces.msg import Duration
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectoryPoint

from harness.graph import ros_arguments
from harness.interfaces import needs
from hpid_ros.base.names import controller_name
from hpid_ros.base.yaml_text import inline_yaml
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import OFFERED

ACTION = "joint_trajectory_controller"
JOINTS = ("shoulder", "elbow")
PERIOD = 0.005  # [s] between states
ASKS_AGAIN = 0.05  # [s] of the wall clock
GAINS = {"law": "pid", "gains__p": 100.0, "gains__i": 100.0, "gains__d": 20.0}
needs_control_msgs = needs("control_msgs")

ABORTED, CANCELED, SUCCEEDED = 6, 5, 4  # action_msgs/msg/GoalStatus


def goal_of(positions, times, velocities=None, **other):
    """Return a goal: positions by joint, one for each of the times in [s]; velocities likewise."""
    from control_msgs.action import FollowJointTrajectory

    goal = FollowJointTrajectory.Goal(**other)
    fill_trajectory(goal.trajectory, positions, times, velocities)
    return goal


def fill_trajectory(trajectory, positions, times, velocities=None):
    trajectory.joint_names = list(positions)
    for index, seconds in enumerate(times):
        point = JointTrajectoryPoint(positions=[float(each[index]) for each in positions.values()])
        if velocities is not None:
            point.velocities = [float(velocities[name][index]) for name in positions]
        whole = int(seconds)
        point.time_from_start = Duration(sec=whole, nanosec=round((seconds - whole) * 1e9))
        trajectory.points.append(point)


class Joints:
    """Joints of inertia 1, one state after the other, each answered by all controllers that live.

    No faster than the wall clock: what passes between processes takes its time there.
    """

    def __init__(self, harness, joints=JOINTS, apart=None):
        self.harness, self.joints = harness, joints
        self.apart = apart or {}  # topics of joints whose states have one of their own
        self.position, self.velocity = dict.fromkeys(joints, 0.0), dict.fromkeys(joints, 0.0)
        self.effort = dict.fromkeys(joints, 0.0)
        self.alive = set(joints)  # whose commands each state waits for
        self.blocked, self.is_paused = set(), False
        self.ahead = 0.0  # [s] of the stamps before what has passed
        self.references = {joint: [] for joint in joints}  # stamps [s], positions, velocities
        self._count, self._answers = 0, {}
        self._begun, self._asked = 0.0, 0.0
        node = harness.node
        together = [joint for joint in joints if joint not in self.apart]
        self._publishers = [(harness.states, *_layout(together))] + [
            (node.create_publisher(JointState, topic, OFFERED), *_layout([joint]))
            for joint, topic in self.apart.items()
        ]
        harness.on_command = self._on_command
        for joint in joints:
            node.create_subscription(
                JointState,
                f"{controller_name(joint)}/reference",
                lambda raw, joint=joint: self._on_reference(joint, raw),
                100,
                raw=True,
            )

    @property
    def now(self):
        """The stamp of the newest state in [s]."""
        return self._count * PERIOD

    def start(self, *, composed=True, action=ACTION, **parameters):
        """Start the controllers and an action server, and wait until goals can be followed."""
        arguments = ros_arguments(
            state_clock="simulated", certify=False, introspection_rate=-1.0, **GAINS
        )
        arguments += ros_arguments(control_period=PERIOD, state_watchdog=False)
        names = inline_yaml(list(self.joints))
        start, processes = self.harness.processes.start, {}
        if composed:
            arguments += ["-p", f"joints:={names}"]
            for joint, topic in self.apart.items():
                arguments += ["-r", f"{controller_name(joint)}:joint_states:={topic}"]
            started = start("controllers", "joint_controllers", arguments, is_renamed=False)
            processes["controllers"] = started
        else:
            for joint in self.joints:
                name = controller_name(joint)
                own = [*arguments, *ros_arguments(joint=inline_yaml(joint))]
                processes[joint] = start(name, "joint_controller", own)
        processes["action"] = self.start_action(action, **parameters)
        self.harness.wait(
            lambda: all(
                publisher.get_subscription_count() > len(names)
                for publisher, names, _ in self._publishers
            ),
            what="all to listen",
        )
        log = processes["action"].log
        self.run(lambda: "ready for goals" in log.read_text(), what="the action to be ready")
        self.run(lambda: all(self.references.values()), what="references of all joints")
        return SimpleNamespace(**processes)

    def start_action(self, name=ACTION, arguments=(), **parameters):
        """Start an action server; a busy machine is no silence."""
        parameters.setdefault("state_timeout", 3.0)
        parameters.setdefault("joints", inline_yaml(list(self.joints)))
        return self.harness.processes.start(
            name, "follow_joint_trajectory", [*arguments, *ros_arguments(**parameters)]
        )

    def run(self, condition, within=60.0, what="the condition"):
        """Let states follow each other until a condition holds."""
        self._begun = time.monotonic() - self.now
        deadline = time.monotonic() + within
        while not condition():
            self._step()
            due = self._begun + self.now - time.monotonic()  # of the next state
            self.harness.executor.spin_once(timeout_sec=min(max(due, 0.001), 0.02))
            assert time.monotonic() < deadline, f"waited {within} s in vain for {what}"

    def run_for(self, seconds):
        """Let so much time pass for the joints."""
        end = self.now + seconds
        self.run(lambda: self.now >= end, what=f"{seconds} s of states")

    def _step(self):
        if self.is_paused:
            return
        answered = self._answers.get(self._count, {})
        late = time.monotonic() - self._begun - self.now
        if late < 0.0:
            return
        if self._count and not self.alive <= answered.keys():
            if time.monotonic() > self._asked + ASKS_AGAIN:
                self._publish()  # somebody is new, or has lost it; a repeat changes nothing
            return
        for joint in self.joints:
            if joint in answered:
                self.effort[joint] = answered[joint]
            if joint in self.blocked:
                self.velocity[joint] = 0.0
                continue
            self.velocity[joint] += PERIOD * self.effort[joint]
            self.position[joint] += PERIOD * self.velocity[joint]
        self._answers.pop(self._count, None)
        self._count += 1
        self._publish()

    def repeat(self):
        """Publish the newest state once more."""
        self._publish()

    def _publish(self):
        self._asked = time.monotonic()
        for publisher, names, template in self._publishers:
            publisher.publish(
                template.encode(
                    round((self._count * PERIOD + self.ahead) * 1e9),
                    position=[self.position[name] for name in names],
                    velocity=[self.velocity[name] for name in names],
                )
            )

    def _on_command(self, command):
        count = round((command.stamp_ns * 1e-9 - self.ahead) / PERIOD)
        self._answers.setdefault(count, {})[command.names[0]] = command.effort[0]

    def _on_reference(self, joint, raw):
        told = decode_joint_state(raw)
        self.references[joint].append((told.stamp_ns * 1e-9, told.position[0], told.velocity[0]))


def _layout(joints):
    return joints, JointStateTemplate(joints, position=True, velocity=True)


class Client:
    """A client of the action in the test's own node."""

    def __init__(self, joints, name=ACTION):
        from control_msgs.action import FollowJointTrajectory
        from rclpy.action import ActionClient

        self._joints, self.feedback = joints, []
        self._client = ActionClient(
            joints.harness.node, FollowJointTrajectory, f"{name}/follow_joint_trajectory"
        )
        joints.run(self._client.server_is_ready, what="the action server")

    def send(self, goal):
        """Send a goal and return its handle, at once in the future of its result."""
        return self.answer(self.ask(goal))

    def ask(self, goal):
        """Send a goal and return the future of its handle."""
        if not self._joints.is_paused:
            self._joints.run_for(PERIOD)  # what stood still meanwhile is no silence
        return self._client.send_goal_async(goal, lambda each: self.feedback.append(each.feedback))

    def answer(self, sent):
        """Return the handle of a goal that was sent."""
        self._joints.run(sent.done, what="the answer to a goal")
        handle = sent.result()
        handle.ended = handle.get_result_async() if handle.accepted else None
        return handle

    def result(self, handle):
        """Return status, error code and text of a goal once it has ended."""
        self._joints.run(handle.ended.done, what="the result")
        ended = handle.ended.result()
        return ended.status, ended.result.error_code, ended.result.error_string

    def follow(self, goal):
        """Send a goal and return how it ended."""
        return self.result(self.send(goal))

    def close(self):
        self._client.destroy()
