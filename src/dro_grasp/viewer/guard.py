"""Who may talk to a page that is served: browsers that show this very page, at an address of this machine.

Any page in a browser may open a WebSocket to a server on the same machine, or give a name of its own to that machine's address.
"""

from __future__ import annotations

import http
import ipaddress
import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

MOST_CONNECTIONS = 64
"""Most open connections to one page (ours)."""


def own_names(served_at: str) -> frozenset[str]:
    """Names of this machine, in small letters.

    A name server may be asked, which takes seconds where none answers: call it once, before requests come.

    Args:
        served_at: The address that the page is served at, as the user gave it.
    """
    return frozenset(name.lower() for name in ("localhost", served_at, socket.gethostname(), socket.getfqdn()))


def refusal(headers: Any, own: Collection[str]) -> str:
    """Why a request is refused; empty if it is not.

    Args:
        headers: Of the request, by name.
        own: Names of this machine; see `own_names`.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    try:
        name = urlsplit(f"//{host}").hostname or ""
        theirs = None if origin is None else urlsplit(origin).netloc
    except ValueError:
        return "its Host or Origin is no address"
    if not (_is_address(name) or name in own):
        return f"it asks for the host '{name}', which is no name of this machine; open the page at the machine's address"
    if theirs is not None and theirs != host:
        return f"it comes from a page of '{origin}', not from this one"
    return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextmanager
def guarded_server(served_at: str) -> Iterator[None]:
    """Servers of viser that start within the block refuse foreign requests, and more than MOST_CONNECTIONS.

    viser has no switch for it; it passes a function that sees every request to websockets, and this one is put before it.
    """
    serve, own = websockets.asyncio.server.serve, own_names(served_at)

    def guarded(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Request) -> Response | None:
            crowd = len(getattr(connection.server, "connections", ())) > MOST_CONNECTIONS
            why = "too many browsers show it; close some" if crowd else refusal(request.headers, own)
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"This page refuses the request: {why}.\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*args, process_request=check, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
