"""Batches on the workers of a Dask scheduler: tasks out, outcomes as they come."""

from __future__ import annotations

import asyncio
import queue
import re
import warnings
from collections.abc import Sequence
from concurrent.futures import CancelledError
from types import TracebackType
from typing import Any

from hpid_ros.base.errors import RunError, SettingError
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.experiment.batch import Outcomes, RunTask
from hpid_ros.experiment.cluster_worker import Parcel, differences, pack, traits, work

_ADDRESS = re.compile(
    r"(?:(?:tcp|tls)://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]+):(?P<port>\d{1,5})"
)
_LARGEST_PORT = 65_535
_ANSWERS_WITHIN = 10.0  # [s]
_LOOKS_EVERY = 0.2  # [s] for an interrupt, and whether the scheduler is there


class Cluster:
    """The workers of a scheduler. It runs batches: call it with tasks.

    A worker that is lost gives its runs to the others; a worker that comes later takes part.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client = _connect(address)
        try:
            self._require_equals()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __str__(self) -> str:
        workers = self._workers()
        threads = sum(each["nthreads"] for each in workers.values())
        count = f"{len(workers)} worker{'s' * (len(workers) != 1)}" if workers else "no worker yet"
        at_once = f", {threads} runs at once" if workers else ""
        has_page = "dashboard" in self._client.scheduler_info()["services"]
        page = f"; dashboard: {self._client.dashboard_link}" if has_page else ""
        return f"{count} at {self._address}{at_once}{page}"

    def __call__(self, tasks: Sequence[RunTask]) -> Outcomes:
        """Run tasks, as :func:`~hpid_ros.experiment.batch.run_batch` does."""
        packed, parcel = pack(tasks)
        if not packed:
            return
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        futures = self._submit(packed, parcel)
        try:
            for future in futures:
                future.add_done_callback(ended.put)
            left = len(futures)
            while left:
                raise_if_interrupted()
                try:
                    future = ended.get(timeout=_LOOKS_EVERY)
                except queue.Empty:
                    self._require_scheduler(left)
                    continue
                left -= 1
                yield self._outcome(future, tasks[futures[future]], left)
                future.release()
        finally:
            self._cancel(list(futures))

    def _submit(self, tasks: Sequence[RunTask], parcel: Parcel) -> dict[Any, int]:
        # A task of its own, so that a worker that has lost the parcel is given it again.
        files = self._client.submit(Parcel, parcel.files, key=f"hpid-files-{parcel.name}")
        options = {"pure": False, "key": None}
        return {
            self._client.submit(
                work, files, traits((task.world.engine,)), place, task, **options
            ): place
            for place, task in enumerate(tasks)
        }

    def _outcome(self, future: Any, task: RunTask, left: int) -> Any:
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker:
            raise RunError(
                f"{task.label}: every worker that took this run was lost; --resume carries a "
                "study on"
            ) from None
        except RunError as error:
            raise RunError(f"a worker at {self._address} cannot take part: {error}") from None
        except (CancelledError, asyncio.CancelledError):
            raise self._lost(left + 1) from None

    def _require_scheduler(self, left: int) -> None:
        if self._client.status not in ("running", "connecting"):
            raise self._lost(left)

    def _lost(self, left: int) -> RunError:
        return RunError(
            f"the scheduler at {self._address} is lost, and {left} runs with it; --resume carries "
            "a study on"
        )

    def _require_equals(self) -> None:
        """Look at the workers that are there; those that come later are looked at as they work."""
        for address, found in self._client.run(traits, ()).items():
            unlike = differences(traits(()), found)
            if unlike:
                raise RunError(f"the worker at {address} cannot take part: it has {unlike}")

    def _workers(self) -> dict[str, Any]:
        return dict(self._client.scheduler_info(n_workers=-1)["workers"])

    def _cancel(self, futures: list[Any]) -> None:
        if self._client.status == "running":
            self._client.cancel(futures)

    def close(self) -> None:
        """Let go of the scheduler; runs that workers have begun end by themselves."""
        self._client.close(timeout=2)


def _connect(address: str) -> Any:
    place = _ADDRESS.fullmatch(address)
    if not place or int(place["port"]) > _LARGEST_PORT:
        raise SettingError(f"--scheduler must be tcp://HOST:PORT, not {address!r}")
    try:
        from distributed import Client
    except ImportError as error:
        raise SettingError(
            f"--scheduler needs Dask ({error}): pip install 'hpid_ros[cluster]'"
        ) from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions, which are compared here
        try:
            # First, because a client that meets no scheduler waits long, also to end.
            asyncio.run(asyncio.wait_for(_identity(address), _ANSWERS_WITHIN))
            connect: Any = Client
            return connect(address, timeout=_ANSWERS_WITHIN, set_as_default=False, name="hpid")
        except OSError:
            raise RunError(
                f"no Dask scheduler answers at {address} within {_ANSWERS_WITHIN:g} s"
            ) from None


async def _identity(address: str) -> None:
    """Ask who is there."""
    from distributed.core import rpc

    connect: Any = rpc
    remote = connect(address, timeout=_ANSWERS_WITHIN)
    try:
        kind = (await remote.identity())["type"]
    finally:
        await remote.close_rpc()
    if kind != "Scheduler":
        raise RunError(f"at {address} is no scheduler of Dask, but a {kind.lower()}")
