"""What a loop follows: the motion it was told, and where the reference stands."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.control.motions import Glide, Motion, Reference, Setpoint, Turned


class Following:
    """Turns motions into the reference of each sample.

    Attributes:
        motion: What is followed; None while the joint is held where it was.
        position: The reference's position of the last sample in [rad].
        velocity: Its velocity in [rad/s].
        turn: A motion that is taken up may be told as many turns away as bring it nearest to
            the reference, in [rad]; 0 takes it as it is told.
    """

    __slots__ = (
        *("_glide_end_ns", "_pending", "_reference"),
        *("motion", "position", "turn", "velocity"),
    )

    def __init__(self) -> None:
        self.motion: Motion | None = None
        self.turn = 0.0
        self.restart()

    @property
    def is_standing(self) -> bool:
        """Whether there is a reference; the first state makes one."""
        return self._reference is not None

    def follow(self, motion: Motion | None) -> None:
        """Follow a motion from the next sample on; None forgets what was followed."""
        self.motion = self._pending = motion

    def restart(self) -> None:
        """Forget where the reference stands, and start the motion anew."""
        self._pending = self.motion
        self._reference: Reference | None = None
        self._glide_end_ns: int | None = None
        self.position = self.velocity = 0.0

    def stand(self, position: float) -> None:
        """Hold a position until there is a motion.

        Args:
            position: In [rad].
        """
        self._reference, self._glide_end_ns = Setpoint(position), None
        self.position, self.velocity = position, 0.0

    def take_over(self, stamp_ns: int, position: float, duration: float) -> None:
        """Start from a position again, and glide onto what is followed.

        Args:
            stamp_ns: The control clock in [ns].
            position: Where the joint is in [rad].
            duration: How long the glide takes in [s]; 0 jumps.
        """
        onto = self._onto()
        self.stand(position)
        if self.motion is not None and self._pending is None:
            onto = _turned(onto, self._turns_to(onto.sample(stamp_ns)[0]))
            self._glide(onto, stamp_ns, position, 0.0, duration)

    def sample(self, stamp_ns: int, duration: float) -> Sequence[float]:
        """Return the reference of a sample; there must be one.

        Args:
            stamp_ns: The control clock in [ns].
            duration: How long a glide takes that begins now, in [s].
        """
        if self._pending is not None:
            self._begin(self._pending, stamp_ns, duration)
        elif self._glide_end_ns is not None and stamp_ns >= self._glide_end_ns:
            self._reference, self._glide_end_ns = self._onto(), None
        return self._reference.sample(stamp_ns)  # type: ignore[union-attr]

    def _begin(self, motion: Motion, stamp_ns: int, duration: float) -> None:
        """Turn to a motion: from where the reference stands, or onto it if it is under way."""
        before = self._reference
        assert before is not None
        self._pending = None
        offset = self._turns_to(motion.target(stamp_ns)) if self.turn else 0.0
        onto = _turned(motion.start(stamp_ns, self.position - offset, self.velocity), offset)
        self._reference, self._glide_end_ns = onto, None
        if motion.is_under_way(stamp_ns):
            position, velocity = before.sample(stamp_ns)[:2]
            self._glide(onto, stamp_ns, position, velocity, duration)

    def _turns_to(self, target: float) -> float:
        """Return the whole turns from a target to the reference, in [rad]."""
        return self.turn * round((self.position - target) / self.turn) if self.turn else 0.0

    def _onto(self) -> Reference:
        """Return the reference that is followed in the end."""
        reference = self._reference
        assert reference is not None
        return reference.onto if isinstance(reference, Glide) else reference

    def _glide(
        self, onto: Reference, stamp_ns: int, position: float, velocity: float, duration: float
    ) -> None:
        """Follow a reference, gliding onto it if it is elsewhere."""
        self._reference, self._glide_end_ns = onto, None
        if duration > 0.0 and tuple(onto.sample(stamp_ns)[:2]) != (position, velocity):
            glide = Glide(onto, stamp_ns, position, velocity, duration)
            self._reference, self._glide_end_ns = glide, glide.end_ns


def _turned(onto: Reference, offset: float) -> Reference:
    """Return a reference so many rad further."""
    if offset == 0.0:
        return onto
    if isinstance(onto, Turned):
        return Turned(onto.onto, onto.offset + offset)
    return Turned(onto, offset)
