"""Who may see the page at all: a token, known hosts, one origin.

The page moves robots. It is told to people by an address with a token; the browser then keeps the
token as a cookie of this server alone. Another page in the same browser has neither the token nor
this origin, and a name that somebody has pointed at this address (DNS rebinding) is no host of it.

Sources: OWASP Cheat Sheet Series, "Cross-Site Request Forgery Prevention" (origin checks, SameSite
cookies) and "WebSocket Security"; RFC 6455, section 10.2.
"""

from __future__ import annotations

import hmac
import re
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, quote, urlencode

from hpid_ros.base.errors import SettingError

LOOPBACK = ("127.0.0.1", "localhost", "[::1]", "::1")
LEAST_TOKEN = 16
"""Characters of a token that somebody chooses."""

_TOKEN = re.compile(r"[A-Za-z0-9_-]+")

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_HEADERS = [
    (b"x-frame-options", b"DENY"),
    (b"content-security-policy", b"frame-ancestors 'none'; base-uri 'none'; form-action 'self'"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
]


def require_token(token: str) -> None:
    """Refuse a token that can be guessed, or that an address cannot hold."""
    if len(token) < LEAST_TOKEN or not _TOKEN.fullmatch(token):
        raise SettingError(
            f"a token must have {LEAST_TOKEN} characters at least, letters, digits, - and _ only"
        )


class Verdict(NamedTuple):
    """What is done with a request."""

    status: int  # 200 to pass it on, 303 to give the browser its cookie, else the refusal
    reason: str = ""  # one line for a refusal


_PASS, _WELCOME = Verdict(200), Verdict(303)


class Access:
    """Decides about requests."""

    def __init__(self, token: str, port: int, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self._token, self._port, self._hosts = token, port, hosts
        self.cookie = f"hpid_live_{port}"

    def judge(
        self,
        kind: str,
        method: str,
        host: str,
        origin: str | None,
        query: str,
        cookies: str,
    ) -> Verdict:
        """Decide about one request."""
        if not self._is_known(host):
            return Verdict(421, f"this server is not {host!r}")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return Verdict(403, "another page may not use this one")
        if origin is None and (kind == "websocket" or method not in ("GET", "HEAD")):
            return Verdict(403, "a request without an origin changes nothing")
        if self._has_cookie(cookies):
            return _PASS
        given = dict(parse_qsl(query)).get("token")
        if given is None or kind == "websocket" or method != "GET":
            return Verdict(401, "open the address with the token that hpid live has printed")
        return _WELCOME if self._is_token(given) else Verdict(401, "the token is wrong")

    def _is_known(self, host: str) -> bool:
        name, _, port = host.rpartition(":")
        if not name or host.endswith("]"):
            name, port = host, "80"
        return port == str(self._port) and (not self._hosts or name in self._hosts)

    def _has_cookie(self, cookies: str) -> bool:
        pairs = (each.strip().partition("=") for each in cookies.split(";"))
        return any(name == self.cookie and self._is_token(value) for name, _, value in pairs)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())

    @property
    def set_cookie(self) -> str:
        """Header that gives a browser its cookie: for no script, for no other site."""
        return f"{self.cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"


class Guard:
    """The server in front of which an :class:`Access` stands."""

    def __init__(self, app: App, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1"): text.decode("latin-1") for name, text in scope["headers"]
        }
        query = scope.get("query_string", b"").decode("latin-1")
        verdict = self._access.judge(
            scope["type"],
            scope.get("method", "GET"),
            headers.get("host", ""),
            headers.get("origin"),
            query,
            headers.get("cookie", ""),
        )
        if verdict is _PASS:
            await self._app(scope, receive, _hardened(scope["path"], send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": verdict.reason})
        elif verdict is _WELCOME:
            left = urlencode([each for each in parse_qsl(query) if each[0] != "token"])
            own = "/" + quote(scope["path"].lstrip("/"))  # two slashes would lead to another host
            place = own + (f"?{left}" if left else "")
            extra = {"location": place, "set-cookie": self._access.set_cookie}
            await _answer(send, 303, "", extra)
        else:
            await _answer(send, verdict.status, f"{verdict.reason}\n")


def _hardened(path: str, send: Send) -> Send:
    """Return a send that adds what browsers need to hear."""

    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            extra = [*_HEADERS]
            if not path.startswith("/_nicegui"):
                extra.append((b"cache-control", b"no-store"))
            message = {**message, "headers": [*message.get("headers", []), *extra]}
        await send(message)

    return sent


async def _answer(send: Send, status: int, text: str, extra: dict[str, str] | None = None) -> None:
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *_HEADERS]
    headers += [(b"cache-control", b"no-store")]
    headers += [(name.encode(), value.encode("latin-1")) for name, value in (extra or {}).items()]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": text.encode()})
