"""What stands before a page of viser: it lets in those alone who may talk to it, and not too many."""

from __future__ import annotations

import http
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from dro_grasp.web.origins import own_names, refusal

MOST_CONNECTIONS = 64
"""Most open connections to one page (ours)."""


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
