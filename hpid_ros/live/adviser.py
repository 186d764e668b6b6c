"""An adviser in a process of least priority: the newest question is answered, old ones dropped."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

from hpid_ros.base.errors import HpidError
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.table import Value
from hpid_ros.live.advice import Advice, Adviser

Hear = Callable[[Advice], None]

_LONG = 2.0  # [s] of a computation; one that nobody wants any more is then given up


class AdviceClient:
    """Asks the process, one question after the other.

    Of questions about the same thing that wait the newest is asked. The process is begun with the
    first question, and again if it has died.
    """

    def __init__(self, command: Sequence[str] = ()) -> None:
        self._command = [*command] or [
            *("nice", "-n", "19", sys.executable, "-m", "hpid_ros.live.adviser")
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
        """End the process."""
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
        step = float(question["step"])
        quick = adviser.quick(settings, step)
        _tell(quick)
        if quick.is_pending:
            _tell(adviser.advise(settings, step))
    return 0


def _tell(advice: Advice) -> None:
    print(json.dumps(advice.as_mapping()), flush=True)


if __name__ == "__main__":
    sys.exit(main())
