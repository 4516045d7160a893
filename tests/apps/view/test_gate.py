"""The gate of the viewer: without the token, neither pages nor websockets nor files are served."""

import asyncio
import os
import socket
from contextlib import suppress
from urllib.parse import urlsplit

import pytest
from browser import get
from needs import needs

from surfkit.apps.view.server import Address, listen, served
from surfkit.apps.view.token_auth import AuthRequest, TokenAuth
from surfkit.core.check import BadInput

GATE = TokenAuth("right", 8080)
OURS = "/surfkit/script.js", "/surfkit/ask?client=0&x=0&y=0"


@pytest.mark.parametrize(
    "asked",
    [
        AuthRequest("/"),
        AuthRequest("/?token="),
        AuthRequest("/?token=wrong"),
        AuthRequest("/?Token=right"),
        AuthRequest("/right"),
        AuthRequest("/", cookies=["surfkit-view-8080=wrong"]),
        AuthRequest("/", cookies=["surfkit-view-8081=right"]),
        AuthRequest("/", cookies=["=;;,\x00"]),
        AuthRequest("/?token=r%FFght"),
        AuthRequest("/?token=right", origins=["http://evil.example"], hosts=["127.0.0.1:8080"]),
        AuthRequest("/", ["surfkit-view-8080=right"], ["http://127.0.0.1:9000"], ["127.0.0.1:8080"]),
        AuthRequest("/", ["surfkit-view-8080=right"], ["null"], ["127.0.0.1:8080"]),
    ],
)
def test_who_lacks_the_token_is_refused(asked):
    assert not GATE.admits(asked)


@pytest.mark.parametrize(
    "asked",
    [
        AuthRequest("/?token=right"),
        AuthRequest("/?a=1&token=wrong&token=right"),
        AuthRequest("/x", cookies=["other=1", "a=b; surfkit-view-8080=right"]),
        AuthRequest("/", ["surfkit-view-8080=right"], ["http://127.0.0.1:8080"], ["127.0.0.1:8080"]),
    ],
)
def test_who_has_the_token_is_admitted(asked):
    assert GATE.admits(asked)


@pytest.fixture(scope="module")
def page():
    needs("viser")
    with served(Address(), "test") as found:
        yield found


def token_of(page):
    return urlsplit(page.url).query.partition("=")[2]


@pytest.mark.parametrize(
    "target", ["/", "/index.html", "/?token=wrong", "/nowhere", "/../viser", "/%2e%2e/x", "//", *OURS]
)
def test_http_without_the_token_gets_nothing(page, target):
    for headers in ({}, {"Cookie": "surfkit-view-8080=wrong"}, {"Origin": "http://x", "Cookie": "=;"}):
        status, body, _ = get(page, target, **headers)
        assert status == 403 and len(body) < 100


def test_the_token_becomes_a_cookie_that_opens_the_page(page):
    at = urlsplit(page.url)
    status, body, headers = get(page, f"/?{at.query}")
    assert status == 303 and headers["Location"] == "/" and not body
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
    status, body, _ = get(page, "/", Cookie=cookie.partition(";")[0])
    assert status == 200 and b"<html" in body[:2000] and len(body) > 10_000
    for target in ("/nowhere", *OURS):  # no script was set
        assert get(page, target, Cookie=cookie.partition(";")[0])[0] == 404
    assert b"surfkit/script.js" not in body


def knock(page, query="", **headers):
    """Bytes of the first message of a websocket, or the status of its refusal."""
    client = needs("websockets.asyncio.client", "a websocket client")
    refused = needs("websockets.exceptions").InvalidStatus
    viser = needs("viser")
    at = urlsplit(page.url)

    async def talk():
        try:
            async with client.connect(
                f"ws://{at.netloc}/{query}",
                subprotocols=[f"viser-v{viser.__version__}"],
                additional_headers=headers,
                max_size=None,
            ) as socket_:
                return len(await socket_.recv())
        except refused as error:
            return -error.response.status_code

    return asyncio.run(talk())


def test_websockets_without_the_token_are_refused(page):
    port, token = urlsplit(page.url).port, token_of(page)
    assert knock(page) == knock(page, "?token=wrong") == -403
    assert knock(page, Cookie=f"surfkit-view-{port}=wrong") == -403
    assert knock(page, Cookie=f"surfkit-view-{port}={token}", Origin="http://evil.example") == -403
    assert knock(page, Cookie=f"surfkit-view-{port}={token}") > 16
    assert knock(page, Cookie=f"surfkit-view-{port}={token}", Origin=f"http://127.0.0.1:{port}") > 16


def test_it_listens_on_this_machine_alone_and_cannot_be_shared(page):
    messages = needs("viser._messages")
    assert page.url.startswith("http://127.0.0.1:")
    assert messages.ShareUrlRequest not in page.viser._websock_server._incoming_handlers
    assert messages.GuiUpdateMessage in page.viser._websock_server._incoming_handlers  # such is where they would be


def listening():
    """Ports on which this process listens."""
    own = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            own.add(os.readlink(f"/proc/self/fd/{name}"))
    with open("/proc/net/tcp") as four, open("/proc/net/tcp6") as six:
        rows = [line.split() for line in (*four, *six)]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own}


def test_no_other_port_is_opened():
    needs("viser")
    before = listening()
    with served(Address(), "test") as page:
        assert listening() - before == {urlsplit(page.url).port}


def test_a_taken_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(BadInput, match=rf"--port {port}: .*in use"):
            listen(Address(port=port))
    with listen(Address()) as first, listen(Address()) as second:
        assert first.getsockname()[1] < second.getsockname()[1]


@pytest.mark.parametrize("host", ["198.51.100.7", "nowhere.invalid"])
def test_a_host_of_another_machine(host):
    with pytest.raises(BadInput, match=f"--host {host}: .*address"):
        listen(Address(host, 0))


def test_it_ends_and_frees_its_port():
    needs("viser")
    with served(Address(), "test") as page:
        port = urlsplit(page.url).port
    with listen(Address(port=port)):
        pass
