"""Introspection of a running loop: ``~/reference``, ``~/terms`` and ``~/estimate``."""

from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import JointState

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control import JointLoop
from hpid_ros.nodes.ros.middleware import OFFERED, RARE
from hpid_ros.nodes.ros.parameters import read_number
from hpid_ros.wire import JointStateTemplate


class Introspection:
    """Publishes the reference, the law's terms and the observer's estimate at a limited rate."""

    def __init__(self, node: Node, joint: str, has_model: bool = False) -> None:
        rate = read_number(
            node,
            "introspection_rate",
            20.0,
            "Rate of ~/reference, ~/terms and ~/estimate [Hz]; 0 is off, negative is every sample",
            (-1e6, 1e6),
        )
        self._period_ns = round(NANOSECONDS / rate) if rate > 0.0 else 0
        self._is_on = rate != 0.0
        self._has_model = has_model
        self._last_ns: int | None = None
        if not self._is_on:
            return
        profile = OFFERED if rate < 0.0 else RARE  # each sample: as many may wait as states may
        self._reference = node.create_publisher(JointState, "~/reference", profile)
        self._terms = node.create_publisher(JointState, "~/terms", profile)
        self._estimate = node.create_publisher(JointState, "~/estimate", profile)
        self._estimate_template = JointStateTemplate(
            [joint], position=True, velocity=True, effort=True
        )
        self._reference_template = JointStateTemplate([joint], position=True, velocity=True)
        names = ["p", "i", "d", *(["model"] if has_model else []), "feedforward"]
        self._terms_template = JointStateTemplate(names, effort=True)

    def sample(self, stamp_ns: int, loop: JointLoop) -> None:
        """Publish this sample if it is due on the control clock."""
        if not self._is_on:
            return
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._period_ns:
            return
        self._last_ns = stamp_ns
        position, velocity = loop.reference
        self._reference.publish(
            self._reference_template.encode(stamp_ns, position=(position,), velocity=(velocity,))
        )
        model = (loop.model_effort,) if self._has_model else ()
        terms = (*loop.terms, *model, loop.feedforward_effort)
        self._terms.publish(self._terms_template.encode(stamp_ns, effort=terms))
        estimate = loop.estimate
        if estimate is not None:
            place, rate, disturbance = estimate
            self._estimate.publish(
                self._estimate_template.encode(
                    stamp_ns, position=(place,), velocity=(rate,), effort=(disturbance,)
                )
            )
