"""The page's server: a thread beside the nodes, behind a guard, with a stream of frames."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import secrets
import socket
import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from nicegui import Client, ui
from nicegui import app as pages

from hpid_ros.base.errors import SettingError
from hpid_ros.live.advice import AdviceClient
from hpid_ros.live.motion import HELD_WITHIN, HeldMotion
from hpid_ros.live.page.access import LOOPBACK, Access, Guard, require_token
from hpid_ros.live.page.view import PageView
from hpid_ros.live.session import LiveSession, Mark
from hpid_ros.live.trials import Stage, Starter, Trials

if TYPE_CHECKING:
    from hpid_ros.live.graph_client import GraphClient

ASSETS = Path(__file__).parent / "assets"

_IDLE_PERIOD = 0.5  # [s] between looks at the graph while nobody looks at the page
_COMES_BACK_WITHIN = 15.0  # [s] of a page that a busy computer has cut off
_BEHIND = 600  # frames that a page may be behind
_STARTS_WITHIN, _ENDS_WITHIN = 15.0, 3.0  # [s]


@dataclass(frozen=True)
class ServerSettings:
    """How the page is served."""

    host: str = "127.0.0.1"  # address to listen at
    port: int = 8080  # 0 chooses a free one
    token: str = ""  # that opens the page; empty draws one
    rate: float = 30.0  # frames a second
    button_timeout: float = HELD_WITHIN  # [s] without a word of a button that is held

    def __post_init__(self) -> None:
        """Refuse what is not safe."""
        if self.token:
            require_token(self.token)
        elif self.host not in LOOPBACK:
            raise SettingError(
                f"host {self.host} lets others on the network move this robot: give a token, "
                f"and let them reach it through an encrypted tunnel"
            )


class Served:
    """A page that is served."""

    def __init__(
        self,
        url: str,
        server: uvicorn.Server,
        thread: threading.Thread,
        trials: Trials,
        advice: AdviceClient,
    ) -> None:
        self.url = url
        self._server, self._thread = server, thread
        self._trials, self._advice = trials, advice

    @property
    def is_trying(self) -> bool:
        """Whether a trial is under way."""
        return self._trials.stage is not Stage.IDLE

    def cancel(self) -> None:
        """Have a trial end: joints come to rest, controllers get back what it has set."""
        self._trials.cancel()

    def stop(self) -> list[str]:
        """End the server and what it has begun; no parameter and no state is changed."""
        tried = self._trials.unfinished()
        self._trials.close()
        self._advice.close()
        self._server.should_exit = True
        self._thread.join(_ENDS_WITHIN)
        self._server.force_exit = True
        return tried


def serve(graph: GraphClient, settings: ServerSettings, start: Starter | None = None) -> Served:
    """Serve the page of a graph, in a thread of its own."""
    listener = _listener(settings)
    port = int(listener.getsockname()[1])
    token = settings.token or secrets.token_urlsafe(24)
    hosts = LOOPBACK if settings.host in LOOPBACK else ()
    advice = AdviceClient()
    session = LiveSession(graph, advice)
    within = settings.button_timeout
    trials = Trials(session, start or partial(HeldMotion, within=within), within)
    api = _api(trials, Frames(session, trials, 1.0 / settings.rate))
    pages.add_static_files("/assets", str(ASSETS))
    ui.run_with(
        api,
        root=lambda: PageView(session, trials),
        title="hpid live",
        dark=None,
        show_welcome_message=False,
        binding_refresh_interval=None,
        tailwind=False,
        reconnect_timeout=_COMES_BACK_WITHIN,
    )
    guard = Guard(api, Access(token, port, hosts))
    config = uvicorn.Config(
        guard,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    failures: list[BaseException] = []

    def run() -> None:
        try:
            asyncio.run(server.serve(sockets=[listener]))
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, name="page", daemon=True)
    thread.start()
    pause = threading.Event()
    for _ in range(round(_STARTS_WITHIN / 0.05)):
        if server.started or not thread.is_alive():
            break
        pause.wait(0.05)
    if not server.started:
        why = f": {failures[0]}" if failures else ""
        raise SettingError(f"the page's server did not start{why}")
    shown = "127.0.0.1" if settings.host in LOOPBACK else settings.host
    url = f"http://{shown}:{port}/?token={token}"
    return Served(url, server, thread, trials, advice)


def _listener(settings: ServerSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host.strip("[]"), settings.port))
    except (OSError, OverflowError) as error:
        listener.close()
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise SettingError(
            f"cannot serve at {settings.host}:{settings.port}: {why}; port 0 chooses a free one"
        ) from None
    return listener


def _api(trials: Trials, frames: Frames) -> FastAPI:
    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> Any:
        task = asyncio.create_task(frames.run())
        yield
        task.cancel()

    api = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)

    @api.websocket("/frames")
    async def stream(socket: WebSocket) -> None:
        await frames.stream(socket)

    @api.post("/stop")
    async def stop() -> dict[str, bool]:
        return {"stopped": await trials.stop()}

    return api


class Frames:
    """What every page is sent, many times a second; and what comes back while a button is held."""

    def __init__(self, session: LiveSession, trials: Trials, period: float) -> None:
        self._session, self._trials, self._period = session, trials, period
        self._viewers: dict[asyncio.Queue[str], str] = {}

    async def run(self) -> None:
        """Send frames, for ever."""
        marked = 0
        while True:
            began = asyncio.get_running_loop().time()
            # Beside this loop, so that a button that is held is heard meanwhile.
            samples = await asyncio.to_thread(self._session.graph.take)
            curves = self._session.pulse(bool(self._viewers), samples)
            fresh = [each for each in self._session.marks if each.number > marked]
            marked = fresh[-1].number if fresh else marked
            if self._viewers:
                self._tell(curves, [_plain(each) for each in fresh])
            period = self._period if self._viewers else _IDLE_PERIOD
            spent = asyncio.get_running_loop().time() - began
            await asyncio.sleep(max(period - spent, 0.2 * period))

    def _tell(self, curves: dict[str, dict[str, list[float]]], marks: list[Any]) -> None:
        now = {node: self._session.history(node).now for node in curves}
        usable = {node: at for node, at in now.items() if at > float("-inf")}
        text = json.dumps({"now": usable, "curves": curves, "marks": marks})
        for queue in list(self._viewers):
            try:
                queue.put_nowait(text)
            except asyncio.QueueFull:  # it is gone, or asleep: it comes back by itself
                self._viewers.pop(queue)

    async def stream(self, socket: WebSocket) -> None:
        """Send frames to one page, and take what it sends, until it goes."""
        page = socket.query_params.get("page", "")
        if page not in Client.instances:
            await socket.close(1008, "no such page")
            return
        await socket.accept()
        self._session.control_lock.join(page)
        queue: asyncio.Queue[str] = asyncio.Queue(_BEHIND)
        self._viewers[queue] = page
        sending = asyncio.create_task(self._send(socket, queue))
        try:
            while True:
                self._take(page, await socket.receive_text())
        except (WebSocketDisconnect, RuntimeError, KeyError):
            pass
        finally:
            sending.cancel()
            self._viewers.pop(queue, None)
            self._trials.release(page)
            self._session.control_lock.leave(page)

    def _take(self, page: str, text: str) -> None:
        if text == "hold" and self._session.control_lock.holds(page):
            self._trials.press(page)
        elif text == "release":
            self._trials.release(page)

    async def _send(self, socket: WebSocket, queue: asyncio.Queue[str]) -> None:
        while True:
            text = await queue.get()
            if queue not in self._viewers and queue.empty():
                await socket.close()
                return
            await socket.send_text(text)


def _plain(mark: Mark) -> dict[str, Any]:
    time = mark.time if math.isfinite(mark.time) else None
    return {**mark._asdict(), "time": time}
