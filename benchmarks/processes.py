"""Scripts of this folder as child processes that never outlive their parent."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from hpid_bench.experiment.forking import Beginning
from hpid_bench.experiment.processes import end_all
from hpid_ros.base.errors import RunError, SettingError
from hpid_ros.base.processes import heed_interrupts, raise_if_interrupted, uninterrupted

ROOT = Path(__file__).resolve().parents[1]

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130  # exit codes


def exit_code(name: str, run: Callable[[], int]) -> int:
    """Return the exit code of a command, whose failure or interrupt is one line."""
    heed_interrupts()
    try:
        return run()
    except SettingError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except RunError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


_PATIENCE = 3.0  # [s] for all to end when asked
_LOOK_EVERY = 0.2  # [s]


class Scripts:
    """Runs modules of ``benchmarks.nodes`` and ends all of them, whatever happens."""

    def __init__(
        self,
        environment: Mapping[str, str],
        logs: Path,
        *,
        is_batch: bool = False,
    ) -> None:
        self._begin = Beginning(signal.SIGKILL, is_batch)
        self._environment = dict(environment)
        self._environment["PYTHONPATH"] = os.pathsep.join(
            [str(ROOT), *filter(None, [environment.get("PYTHONPATH")])]
        )
        self._logs = logs
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, module: str, arguments: Sequence[str]) -> None:
        """Start a script."""
        with uninterrupted(), (self._logs / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", f"benchmarks.nodes.{module}", *arguments],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
                start_new_session=True,
                preexec_fn=self._begin,
            )

    def result(self, name: str, within: float) -> dict[str, Any]:
        """Wait for the line that a script prints at its end."""
        output = self.processes[name].stdout
        assert output is not None
        deadline = time.monotonic() + within
        with selectors.DefaultSelector() as selector:
            selector.register(output, selectors.EVENT_READ)
            while not selector.select(_LOOK_EVERY):
                raise_if_interrupted()
                self._require_alive()
                if time.monotonic() > deadline:
                    raise RunError(f"waited {within:g} s in vain for the result of {name}")
        line = output.readline()
        if not line:
            self.processes[name].wait()
            self._require_alive()
            raise RunError(f"{name} ended without a result")
        return dict(json.loads(line))

    def _require_alive(self) -> None:
        for name, process in self.processes.items():
            code = process.poll()
            if code:
                raise RunError(f"{name} ended with code {code}: {self._last_words(name)}")

    def _last_words(self, name: str) -> str:
        lines = (self._logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"

    def __enter__(self) -> Scripts:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        end_all(self.processes.values(), _PATIENCE)
        for process in self.processes.values():
            if process.stdout is not None:
                process.stdout.close()
