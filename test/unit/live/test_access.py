"""Only who has the token, at this host and from this page, gets in."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.live.page.access import LOOPBACK, Access, Guard, require_token

TOKEN = "correct-horse-battery"
HOST = "127.0.0.1:8080"
COOKIE = f"hpid_live_8080={TOKEN}"


def judged(access=None, **changes):
    asked = {
        "kind": "http",
        "method": "GET",
        "host": HOST,
        "origin": None,
        "query": "",
        "cookies": "",
    }
    return (access or Access(TOKEN, 8080)).judge(**{**asked, **changes})


def test_the_address_gives_a_cookie_and_the_cookie_opens_the_page():
    assert judged(query=f"token={TOKEN}").status == 303
    assert judged(cookies=f"other=1; {COOKIE}").status == 200
    assert judged(kind="websocket", origin=f"http://{HOST}", cookies=COOKIE).status == 200
    assert judged(method="POST", origin=f"http://{HOST}", cookies=COOKIE).status == 200


@pytest.mark.parametrize(
    ("changes", "status"),
    [
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
def test_everything_else_is_refused(changes, status):
    verdict = judged(**changes)
    assert verdict.status == status
    assert verdict.reason


@given(st.text(), st.text(), st.text(), st.text())
def test_no_text_gets_in_or_brings_the_guard_down(host, origin, query, cookies):
    verdict = judged(host=host, origin=origin, query=query, cookies=cookies)
    assert verdict.status not in (200, 303)


@pytest.mark.parametrize("name", LOOPBACK)
def test_the_loopback_has_several_names(name):
    host = f"[{name}]" if name == "::1" else name
    assert judged(host=f"{host}:8080", cookies=COOKIE).status == 200


def test_a_server_for_others_is_known_by_any_name_but_only_at_its_port():
    access = Access(TOKEN, 8080, hosts=())
    assert judged(access, host="robot.lab:8080", cookies=COOKIE).status == 200
    assert judged(access, host="robot.lab:80", cookies=COOKIE).status == 421


@pytest.mark.parametrize("token", ["", "short", "a" * 15, "a" * 16 + "\n", "a b" * 10, "ä" * 20])
def test_a_token_that_can_be_guessed_or_not_be_typed_is_refused(token):
    with pytest.raises(SettingError, match="16 characters"):
        require_token(token)


def answered(scope):
    """Return what the guard sends to a request, and whether the server was asked."""
    sent, asked = [], []

    async def app(scope, receive, send):
        asked.append(scope["path"])
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(Guard(app, Access(TOKEN, 8080))(scope, receive, send))
    return sent, asked


def test_the_cookie_is_for_no_script_and_no_other_site_and_the_token_leaves_the_address():
    headers = [(b"host", HOST.encode())]
    query = f"token={TOKEN}&x=1".encode()
    scope = {"type": "http", "method": "GET", "path": "/", "headers": headers}
    sent, asked = answered({**scope, "query_string": query})
    told = dict(sent[0]["headers"])
    assert not asked
    assert told[b"location"] == b"/?x=1"
    assert {"HttpOnly", "SameSite=Strict"} <= set(told[b"set-cookie"].decode().split("; "))


@pytest.mark.parametrize(
    ("path", "place"),
    [
        ("//evil.example/", b"/evil.example/"),
        ("/\u20ac", b"/%E2%82%AC"),
        ("/\r\nSet-Cookie: a", b"/%0D%0ASet-Cookie%3A%20a"),
    ],
)
def test_the_address_with_the_token_leads_nowhere_else(path, place):
    scope = {"type": "http", "method": "GET", "path": path, "headers": [(b"host", HOST.encode())]}
    sent, _ = answered({**scope, "query_string": f"token={TOKEN}".encode()})
    assert dict(sent[0]["headers"])[b"location"] == place


def test_no_page_may_frame_this_one_and_nobody_keeps_it():
    headers = [(b"host", HOST.encode()), (b"cookie", COOKIE.encode())]
    sent, asked = answered({"type": "http", "method": "GET", "path": "/", "headers": headers})
    told = dict(sent[0]["headers"])
    assert asked == ["/"]
    assert told[b"x-frame-options"] == b"DENY"
    assert told[b"cache-control"] == b"no-store"


def test_a_socket_of_another_page_is_closed_before_it_is_open():
    headers = [(b"host", HOST.encode()), (b"cookie", COOKIE.encode()), (b"origin", b"http://x")]
    sent, asked = answered({"type": "websocket", "path": "/frames", "headers": headers})
    assert not asked
    assert [each["type"] for each in sent] == ["websocket.close"]
