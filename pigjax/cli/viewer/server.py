"""The web server of the page: this machine alone unless a host is named, and no page of another site may talk to it."""

from __future__ import annotations

import http
import ipaddress
import logging
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from pigjax.core.errors import InputError

LOCAL = "127.0.0.1"
_NAMES = re.compile(r"(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?")


def start_server(host: str = LOCAL, port: int = 8080) -> Any:
    """A running `viser.ViserServer`; the next free port where the given one is taken.

    A browser sends the site of a page (`Origin`) and the name that it called (`Host`) with each request. A request
    from the page of another site is refused, and on this machine's own address also one by another name, by which a
    site could reach it (DNS rebinding). viser's public link to the page, which any of its visitors could ask for, is
    off.

    Args:
        host: address to listen on; the default is reached from this machine alone.
        port: first port to try; 0 takes any.

    Raises:
        InputError: viser is missing, or the host or port cannot be had.
    """
    try:
        import viser
    except ImportError:
        raise InputError(
            "the page of 'pigjax view' needs viser: pip install 'pigjax[view]'; with -o FILE.mp4 a turntable is written"
            " without it."
        ) from None
    logging.getLogger("websockets").setLevel(logging.ERROR)  # closed tabs are no errors
    with _guarded(local=_is_local(host)), _silent():
        try:
            server = viser.ViserServer(host=host, port=port, verbose=False)
        except (OSError, RuntimeError, OverflowError) as error:
            raise InputError(f"--host {host} --port {port}: cannot be listened on ({error}).") from None
    # a share link would lead through a server outside of this machine; viser has no option against it
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large", dark_mode=False)
    return server


def _is_local(host: str) -> bool:
    """Whether an address is reached from this machine alone."""
    try:
        found = socket.getaddrinfo(host.strip("[]"), None)
    except (OSError, UnicodeError):
        return False  # which the server refuses
    return all(ipaddress.ip_address(entry[4][0]).is_loopback for entry in found)


def refused(headers: Any, *, local: bool) -> bool:
    """Whether a request comes from another site's page, or calls this machine by a strange name."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if local and not _NAMES.fullmatch(host):
        return True
    return origin is not None and urlsplit(origin).netloc != host


@contextmanager
def _guarded(*, local: bool) -> Iterator[None]:
    """While a server starts, put `refused` before what it answers; viser has no setting for that."""
    import websockets.asyncio.server as server
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    plain: Any = server.serve

    def serve(*args: Any, process_request: Callable[..., Any], **named: Any) -> Any:
        def checked_request(connection: Any, request: Any) -> Any:
            if refused(request.headers, local=local):
                return Response(http.HTTPStatus.FORBIDDEN, "FORBIDDEN", Headers({"Content-Length": "0"}), b"")
            return process_request(connection, request)

        return plain(*args, process_request=checked_request, **named)

    vars(server)["serve"] = serve
    try:
        yield
    finally:
        vars(server)["serve"] = plain


@contextmanager
def _silent() -> Iterator[None]:
    """Without viser's own greeting; the command prints the address."""
    import rich

    plain = rich.print
    rich.print = lambda *args, **named: None
    try:
        yield
    finally:
        rich.print = plain
