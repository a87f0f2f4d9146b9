"""The grasp server over HTTP: its pages, who may ask, and how much."""

from __future__ import annotations

import asyncio
import math
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

import uvicorn
from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import PlainTextResponse, Response
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException as AnyHTTPException

from dro_grasp._version import __version__
from dro_grasp.apps.origins import LOCAL, own_names, refusal, same_token
from dro_grasp.apps.server.connections import Limits, within
from dro_grasp.apps.server.messages import GenerateAnswer, GenerateCall, GraspAnswer, GraspCall, Refusal
from dro_grasp.apps.server.request_queue import Reply, RequestQueue, refused
from dro_grasp.errors import OptionError, ServerError

SHUTDOWN_TIMEOUT = 10.0  # Time that requests under way get to end when the server is stopped [s] (ours)
BACKLOG = 128  # Most connections that wait to be taken (ours)


@dataclass(frozen=True)
class Access:
    """Who may ask, and how much at once."""

    host: str = "127.0.0.1"  # Address to serve at; only this machine can connect by default
    token: str | None = None  # What requests must bear; needed where others can connect
    megabytes: float = 32.0  # Largest body of a request [MB]
    body_seconds: float = 30.0  # Time within which the whole of a request must arrive [s] (ours)

    def __post_init__(self) -> None:
        if self.host not in LOCAL and not self.token:
            raise OptionError(f"host is '{self.host}', where others can connect; give a token that they must bear (token=..., "
                              "or the environment variable DRO_GRASP_TOKEN), or serve this machine only (host='127.0.0.1')")
        if not 0 < self.megabytes <= 1000:
            raise OptionError(f"megabytes is {self.megabytes}; give a number above 0, and at most 1000")


class Gate:
    """Refuses what comes from foreign pages, bears no token, or is too large or too slow, before anything reads it."""

    def __init__(self, app: Callable[..., Awaitable[None]], access: Access, own: frozenset[str]) -> None:
        self.app, self.access, self.own = app, access, own

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "http":
            reply = self._refusal(Headers(scope=scope), scope["path"])
            if reply is not None:
                await sent(reply)(scope, receive, send)
                return
            receive = self._limited(receive, scope.get("state", {}).get("since"))
        await self.app(scope, receive, send)

    def _refusal(self, headers: Headers, path: str) -> Reply | None:
        if why := refusal(headers, self.own):
            return refused(HTTPStatus.FORBIDDEN, f"the request is refused: {why}")
        scheme, _, borne = headers.get("Authorization", "").partition(" ")
        known = scheme.lower() == "bearer" and same_token(borne.strip(), self.access.token or "")
        if self.access.token and path != "/health" and not known:
            return refused(HTTPStatus.UNAUTHORIZED, "the request bears no token, or another one than the server's; send the "
                                                    "header 'Authorization: Bearer TOKEN'")
        length = headers.get("Content-Length", "0")
        if not length.isdecimal() or int(length) > 1e6 * self.access.megabytes:
            return refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, self._too_large)
        return None

    @property
    def _too_large(self) -> str:
        return f"the request has more than {self.access.megabytes:g} MB; simplify the mesh or thin out the cloud"

    def _limited(self, receive: Any, since: float | None) -> Any:
        """The request's parts, until there are too many or they come too slowly, which neither FastAPI nor uvicorn limits.

        Time runs from its first byte, where that is known.
        """
        size, whole, seconds = 0, False, self.access.body_seconds
        deadline = (asyncio.get_running_loop().time() if since is None else since) + seconds

        async def part() -> Any:
            nonlocal size, whole
            if whole:  # from here on, only the end of the connection is awaited
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, f"the request did not arrive in {seconds:g} s") from None
            size += len(message.get("body", b""))
            whole = not message.get("more_body", False)
            if size > 1e6 * self.access.megabytes:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, self._too_large)
            return message

        return part


def sent(reply: Reply) -> Response:
    """A reply as it is sent."""
    headers = None if reply.retry_after is None else {"Retry-After": str(math.ceil(reply.retry_after))}
    return Response(reply.body, reply.status, headers, media_type="application/json")


def application(queue: RequestQueue, access: Access) -> FastAPI:
    """The pages of a server; the queue is closed when it stops."""

    @asynccontextmanager
    async def life(_: Any) -> AsyncIterator[None]:
        yield
        await asyncio.to_thread(queue.close)

    app = FastAPI(title="dro-grasp", version=__version__, lifespan=life,
                  description="Grasps of any object by any hand. Lengths are metres, angles radians, quaternions WXYZ.")
    app.add_middleware(Gate, access=access, own=own_names(access.host))
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(AnyHTTPException, _failed)
    told: dict[int | str, Any] = {status: {"model": Refusal} for status in (401, 403, 408, 409, 413, 422, 500, 503, 504)}

    @app.post("/grasps", response_model=GraspAnswer, responses=told)
    async def grasps(call: GraspCall, request: Request) -> Any:  # pyright: ignore[reportInvalidTypeForm]
        """Grasps of an object by a hand, the best first. Closing the connection cancels the request."""
        return sent(await _answered(queue, call, request))

    @app.post("/generate", response_model=GenerateAnswer, responses=told)
    async def generate(call: GenerateCall, request: Request) -> Any:
        """What `dro-grasp generate --server` tells and saves."""
        return sent(await _answered(queue, call, request))

    @app.delete("/grasps/{id}", responses={404: {"model": Refusal}})
    async def cancel(id: str) -> dict[str, str]:
        """Cancel a request, in the queue or under way."""
        if not queue.cancel(id):
            raise HTTPException(HTTPStatus.NOT_FOUND, f"no request '{id}' is under way")
        return {"cancelled": id}

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """Whether the server answers, and how busy it is."""
        return {"status": "ok", "version": __version__, "waiting": queue.waiting, "computing": queue.computing}

    @app.get("/hands")
    async def hands() -> list[str]:
        """Names of hands that can be asked for."""
        return queue.ready.hands

    @app.get("/objects")
    async def objects() -> list[str]:
        """Names of objects that can be asked for."""
        return queue.ready.objects

    @app.get("/metrics", response_class=PlainTextResponse)
    async def metrics() -> str:
        """Counts and times in the text format of Prometheus."""
        return metrics_text(queue)

    return app


async def _answered(queue: RequestQueue, call: Any, request: Request) -> Reply:
    """The reply to a call, which is cancelled when its connection closes."""
    try:
        taken = queue.submit(call)
    except ServerError as error:
        queue.metrics.replies[int(HTTPStatus.SERVICE_UNAVAILABLE)] += 1
        return refused(HTTPStatus.SERVICE_UNAVAILABLE, str(error), error.retry_after)
    reply, gone = asyncio.wrap_future(taken.reply), asyncio.ensure_future(_left(request))
    try:
        await asyncio.wait({reply, gone}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        gone.cancel()
        if not taken.reply.done():
            queue.cancel(call.id)
    return await reply


async def _left(request: Request) -> None:
    """Wait until the other side closes the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _invalid(_: Any, error: Any) -> Response:
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"] if part != "body") or "the request"
    why = f"{place}: {first['msg']}; the page /docs shows what a request holds"
    return sent(refused(HTTPStatus.UNPROCESSABLE_ENTITY, why))


async def _failed(_: Any, error: Any) -> Response:
    return sent(refused(HTTPStatus(error.status_code), error.detail))


def metrics_text(queue: RequestQueue) -> str:
    """What a queue has done, in the text format of Prometheus."""
    metrics = queue.metrics
    lines = ["# TYPE dro_grasp_replies_total counter"]
    lines += [f'dro_grasp_replies_total{{status="{status}"}} {count}' for status, count in sorted(metrics.replies.items())]
    for name, kind, value in (
        ("waiting", "gauge", queue.waiting), ("computing", "gauge", int(queue.computing)),
        ("waiting_seconds_total", "counter", round(metrics.waiting_seconds, 3)),
        ("computing_seconds_total", "counter", round(metrics.computing_seconds, 3)),
        ("process_starts_total", "counter", metrics.starts), ("process_memory_bytes", "gauge", queue.memory),
    ):
        lines += [f"# TYPE dro_grasp_{name} {kind}", f"dro_grasp_{name} {value}"]
    return "\n".join(lines) + "\n"


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens at an address."""
    if not 0 <= port < 2**16:
        raise OptionError(f"port is {port}; give a number up to 65535, for example port=8090, or 0 for any that is free")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise OptionError(f"this machine cannot serve at '{host}', port {port} ({error}); give another port, or "
                          "host='127.0.0.1' for this machine only") from error


class StoppingServer(uvicorn.Server):
    """uvicorn's server, which ends requests under way without a word when it stops; here they are told why."""

    def __init__(self, config: uvicorn.Config, queue: RequestQueue) -> None:
        super().__init__(config)
        self.queue = queue

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the queue while uvicorn waits for replies, and then whatever connection is left."""
        closing = asyncio.ensure_future(self._close())
        await super().shutdown(sockets)
        if self.force_exit:
            self.queue.hurry()
        await closing

    async def _close(self) -> None:
        await asyncio.to_thread(self.queue.close, SHUTDOWN_TIMEOUT)
        for _ in range(10):  # replies are on their way
            if not self.server_state.connections:
                return
            await asyncio.sleep(0.1)
        for connection in list(self.server_state.connections):
            connection.transport.abort()


def serve_grasps(queue: RequestQueue, access: Access, listener: socket.socket) -> None:
    """Serve until SIGTERM or Ctrl-C; what is computed gets SHUTDOWN_TIMEOUT to end, what waits is refused at once."""
    signal.signal(signal.SIGTERM, lambda *_: None)  # uvicorn raises it again once it has stopped
    config = uvicorn.Config(
        application(queue, access), http=within(Limits(head_seconds=access.body_seconds)), ws="none", log_level="warning",
        access_log=False, timeout_graceful_shutdown=int(2 * SHUTDOWN_TIMEOUT), server_header=False)
    try:
        StoppingServer(config, queue).run(sockets=[listener])
    except KeyboardInterrupt:
        pass
    finally:
        queue.close()
