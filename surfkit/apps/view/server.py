"""viser behind a gate: a local web server that answers nothing, neither pages nor websockets, without its token.

    with served(Address(), "title") as page:
        print(page.url)
        page.viser.scene.add_frame("/axes")

What is shown is for the caller to add; the server runs in threads of its own.
"""

from __future__ import annotations

import errno
import http
import logging
import os
import secrets
import socket
import sys
import threading
import warnings
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

from surfkit.apps.view.http_answers import Script, response
from surfkit.apps.view.token_auth import AuthRequest, TokenAuth
from surfkit.core.check import BadInput, Fault
from surfkit.core.optional import needed

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
FIRST_PORT, PORTS = 8080, 100
"""Where a free port is looked for, if none is asked for."""
PORT_NUMBERS = range(1, 65536)
BROWSER_CLOSE_S = 1.0
"""For a browser to say that it has heard the end."""
SILENT = logging.getLogger("surfkit.apps.view.requests")
SILENT.setLevel(logging.CRITICAL)  # a request that is refused is no event of the program
PATCHING = threading.Lock()


@dataclass(frozen=True)
class Address:
    """Where to serve.

    Attributes:
        host: Name or address of a network interface of this machine.
        port: That must be free; None for the next free one.
        flags: How the options begin with which a user gives them.
    """

    host: str = LOCAL
    port: int | None = None
    flags: str = "--"

    @property
    def is_local(self) -> bool:
        """Whether no other machine can reach it."""
        return self.host in (LOCAL, "localhost", "::1")


@dataclass(frozen=True)
class RunningServer:
    """A server that runs.

    Attributes:
        viser: What is shown; every client of it has come through the gate.
        url: With the token.
        closing: Set when the server is about to end, for whatever goes on for long.
        script: That pages are given; none to begin with.
    """

    viser: viser.ViserServer
    url: str
    closing: threading.Event
    script: Script

    def open_browser(self) -> bool:
        """Open the page in a browser; False where there is no display to open one on."""
        display = sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
        return bool(display) and webbrowser.open(self.url)


def refuse_wrong_port(port: int | None, flag: str) -> None:
    """BadInput if there is no such port; `flag` is the option that it was given with."""
    if port is not None and port not in PORT_NUMBERS:
        raise BadInput(f"{flag} {port}: give {PORT_NUMBERS[0]} to {PORT_NUMBERS[-1]}")


@contextmanager
def served(address: Address, title: str, what: str = "surfkit view") -> Iterator[RunningServer]:
    """Within, a server with an empty scene.

    Args:
        address: Where.
        title: Of the panel on the page.
        what: The command, for the message if viser is not installed.

    Raises:
        BadInput: viser is not installed, the port is taken, or the host is none of this machine.
    """
    package = require_viser(what)
    listener = listen(address)
    gate, script = TokenAuth(secrets.token_urlsafe(24), listener.getsockname()[1]), Script()
    try:
        with _gated(gate, listener, script) as used, _quiet():
            server = package.ViserServer(address.host, gate.port, label=title, verbose=False)
        closing = threading.Event()
        try:
            if not used:
                raise Fault(f"viser {package.__version__} starts its server in an unknown way: pip install 'viser<1.2'")
            _never_share(server)
            url = f"http://{_shown_host(address.host)}:{gate.port}/?token={gate.token}"
            yield RunningServer(server, url, closing, script)
        finally:
            closing.set()
            with _quiet():
                server.stop()
    finally:
        listener.close()


def require_viser(what: str = "surfkit view") -> ModuleType:
    """viser; BadInput where it does not load."""
    with needed("viser", what):
        import viser

    warnings.filterwarnings("ignore", "Queued a .*never be delivered", UserWarning)  # a browser was closed: all is well
    return viser


def listen(address: Address) -> socket.socket:
    """A socket that listens at an address.

    Raises:
        BadInput: The port is taken, or the host is none of this machine.
    """
    wanted = range(FIRST_PORT, FIRST_PORT + PORTS) if address.port is None else [address.port]
    for port in wanted:
        try:
            return socket.create_server((address.host, port), family=_family(address.host))
        except OSError as error:
            if error.errno == errno.EADDRINUSE and address.port is None:
                continue
            number = error.errno or 0
            reason = os.strerror(number) if number > 0 else error.strerror or str(error)
            if error.errno in (errno.EADDRINUSE, errno.EACCES):
                raise BadInput(
                    f"{address.flags}port {port}: {reason}; give another, or leave it out for a free one"
                ) from error
            raise BadInput(f"{address.flags}host {address.host}: {reason}; give an address of this machine") from error
    raise BadInput(f"ports {FIRST_PORT} to {wanted[-1]} are all taken; give a free one with {address.flags}port")


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _shown_host(host: str) -> str:
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


@contextmanager
def _gated(gate: TokenAuth, listener: socket.socket, script: Script) -> Iterator[list[bool]]:
    """Within, the server that viser starts serves at `listener`, asks the gate first, and has the script on its page.

    viser has no place for a hook of its own, so that the function by which it opens its port is replaced for as long as
    it takes to start; the list says whether viser has called it.
    """
    from websockets.asyncio import server

    library: Any = server
    plain: Callable[..., Any] = library.serve
    used: list[bool] = []

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **settings: Any) -> Any:
        async def answer(connection: Any, request: Any) -> Any:
            if (refusal := _refusal_or_cookie(gate, request)) is not None:
                return refusal
            if (own := await script.respond(request.path)) is not None:
                return own
            return script.into(process_request(connection, request))

        used.append(True)
        settings |= {"process_request": answer, "logger": SILENT, "close_timeout": BROWSER_CLOSE_S}
        return plain(handler, sock=listener, **settings)

    with PATCHING:
        library.serve = serve
        try:
            yield used
        finally:
            library.serve = plain


def _refusal_or_cookie(gate: TokenAuth, request: Any) -> Any:
    """The answer to a request that is not let through, or that has yet to change the token for a cookie; else None."""
    headers = request.headers
    asked = AuthRequest(request.path, *(headers.get_all(name) for name in ("Cookie", "Origin", "Host")))
    if not gate.admits(asked):
        return response(http.HTTPStatus.FORBIDDEN, "surfkit view: open the address that the terminal shows\n")
    is_page = "upgrade" not in headers
    if is_page and gate.brings_token(asked):  # so that it does not stay in the address bar and the history
        return response(http.HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": gate.cookie})
    return None


def _never_share(server: viser.ViserServer) -> None:
    """Take the function away by which a page can have viser publish itself through a server on the internet."""
    from viser import _messages

    for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server._incoming_handlers.pop(kind, None)
    server.gui.configure_theme(show_share_button=False, show_logo=False)


@contextmanager
def _quiet() -> Iterator[None]:
    """Within, rich prints nothing: viser would show its address, without the token, and that it has ended."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
