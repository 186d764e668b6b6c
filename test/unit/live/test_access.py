"""Only who has the token, at this host and from this page, gets in."""

import asyncio
import socket
from urllib.parse import urlsplit

import pytest
from harness.simulated_graph import SimulatedGraph, arm
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.live.page.server import Guard, Newcomers, PageServer, require_token
from hpid_ros.base.errors import SettingError

TOKEN = "correct-horse-battery"
HOST = "127.0.0.1:8080"
COOKIE = f"hpid_live_8080={TOKEN}"


def judged(*hosts, **changes):
    asked = {"kind": "http", "method": "GET", "host": HOST, "query": "", "cookies": ""}
    return Guard(None, TOKEN, 8080, *hosts).judge(**{**asked, "origin": None, **changes})


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"query": f"token={TOKEN}"}, 303),
        ({"cookies": f"other=1; {COOKIE}"}, 200),
        ({"cookies": COOKIE, "kind": "websocket", "origin": f"http://{HOST}"}, 200),
        ({"cookies": COOKIE, "method": "POST", "origin": f"http://{HOST}"}, 200),
        ({"cookies": COOKIE, "host": "localhost:8080"}, 200),
        ({"cookies": COOKIE, "host": "[::1]:8080"}, 200),
        ({}, 401),
        ({"query": "token=wrong"}, 401),
        ({"query": f"token={TOKEN[:-1]}"}, 401),
        ({"cookies": f"hpid_live_9090={TOKEN}"}, 401),  # another server's
        ({"cookies": "hpid_live_8080="}, 401),
        ({"cookies": COOKIE, "origin": "http://evil.example"}, 403),
        ({"cookies": COOKIE, "origin": "null"}, 403),
        ({"cookies": COOKIE, "origin": "http://127.0.0.1:9090"}, 403),  # another page of this host
        ({"cookies": COOKIE, "kind": "websocket", "origin": "http://evil.example"}, 403),
        ({"cookies": COOKIE, "kind": "websocket"}, 403),
        ({"cookies": COOKIE, "method": "POST"}, 403),
        ({"kind": "websocket", "origin": f"http://{HOST}", "query": f"token={TOKEN}"}, 401),
        ({"method": "POST", "origin": f"http://{HOST}", "query": f"token={TOKEN}"}, 401),
        ({"cookies": COOKIE, "host": "evil.example:8080"}, 421),  # DNS rebinding
        ({"cookies": COOKIE, "host": "127.0.0.1:9090"}, 421),
        ({"cookies": COOKIE, "host": "127.0.0.1"}, 421),
        ({"cookies": COOKIE, "host": ""}, 421),
    ],
)
def test_who_has_the_token_gets_in_and_everybody_else_is_refused(changes, status):
    found, reason = judged(**changes)
    assert found == status
    assert bool(reason) == (status > 400)


@given(st.text(), st.text(), st.text(), st.text())
def test_no_text_gets_in_or_brings_the_guard_down(host, origin, query, cookies):
    assert judged(host=host, origin=origin, query=query, cookies=cookies)[0] not in (200, 303)


def test_a_server_for_others_is_known_by_any_name_but_only_at_its_port():
    assert judged((), host="robot.lab:8080", cookies=COOKIE)[0] == 200
    assert judged((), host="robot.lab:80", cookies=COOKIE)[0] == 421


@pytest.mark.parametrize("host", ["localhost", "::1", "[::1]"])
def test_the_address_of_a_server_leads_to_it(host):
    try:
        served = PageServer(SimulatedGraph(arm()), host, port=0)
    except SettingError as error:
        pytest.skip(str(error))  # a computer without IPv6
    address = urlsplit(served.url)
    try:
        socket.create_connection((address.hostname, address.port), 10.0).close()
    finally:
        served.stop()
    assert judged(host=f"{address.netloc.rpartition(':')[0]}:8080", cookies=COOKIE)[0] == 200


@pytest.mark.parametrize("token", ["", "short", "a" * 15, "a" * 16 + "\n", "a b" * 10, "ä" * 20])
def test_a_token_that_can_be_guessed_or_not_be_typed_is_refused(token):
    with pytest.raises(SettingError, match="16 characters"):
        require_token(token)


def answered(path="/", **changes):
    """Return what the guard sends to a request, by kind and headers, and whether it passed."""
    sent, asked = [], []
    headers = [(b"host", HOST.encode())]
    scope = {"type": "http", "method": "GET", "path": path, "headers": headers} | changes

    async def app(scope, receive, send):
        asked.append(scope["path"])
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(Guard(app, TOKEN, 8080)(scope, receive, send))
    return [each["type"] for each in sent], dict(sent[0].get("headers", ())), bool(asked)


@pytest.mark.parametrize(
    ("path", "place"),
    [
        ("/", b"/?x=1"),
        ("//evil.example/", b"/evil.example/?x=1"),
        ("/\u20ac", b"/%E2%82%AC?x=1"),
        ("/\r\nSet-Cookie: a", b"/%0D%0ASet-Cookie%3A%20a?x=1"),
    ],
)
def test_the_cookie_is_for_no_script_and_no_other_site_and_the_token_leaves_the_address(
    path, place
):
    _, told, is_passed = answered(path, query_string=f"token={TOKEN}&x=1".encode())
    assert not is_passed
    assert told[b"location"] == place
    assert {"HttpOnly", "SameSite=Strict"} <= set(told[b"set-cookie"].decode().split("; "))


def test_no_page_may_frame_this_one_and_nobody_keeps_it():
    headers = [(b"host", HOST.encode()), (b"cookie", COOKIE.encode())]
    _, told, is_passed = answered(headers=headers)
    assert is_passed
    assert (told[b"x-frame-options"], told[b"cache-control"]) == (b"DENY", b"no-store")


def test_a_socket_of_another_page_is_closed_before_it_is_open():
    headers = [(b"host", HOST.encode()), (b"cookie", COOKIE.encode()), (b"origin", b"http://x")]
    kinds, _, is_passed = answered("/frames", type="websocket", headers=headers)
    assert (kinds, is_passed) == (["websocket.close"], False)


class Transport:
    """A connection from a port, which may be dropped."""

    def __init__(self, port):
        self.port, self.is_dropped = port, False

    def get_extra_info(self, name):
        return ("127.0.0.1", self.port) if name == "peername" else None

    def abort(self):
        self.is_dropped = True


def test_connections_without_the_token_are_few_and_the_oldest_goes_first():
    async def connect():
        newcomers, made = Newcomers(most=2, within=60.0), [Transport(n) for n in range(4)]
        for each in made[:2]:
            newcomers.enter(each)
        newcomers.leave(("127.0.0.1", 0))  # it has sent the token
        for each in made[2:]:
            newcomers.enter(each)
        return [each.is_dropped for each in made]

    assert asyncio.run(connect()) == [False, True, False, False]


def test_a_connection_that_sends_no_token_is_dropped_in_time_and_its_port_is_not_remembered():
    async def wait():
        newcomers = Newcomers(most=9, within=0.05)
        slow, known, again = Transport(1), Transport(2), Transport(2)
        for each in (slow, known):
            newcomers.enter(each)
        newcomers.leave(("127.0.0.1", 2))
        newcomers.enter(again)  # of another one, later
        newcomers.leave(("127.0.0.1", 2))
        while not slow.is_dropped:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)
        return known.is_dropped, again.is_dropped

    assert asyncio.run(wait()) == (False, False)


@pytest.mark.parametrize(
    ("query", "headers", "is_known"),
    [
        (f"token={TOKEN}", [], True),
        ("", [(b"cookie", COOKIE.encode())], True),
        ("token=wrong", [], False),
        ("", [], False),
    ],
)
def test_who_has_sent_the_token_may_stay_connected(query, headers, is_known):
    peer, left = ("127.0.0.1", 4711), []
    newcomers = Newcomers()
    newcomers.leave = left.append
    scope = {
        "type": "http",
        "method": "GET",
        "path": "/",
        "headers": [(b"host", HOST.encode()), *headers],
        "query_string": query.encode(),
        "client": peer,
    }

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        pass

    asyncio.run(Guard(app, TOKEN, 8080, newcomers=newcomers)(scope, None, send))
    assert left == [peer] * is_known


def test_each_answer_has_a_policy_of_its_own_without_inline_script():
    headers = [(b"host", HOST.encode()), (b"cookie", COOKIE.encode())]
    policies = [answered(headers=headers)[1][b"content-security-policy"] for _ in range(2)]
    assert policies[0] != policies[1]  # a nonce is used once
    scripts = policies[0].decode().partition("script-src ")[2].partition(";")[0]
    assert "'unsafe-inline'" not in scripts
    assert "'nonce-" in scripts
