"""The page's server: who may see it, a thread next to the nodes, a stream of frames.

The page moves robots. People open it by an address with a token; the browser then keeps the
token as a cookie of this host, with all its ports. Another page in the same browser has neither
the token nor this origin, and a name that somebody has pointed at this address (DNS rebinding) is
no host of it. Who only connects, or sends no token, holds a place for seconds, and keeps nobody
out: a page that is open can always stop the robot.

Sources: OWASP Cheat Sheet Series, "Cross-Site Request Forgery Prevention" (origin checks, SameSite
cookies), "WebSocket Security" and "Content Security Policy"; RFC 6455, section 10.2; uvicorn's
issue 157 (it has no deadline of its own for the headers of a request).
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import math
import re
import resource
import secrets
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode

import uvicorn
from fastapi import FastAPI, Request, WebSocket, WebSocketDisconnect
from nicegui import Client, background_tasks, ui
from nicegui import app as pages
from nicegui.client import templates
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from uvicorn.protocols.http.auto import AutoHTTPProtocol
from uvicorn.protocols.utils import get_remote_addr

from hpid_bench.live.advice import AdviceClient
from hpid_bench.live.known_controllers import Change
from hpid_bench.live.motion import HELD_WITHIN
from hpid_bench.live.page.view import PageView
from hpid_bench.live.session import LiveSession, values_line
from hpid_bench.live.trials import Trials
from hpid_ros.base.errors import SettingError

if TYPE_CHECKING:
    from hpid_bench.live.graph_client import GraphClient

LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")
_LEAST_TOKEN = 16  # characters of a token that somebody chooses
_TOKEN = re.compile(r"[A-Za-z0-9_-]+")
_ASSETS = Path(__file__).parent / "assets"
_IDLE_PERIOD = 0.5  # [s] between looks at the graph while nobody looks at the page
_COMES_BACK_WITHIN = 15.0  # [s] of a page that a busy computer has cut off
_BEHIND = 600  # frames that a page may be behind
_STARTS_WITHIN, _ENDS_WITHIN, _LOOK_PERIOD = 15.0, 3.0, 0.05  # [s]

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

_HEADERS = {
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}
_NOT_KEPT = {"cache-control": "no-store"}
_POLICY = (
    "default-src 'none'; "
    # NiceGUI evaluates what its server sends, and Vue compiles templates: not without unsafe-eval.
    "script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src 'self' data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'"
)
_NONCE = "content_policy_nonce"  # in a request's scope, and in NiceGUI's template
_NONCE_BYTES = 16


@cache
def _give_nonces() -> None:
    """Have the inline scripts of NiceGUI's own templates allowed, and none that is in their data.

    Its templates have no place for a nonce: they get one where they are loaded.
    """
    loader = templates.env.loader
    assert loader is not None
    read = loader.get_source

    def with_nonces(environment: Any, template: str) -> Any:
        source, *rest = read(environment, template)
        return source.replace("<script", f'<script nonce="{{{{ {_NONCE} }}}}"'), *rest

    vars(loader)["get_source"] = with_nonces
    templates.context_processors.append(lambda request: {_NONCE: request.scope.get(_NONCE, "")})


def require_token(token: str) -> None:
    """Refuse a token that can be guessed, or that an address cannot hold."""
    if len(token) < _LEAST_TOKEN or not _TOKEN.fullmatch(token):
        raise SettingError(
            f"a token must have {_LEAST_TOKEN} characters at least, letters, digits, - and _ only"
        )


_LONGEST_HEADERS = 5.0  # [s] from a connection to a request with the token
_MOST_NEWCOMERS = 256  # connections without one
_ACCEPTED_AT_ONCE = 32  # so that one is heard before so many newer ones take its place
_QUEUE = 2048  # connections that the kernel keeps until they are accepted
_DESCRIPTORS = 4096  # that this process may have open, where it may choose


class Newcomers:
    """Connections that have not sent the token: few, and not for long.

    When one more comes than there may be, the oldest is dropped: the one that says nothing.
    """

    def __init__(self, most: int = _MOST_NEWCOMERS, within: float = _LONGEST_HEADERS) -> None:
        self._most, self._within = most, within
        self._waiting: dict[object, tuple[asyncio.Transport, asyncio.TimerHandle]] = {}

    def enter(self, transport: asyncio.Transport) -> None:
        """Take note of a connection, which has some time from now on."""
        peer = get_remote_addr(transport)
        self.leave(peer)  # a closed one, which had this port
        timer = asyncio.get_running_loop().call_later(self._within, self._drop, peer)
        self._waiting[peer] = transport, timer
        while len(self._waiting) > self._most:
            self._drop(next(iter(self._waiting)))

    def leave(self, peer: object) -> None:
        """Forget a connection: it has closed, or has sent the token and may stay."""
        if peer in self._waiting:
            self._waiting.pop(peer)[1].cancel()

    def _drop(self, peer: object) -> None:
        transport = self._waiting[peer][0]
        self.leave(peer)
        transport.abort()

    def protocol(self) -> type[asyncio.Protocol]:
        """Return uvicorn's protocol, whose connections are noted here."""
        newcomers = self

        class Noted(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
            def connection_made(self, transport: asyncio.Transport) -> None:
                super().connection_made(transport)
                newcomers.enter(transport)

            def connection_lost(self, error: Exception | None) -> None:
                newcomers.leave(self.client)
                super().connection_lost(error)

        return Noted


def _raise_descriptors() -> None:
    """Let this process have more files and connections open, where it may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class Guard:
    """Lets requests through to an application, or refuses them."""

    def __init__(
        self,
        app: Callable[..., Any],
        token: str,
        port: int,
        hosts: tuple[str, ...] = LOOPBACK,
        newcomers: Newcomers | None = None,
    ) -> None:
        self._app, self._token, self._port, self._hosts = app, token, port, hosts
        self._newcomers = Newcomers() if newcomers is None else newcomers
        self._cookie = f"hpid_live_{port}"

    def judge(
        self, kind: str, method: str, host: str, origin: str | None, query: str, cookies: str
    ) -> tuple[int, str]:
        """Return 200 to pass a request on, 303 to set the cookie, else the refusal and why."""
        if not self._is_known(host):
            return 421, f"this server is not {host!r}"
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return 403, "another page may not use this one"
        if origin is None and (kind == "websocket" or method not in ("GET", "HEAD")):
            return 403, "a request without an origin changes nothing"
        pairs = (each.strip().partition("=") for each in cookies.split(";"))
        if any(name == self._cookie and self._is_token(value) for name, _, value in pairs):
            return 200, ""
        given = dict(parse_qsl(query)).get("token")
        if given is None or kind == "websocket" or method != "GET":
            return 401, "open the address with the token that hpid live has printed"
        return (303, "") if self._is_token(given) else (401, "the token is wrong")

    def _is_known(self, host: str) -> bool:
        name, _, port = host.rpartition(":")
        if not name or host.endswith("]"):
            name, port = host, "80"
        return port == str(self._port) and (not self._hosts or name in self._hosts)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())

    async def __call__(self, scope: Scope, receive: Callable[..., Any], send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        query = scope.get("query_string", b"").decode("latin-1")
        status, reason = self.judge(
            scope["type"],
            scope.get("method", "GET"),
            headers.get("host", ""),
            headers.get("origin"),
            query,
            headers.get("cookie", ""),
        )
        if status in (200, 303):
            self._newcomers.leave(scope.get("client"))
        nonce = secrets.token_urlsafe(_NONCE_BYTES)
        own = {**_HEADERS, "content-security-policy": _POLICY.format(nonce=nonce)}
        if status == 200:
            scope[_NONCE] = nonce
            await self._app(scope, receive, _hardened(scope["path"], own, send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": reason})
        else:
            reply = {**own, **_NOT_KEPT}
            if status == 303:
                left = urlencode([each for each in parse_qsl(query) if each[0] != "token"])
                path = "/" + quote(scope["path"].lstrip("/"))  # two slashes lead to another host
                reply["location"] = path + (f"?{left}" if left else "")
                reply["set-cookie"] = (
                    f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
                )
            answer = PlainTextResponse(reason and f"{reason}\n", status, reply)
            await answer(scope, receive, send)


def _hardened(path: str, own: Mapping[str, str], send: Send) -> Send:
    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(own)
            if not path.startswith("/_nicegui"):
                headers.update(_NOT_KEPT)
        await send(message)

    return sent


class PageServer:
    """Serves the page of a graph, in a thread of its own."""

    def __init__(
        self,
        graph: GraphClient,
        host: str = "127.0.0.1",
        port: int = 8080,  # 0 chooses a free one
        token: str = "",  # empty draws one
        rate: float = 30.0,  # frames a second
        button_timeout: float = HELD_WITHIN,  # [s] without a word of a button that is held
    ) -> None:
        is_own = host in LOOPBACK
        if token:
            require_token(token)
        elif not is_own:
            raise SettingError(
                f"host {host} lets others on the network move this robot: give a token, "
                f"and let them reach it through an encrypted tunnel"
            )
        listener = _listener(host, port)
        address, port = listener.getsockname()[:2]
        token = token or secrets.token_urlsafe(24)
        self._advice = AdviceClient()
        session = LiveSession(graph, self._advice)
        self.trials = trials = Trials(session, button_timeout)
        api = _api(trials, Frames(session, trials, 1.0 / rate))
        _give_nonces()
        _raise_descriptors()
        pages.add_static_files("/assets", str(_ASSETS))
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
        newcomers = Newcomers()
        guard = Guard(api, token, port, LOOPBACK if is_own else (), newcomers)
        self._server = uvicorn.Server(
            uvicorn.Config(
                guard,
                http=newcomers.protocol(),
                backlog=_ACCEPTED_AT_ONCE,
                proxy_headers=False,  # with them anybody here is anybody
                log_level="warning",
                access_log=False,
                timeout_graceful_shutdown=1,
            )
        )
        name = f"[{address}]" if ":" in address else address
        self.url = f"http://{name}:{port}/?token={token}"
        self._failure = ""
        self._thread = threading.Thread(
            target=self._run, args=(listener,), name="page", daemon=True
        )
        self._thread.start()
        deadline = time.monotonic() + _STARTS_WITHIN
        while not self._server.started and self._thread.is_alive() and time.monotonic() < deadline:
            self._thread.join(_LOOK_PERIOD)
        if not self._server.started:
            raise SettingError(f"the page's server did not start{self._failure}")
        listener.listen(_QUEUE)  # asyncio accepts as many at once as it was to let wait

    def _run(self, listener: socket.socket) -> None:
        try:
            asyncio.run(self._server.serve(sockets=[listener]))
        except BaseException as error:
            self._failure = f": {error}"

    def stop(self) -> list[str]:
        """End the server and what it has begun; no parameter and no state is changed."""
        tried = self.trials.unfinished()
        self.trials.close()
        self._advice.close()
        self._server.should_exit = True
        self._thread.join(_ENDS_WITHIN)
        self._server.force_exit = True
        return tried


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host.strip("[]"), port))
    except (OSError, OverflowError) as error:
        listener.close()
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise SettingError(
            f"cannot serve at {host}:{port}: {why}; port 0 chooses a free one"
        ) from None
    return listener


def _api(trials: Trials, frames: Frames) -> FastAPI:
    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> Any:
        task = asyncio.create_task(frames.run())
        yield
        task.cancel()

    api = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    api.add_api_websocket_route("/frames", frames.stream)

    @api.post("/stop")
    async def stop(request: Request) -> dict[str, bool]:
        at = request.client.host if request.client else "an unknown address"
        return {"stopped": await trials.stop(f"a page at {at}")}

    return api


class Frames:
    """What every page is sent, many times a second; and what comes back while a button is held."""

    def __init__(self, session: LiveSession, trials: Trials, period: float) -> None:
        self._session, self._trials, self._period = session, trials, period
        self._viewers: dict[asyncio.Queue[str], str] = {}
        self._failure = ""  # of a pulse, said once

    async def run(self) -> None:
        while True:
            began = asyncio.get_running_loop().time()
            # Beside this loop, so that a button that is held is heard meanwhile.
            samples = await asyncio.to_thread(self._session.graph.take)
            try:
                curves, changes = self._session.pulse(bool(self._viewers), samples)
            except Exception as error:  # pages go on: what they cannot show can still be stopped
                curves, changes, failure = {}, [], repr(error)
                if failure != self._failure:
                    self._failure = failure
                    self._session.say(f"nothing can be drawn: {failure}", is_bad=True)
            if self._viewers:
                self._tell(curves, changes)
            period = self._period if self._viewers else _IDLE_PERIOD
            spent = asyncio.get_running_loop().time() - began
            await asyncio.sleep(max(period - spent, 0.2 * period))

    def _tell(self, curves: dict[str, dict[str, list[float]]], changes: list[Change]) -> None:
        now = {node: self._session.history(node).now for node in curves}
        usable = {node: at for node, at in now.items() if at > float("-inf")}
        marks = [
            {"node": each.node, "time": each.time, "text": values_line(each.values)}
            for each in changes
            if math.isfinite(each.time)
        ]
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
        self._session.control_lock.join(page, socket.client.host if socket.client else "")
        queue: asyncio.Queue[str] = asyncio.Queue(_BEHIND)
        self._viewers[queue] = page
        sending = asyncio.create_task(self._send(socket, queue))
        try:
            while True:
                self._take(page, await socket.receive_text(), queue)
        except (WebSocketDisconnect, RuntimeError, KeyError):
            pass
        finally:
            sending.cancel()
            self._viewers.pop(queue, None)
            self._trials.release(page)
            self._session.control_lock.leave(page)

    def _take(self, page: str, text: str, answers: asyncio.Queue[str]) -> None:
        if text == "stop":
            background_tasks.create(self._stop(page, answers))
        elif text == "hold" and self._session.control_lock.holder == page:
            self._trials.press(page)
        elif text == "release":
            self._trials.release(page)

    async def _stop(self, page: str, answers: asyncio.Queue[str]) -> None:
        is_stopped = await self._trials.stop(self._session.control_lock.name(page))
        with contextlib.suppress(asyncio.QueueFull):
            answers.put_nowait(json.dumps({"stopped": is_stopped}))

    async def _send(self, socket: WebSocket, queue: asyncio.Queue[str]) -> None:
        while True:
            text = await queue.get()
            if queue not in self._viewers and queue.empty():
                await socket.close()
                return
            await socket.send_text(text)
