"""Connections of a grasp server: silent, slow and many ones lock nobody out, and refusals are JSON."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from typing import Any

import pytest

pytest.importorskip("uvicorn", reason="needs the extra [apps]: pip install '.[apps]'")

import uvicorn

from dro_grasp.apps.server.connections import Limits, within

HELD = threading.Event()  # Set to let requests for /held end
OPENED: list[socket.socket] = []  # To be closed after a test


async def app(scope: Any, receive: Any, send: Any) -> None:
    """Reads the whole of a request, and answers; /held when it may."""
    while (message := await receive()).get("more_body"):
        pass
    if message["type"] == "http.disconnect":
        return
    while scope["path"] == "/held" and not HELD.is_set():
        await asyncio.sleep(0.01)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


Serve = Callable[[Limits], int]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """What serves within limits, and returns the port."""
    servers: list[tuple[uvicorn.Server, threading.Thread]] = []
    HELD.clear()

    def started(limits: Limits) -> int:
        listener = socket.create_server(("127.0.0.1", 0), backlog=64)
        config = uvicorn.Config(app, http=within(limits), ws="none", lifespan="off", log_level="critical",
                                timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        servers.append((server, thread))
        return listener.getsockname()[1]

    yield started
    HELD.set()
    while OPENED:
        OPENED.pop().close()
    for server, thread in servers:
        server.should_exit = True
        thread.join(10)


def ask(port: int, page: str = "/", source: str = "127.0.0.1") -> tuple[int, bytes, str | None]:
    connection = HTTPConnection("127.0.0.1", port, timeout=10, source_address=(source, 0))
    connection.request("GET", page)
    answer = connection.getresponse()
    told = answer.status, answer.read(), answer.getheader("Retry-After")
    connection.close()
    return told


def opened(port: int, sent: bytes, source: str = "127.0.0.1") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), 10, source_address=(source, 0))
    OPENED.append(connection)
    connection.sendall(sent)
    return connection


def said(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    parts = []
    while part := connection.recv(4096):
        parts.append(part)
    return b"".join(parts)


BODY = b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\nabc"


@pytest.mark.parametrize("sent", [b"", b"GET / HT", BODY])
def test_what_keeps_the_server_waiting_makes_room_for_others(serve: Serve, sent: bytes) -> None:
    port = serve(Limits(8, 4))
    waiting = [opened(port, sent) for _ in range(20)]
    assert ask(port)[:2] == (200, b"ok")
    refusals = [json.loads(said(connection).partition(b"\r\n\r\n")[2]) for connection in waiting[:5]]
    assert all("others wait" in refusal["error"] for refusal in refusals)


def test_the_crowd_of_one_address_costs_no_other_address_its_place(serve: Serve) -> None:
    port = serve(Limits(6, 5))
    mine = opened(port, b"", "127.0.0.2")
    crowd = [opened(port, b"", "127.0.0.3") for _ in range(30)]
    assert ask(port, source="127.0.0.4")[0] == 200
    mine.sendall(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
    assert mine.recv(100).startswith(b"HTTP/1.1 200")
    assert len(crowd) == 30


def test_where_all_wait_for_the_server_a_newcomer_is_told_when_to_come(serve: Serve) -> None:
    port = serve(Limits(4, 2))
    busy = [opened(port, b"GET /held HTTP/1.1\r\nHost: a\r\n\r\n") for _ in range(2)]
    time.sleep(0.2)
    status, body, again = ask(port)
    assert (status, again) == (503, "1")
    assert "connections of this address are busy" in json.loads(body)["error"]
    assert ask(port, source="127.0.0.2")[0] == 200
    HELD.set()
    assert all(connection.recv(100).startswith(b"HTTP/1.1 200") for connection in busy)


@pytest.mark.parametrize("first", [b"", b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"])
def test_a_dripping_head_is_closed_in_time(serve: Serve, first: bytes) -> None:
    port, begin = serve(Limits(head_seconds=0.6)), time.monotonic()
    drip = opened(port, first)
    if first:
        while b"\r\n\r\nok" not in (answer := drip.recv(1000, socket.MSG_PEEK)):
            time.sleep(0.01)
        drip.recv(len(answer))
    heard = b""
    for sign in b"GET / HTTP/1.1\r\nX: " + b"a" * 200:
        drip.settimeout(0.05)
        try:
            drip.sendall(bytes([sign]))
            heard += drip.recv(1000)
        except TimeoutError:
            continue
        except OSError:
            break
        if heard:
            break
    assert time.monotonic() - begin < 3
    assert heard.startswith(b"HTTP/1.1 408")
    assert b"did not arrive in 0.6 s" in heard


def test_silence_is_closed_and_nonsense_is_refused_as_json(serve: Serve) -> None:
    port = serve(Limits(head_seconds=0.3))
    assert said(opened(port, b"")).startswith(b"HTTP/1.1 408")
    head, _, body = said(opened(port, b"\x16\x03nonsense\r\n\r\n")).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400")
    assert json.loads(body)["error"]
    long = said(opened(port, b"GET / HTTP/1.1\r\nX: " + b"a" * 100_000))
    assert long.startswith(b"HTTP/1.1 400")


def test_a_slow_request_that_keeps_the_time_is_answered(serve: Serve) -> None:
    port = serve(Limits(head_seconds=2.0))
    slow = opened(port, b"GET / HT")
    time.sleep(0.3)
    slow.sendall(b"TP/1.1\r\nHost: a\r\n\r\n")
    assert slow.recv(100).startswith(b"HTTP/1.1 200")
