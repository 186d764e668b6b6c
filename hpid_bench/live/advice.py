"""Advice on staged parameters, computed in a process of lowest priority."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from hpid_ros.base.errors import HpidError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import LARGEST_MOTION, LoopSettings, Value
from hpid_ros.stability.certification import require_certifiable
from hpid_ros.stability.closed_loop import Certificate
from hpid_ros.stability.gain_check import LoopKind, certified_degrees, kind_of
from hpid_ros.stability.margins import loop_family, margins_of

SETTLED_SHARE = 0.02
"""Of a step, within which a response counts as settled."""

_LEAST_STEPS, _STEPS = 100, 3000  # of a response
_POINTS = 200  # of it that are drawn
_MODES = 12.0  # of the slowest mode of the linear loop
_LOST = 100.0  # steps from the start: it is unstable
_FREE = {
    "takeover_time": 0.0,
    "encoder_wrap": 0.0,
    "position_min": -LARGEST_MOTION,
    "position_max": LARGEST_MOTION,
}


@dataclass(frozen=True)
class IdealStepResponse:
    """The answer of an ideal joint, its inertia alone, to a step of its reference."""

    times: tuple[float, ...]  # [s]
    errors: tuple[float, ...]  # share of the step that is left
    settling: float  # [s] after which that stays within SETTLED_SHARE; inf if it does not
    overshoot: float  # share of the step


@dataclass(frozen=True)
class Advice:
    """What is known of one joint's settings."""

    interval: tuple[float, float] | None = None  # certified degrees
    reason: str = ""  # why no degree is certified
    phase: float = math.nan  # [deg] phase margin where the multiplier is 1
    delay: float = math.nan  # [s] delay margin there
    sensitivity: float = math.nan  # largest |S| there
    response: IdealStepResponse | None = None  # to a step; None where the inertia is not known
    is_pending: bool = False  # whether the certificate is still being looked for

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Advice:
        """Return the advice that came as JSON."""
        interval, response = values["interval"], values["response"]
        if response is not None:
            times, errors = (tuple(response[name]) for name in ("times", "errors"))
            response = IdealStepResponse(**{**response, "times": times, "errors": errors})
        return cls(**{**values, "interval": interval and tuple(interval), "response": response})


UNKNOWN_INERTIA = "the inertia is not known: set the parameter inertia, hpid identify finds it"

_Interval = tuple[float, float]


class Adviser:
    """Says what is known of settings, and remembers the certificates of loops of one kind."""

    def __init__(self) -> None:
        self._known: dict[LoopKind, _Interval | str] = {}

    def advise(self, settings: LoopSettings, step: float) -> Iterator[Advice]:
        """Yield what is known of settings at once, and then, where there may be one, the rest."""
        advice = self._without_certificate(settings, step)
        yield advice
        if advice.is_pending:
            found = self._degrees(settings)
            interval, reason = (None, found) if isinstance(found, str) else (found, "")
            yield replace(advice, interval=interval, reason=reason, is_pending=False)

    def _without_certificate(self, settings: LoopSettings, step: float) -> Advice:
        inertia = settings.plant_inertia
        if not inertia > 0.0:
            return Advice(reason=UNKNOWN_INERTIA)
        try:
            margins = margins_of(loop_family(settings, (inertia, inertia)).loop(inertia))
        except HpidError as error:
            return Advice(reason=str(error), is_pending=True)
        return Advice(
            None,
            "",
            math.degrees(margins.phase),
            margins.delay,
            margins.sensitivity,
            None if settings.model.is_on else response_to(settings, step),
            is_pending=True,
        )

    def _degrees(self, settings: LoopSettings) -> _Interval | str:
        inertia = settings.plant_inertia
        try:
            require_certifiable(settings.gains, inertia)
            kind = kind_of(settings, (inertia, inertia))
        except HpidError as error:
            return str(error)
        if kind not in self._known:
            (found,) = certified_degrees([(settings, (inertia, inertia))])
            if isinstance(found, Certificate):
                self._known[kind] = (found.lower, found.upper)
            else:
                self._known[kind] = str(found)
        return self._known[kind]


def response_to(settings: LoopSettings, step: float) -> IdealStepResponse:
    """Return the response of the loop itself, on a joint that is nothing but its inertia."""
    loop, inertia = JointLoop(settings.with_parameters(_FREE)), settings.plant_inertia
    period_ns = round(settings.timing.control_period * NANOSECONDS)
    period = period_ns / NANOSECONDS
    position = velocity = 0.0
    loop.step(0, position, velocity)
    loop.follow(Setpoint(step))
    errors = []
    for number in range(1, _count(settings, period) + 1):
        errors.append(1.0 - position / step)
        acceleration = loop.step(number * period_ns, position, velocity) / inertia
        position += period * velocity + 0.5 * period**2 * acceleration
        velocity += period * acceleration
        if not abs(position) < _LOST * abs(step):
            break
    times = [number * period for number in range(len(errors))]
    unsettled = [at for at, left in zip(times, errors, strict=True) if abs(left) > SETTLED_SHARE]
    settling = unsettled[-1] + period if unsettled[-1] < times[-1] else math.inf
    every = max(len(times) // _POINTS, 1)
    overshoot = max(0.0, -min(errors))
    return IdealStepResponse(tuple(times[::every]), tuple(errors[::every]), settling, overshoot)


def _count(settings: LoopSettings, period: float) -> int:
    """Return for how many periods to look: many times the slowest mode of the linear loop."""
    gains = settings.gains
    slow = gains.d / gains.p if gains.p else 0.0
    slower = gains.p / gains.i if gains.i else 0.0
    return int(min(_STEPS, max(_LEAST_STEPS, _MODES * max(slow, slower) / period)))


Hear = Callable[[Advice], None]

_LONG = 2.0  # [s] of a computation; one that nobody wants any more is then given up


class AdviceClient:
    """Asks the process, one question after the other.

    Of questions about the same thing that wait the newest is asked. The process is begun with the
    first question, and again if it has died.
    """

    def __init__(self, command: Sequence[str] = ()) -> None:
        self._command = [*command] or [
            "nice",
            "-n",
            "19",
            sys.executable,
            "-m",
            "hpid_bench.live.advice",
        ]
        self._waiting: dict[Hashable, tuple[Mapping[str, Value], float, Hear]] = {}
        self._has_work = threading.Condition()
        self._is_open = True
        self._child: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self._asked: Hashable = None
        self._asked_at = 0.0

    def ask(self, about: Hashable, values: Mapping[str, Value], step: float, hear: Hear) -> None:
        """Ask what is known of settings."""
        with self._has_work:
            self._waiting[about] = (dict(values), step, hear)
            is_old = time.monotonic() - self._asked_at > _LONG
            if self._asked == about and is_old and self._child is not None:
                self._child.kill()  # nobody wants to know any more
            if self._thread is None and self._is_open:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._has_work.notify()

    def close(self) -> None:
        with self._has_work:
            self._is_open = False
            self._has_work.notify()
            child = self._child
        if child is not None:
            child.kill()
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        while True:
            with self._has_work:
                self._has_work.wait_for(lambda: self._waiting or not self._is_open)
                if not self._is_open:
                    break
                about = next(iter(self._waiting))
                values, step, hear = self._waiting.pop(about)
                self._asked, self._asked_at = about, time.monotonic()
            try:
                self._answer({"values": values, "step": step}, hear)
            except (OSError, ValueError):  # it has died, was killed, or was never born
                self._end()
                if about not in self._waiting:
                    hear(Advice(reason="the computation failed"))
            self._asked = None
        self._end()

    def _answer(self, question: Mapping[str, Any], hear: Hear) -> None:
        """Hear what is known at once, and then the rest."""
        child = self._running()
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdin.write(json.dumps(question) + "\n")
        child.stdin.flush()
        is_pending = True
        while is_pending:
            advice = Advice.from_mapping(json.loads(child.stdout.readline()))
            is_pending = advice.is_pending
            hear(advice)

    def _running(self) -> subprocess.Popen[str]:
        with self._has_work:
            if not self._is_open:
                raise BrokenPipeError
            if self._child is None or self._child.poll() is not None:
                few = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
                self._child = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                    env={**os.environ, **few},
                    start_new_session=True,  # an interrupt of the terminal is not its business
                )
            return self._child

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):
                assert pipe is not None
                pipe.close()


def main() -> int:
    """Answer questions, a line each, until there are no more."""
    adviser = Adviser()
    for line in sys.stdin:
        question = json.loads(line)
        try:
            settings = LoopSettings.from_parameters(question["values"])
        except HpidError as error:
            _tell(Advice(reason=str(error)))
            continue
        for advice in adviser.advise(settings, float(question["step"])):
            _tell(advice)
    return 0


def _tell(advice: Advice) -> None:
    print(json.dumps(asdict(advice)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
