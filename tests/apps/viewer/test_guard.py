"""Only browsers that show a served page itself may talk to it."""

from __future__ import annotations

import asyncio
import gc
import socket
import time
from collections.abc import Iterator
from http.client import HTTPConnection

import msgspec
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


async def connect(port: int, origin: str, message: str | bytes | None = None, **headers: str) -> None:
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    async with websockets.connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], origin=websockets.Origin(origin),
                                  additional_headers=headers, max_size=None) as opened:
        if message is not None:
            await opened.send(message)
            await asyncio.sleep(0.3)


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


@pytest.fixture(scope="module")
def locked() -> Iterator[ServedPage]:
    served = ServedPage(8720, "127.0.0.1", token="säcret/1")
    yield served
    served.stop()


def got(port: int, path: str, **headers: str) -> tuple[int, dict[str, str]]:
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    told = answer.status, dict(answer.getheaders())
    answer.read()
    connection.close()
    return told


def test_a_page_with_a_token_opens_to_its_own_address_alone(locked: ServedPage) -> None:
    port = locked.server.get_port()
    for path in ("/", "/?token=", "/?token=other", "/index.html?token=s%C3%A4cret"):
        assert got(port, path)[0] == 401, path
    for cookie in ("", "a=b", "dro-grasp-00000000=other", ";;;="):
        assert got(port, "/", Cookie=cookie)[0] == 401, cookie
    status, headers = got(port, locked.url.partition(str(port))[2])
    assert (status, headers["Location"]) == (303, "/")
    kept = headers["Set-Cookie"].partition(";")[0]
    assert got(port, "/", Cookie=f"other=1; {kept}")[0] == 200
    assert "HttpOnly" in headers["Set-Cookie"]
    with pytest.raises(websockets.exceptions.InvalidStatus, match="401"):
        asyncio.run(connect(port, f"http://127.0.0.1:{port}"))
    asyncio.run(connect(port, f"http://127.0.0.1:{port}", Cookie=kept))


def test_where_others_can_connect_a_token_is_made_up() -> None:
    served = ServedPage(8740, "0.0.0.0")
    try:
        assert "/?token=" in served.url
        assert len(served.token or "") >= 16
        assert got(served.server.get_port(), "/")[0] == 401
    finally:
        served.stop()


def packed(**content: object) -> bytes:
    return msgspec.msgpack.encode(content)


@pytest.mark.parametrize("message", [
    "text", b"", b"\xc1\xc1", packed(a=1), packed(type="Nothing"), packed(type="GuiUpdateMessage"),
    msgspec.msgpack.encode([1, 2]),
    packed(type="GuiUpdateMessage", uuid="SLIDER", updates={"value": "much"}),
    packed(type="GuiUpdateMessage", uuid="SLIDER", updates={"nothing": 1}),
    packed(type="GuiUpdateMessage", uuid="SLIDER", updates=7),
])
def test_a_message_that_cannot_be_understood_costs_one_line(
    page: ServedPage, message: str | bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    slider = page.server.gui.add_slider("Grasp", 0, 9, 1, 0)
    if isinstance(message, bytes):  # names are of one length, which is told before them
        uuid = slider._impl.uuid.encode()
        message = message.replace(b"\xa6SLIDER", msgspec.msgpack.encode(uuid.decode()))
    port = page.server.get_port()
    capfd.readouterr()
    asyncio.run(connect(port, f"http://127.0.0.1:{port}", message))
    time.sleep(0.2)
    gc.collect()
    time.sleep(0.1)
    told = "".join(capfd.readouterr())
    assert "Traceback" not in told
    assert told.count("\n") == 1
    assert "a browser's message was not understood" in told
    asyncio.run(connect(port, f"http://127.0.0.1:{port}"))
