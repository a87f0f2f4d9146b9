"""Only browsers that show a served page itself may talk to it."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from http.client import HTTPConnection

import pytest
import viser
import websockets

from dro_grasp.apps.viewer.scene_view import ServedPage
from dro_grasp.errors import OptionError


@pytest.fixture(scope="module")
def page() -> Iterator[ServedPage]:
    served = ServedPage(8700, "127.0.0.1")
    yield served
    served.stop()


async def connect(port: int, origin: str) -> None:
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    async with websockets.connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], origin=websockets.Origin(origin)):
        pass


def test_a_foreign_page_opens_no_socket_and_the_own_one_does(page: ServedPage) -> None:
    port = page.server.get_port()
    asyncio.run(connect(port, f"http://127.0.0.1:{port}"))
    with pytest.raises(websockets.exceptions.InvalidStatus, match="403") as refused:
        asyncio.run(connect(port, "http://evil.example"))
    assert b"not from this one" in (refused.value.response.body or b"")


def test_a_name_that_somebody_else_gives_this_machine_is_refused(page: ServedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "getfqdn", lambda *_: pytest.fail("a request waits for a name server"))
    for host, status in (("evil.example", 403), (f"127.0.0.1:{page.server.get_port()}", 200)):
        connection = HTTPConnection("127.0.0.1", page.server.get_port(), timeout=10)
        connection.request("GET", "/", headers={"Host": host})
        assert connection.getresponse().status == status
        connection.close()


def test_an_empty_host_is_refused() -> None:
    with pytest.raises(OptionError, match="host is empty"):
        ServedPage(8700, "")
