"""Certified degrees of a running loop, computed in a child process and remembered.

The child, ``python -m hpid_ros.stability.certifier < parameters.json``, certifies one loop: its
parameters as JSON in, ``{"lower": .., "upper": ..}`` or ``{"reason": ..}`` out.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Hashable
from typing import NamedTuple

from hpid_ros.base.errors import HpidError
from hpid_ros.control.settings import LoopSettings

_REMEMBERED = 1000  # loops, the oldest are forgotten
_SEARCH = [sys.executable, "-m", "hpid_ros.stability.certifier"]
_LAST = 19  # nice: beside running loops, the search takes what they leave


class CertificationFinding(NamedTuple):
    """What is known of a loop's degree."""

    is_certified: bool | None  # True, False, or None while it is not known
    text: str  # for people: the certified degrees, or why there are none or nothing is known


class Certifier:
    """Certifies settings in a child process, one after the other.

    Its priority is the least, so that running loops lose nothing: on a machine that is loaded
    fully its seconds become minutes. Who waits for it has ordinary priority. What does not depend
    on the degree is remembered: a new degree is judged at once. A computation that cannot be begun
    or has been killed is a finding like another: it never raises.
    """

    def __init__(self) -> None:
        self._niceness = _LAST
        self._known: dict[Hashable, tuple[float, float] | str] = {}
        self._child: subprocess.Popen[str] | None = None
        self._child_of: Hashable = None
        self._wanted: LoopSettings | None = None

    def finding(self, settings: LoopSettings) -> CertificationFinding:
        """Say what is known now, without waiting."""
        if settings.plant_inertia == 0.0:
            return CertificationFinding(None, "unknown: the inertia is not given")
        if settings.degree == 0.0:
            return CertificationFinding(True, "linear, stable by Routh and Hurwitz")
        known = self._known.get(_key(settings))
        if known is None:
            return CertificationFinding(None, "being computed")
        if isinstance(known, str):
            return CertificationFinding(False, f"none: {known}")
        lower, upper = known
        return CertificationFinding(lower <= settings.mu <= upper, f"{lower:+.3f} to {upper:+.3f}")

    def want(self, settings: LoopSettings) -> None:
        """Begin to find out, after what is being found out now; the newest wish counts."""
        is_open = self.finding(settings).is_certified is None and settings.plant_inertia > 0.0
        self._wanted = settings if is_open and _key(settings) != self._child_of else None
        self.poll()

    def poll(self) -> bool:
        """Collect what is done and begin what is wanted."""
        has_news = False
        if self._child is not None and self._child.poll() is not None:
            self._collect()
            has_news = True
        if self._child is None and self._wanted is not None:
            self._begin(self._wanted)
            self._wanted = None
        return has_news

    def wait(self, settings: LoopSettings) -> CertificationFinding:
        """Find out now, however long it takes: for a loop that has not begun."""
        self._niceness = 0
        self.want(settings)
        while self._child is not None:
            self._child.wait()
            self.poll()
        self._niceness = _LAST
        return self.finding(settings)

    def close(self) -> None:
        """End what is being computed."""
        child, self._child = self._child, None
        if child is not None:
            assert child.stdout is not None
            child.kill()
            child.wait()
            child.stdout.close()

    def _begin(self, settings: LoopSettings) -> None:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        try:
            self._child = subprocess.Popen(
                # nice from outside: its imports, too, come after the loop.
                ["nice", "-n", str(self._niceness), *_SEARCH],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env=environment,
            )
        except OSError as error:  # no memory, no more processes
            self._learn(_key(settings), f"the computation could not begin: {error.strerror}")
            return
        self._child_of = _key(settings)
        assert self._child.stdin is not None
        # Its exit code shows a child that died before it could read.
        with contextlib.suppress(BrokenPipeError), self._child.stdin as stdin:
            json.dump(settings.to_parameters(), stdin)

    def _collect(self) -> None:
        child, self._child = self._child, None
        assert child is not None
        assert child.stdout is not None
        text = child.stdout.read()
        child.stdout.close()
        try:
            answer = json.loads(text)
        except json.JSONDecodeError:  # it was killed
            answer = {"reason": "the computation failed"}
        if "reason" in answer:
            self._learn(self._child_of, str(answer["reason"]))
        else:
            self._learn(self._child_of, (float(answer["lower"]), float(answer["upper"])))
        self._child_of = None

    def _learn(self, key: Hashable, known: tuple[float, float] | str) -> None:
        self._known[key] = known
        if len(self._known) > _REMEMBERED:
            del self._known[next(iter(self._known))]


def _key(settings: LoopSettings) -> Hashable:
    """Return everything that a certificate depends on but the degree."""
    return settings.gains, settings.norm_family, settings.plant_inertia


def main() -> int:
    # Imported here: a node that asks does not wait for the search.
    from hpid_ros.stability.certificate_search import certified_degree_interval

    try:
        settings = LoopSettings.from_parameters(json.load(sys.stdin))
        interval = certified_degree_interval(
            settings.gains, settings.norm_family, settings.plant_inertia
        )
    except HpidError as error:
        answer: dict[str, object] = {"reason": str(error)}
    else:
        answer = {"lower": interval.lower, "upper": interval.upper}
    print(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
