"""Only browsers that show a served page itself may talk to it; uploads read only what was uploaded with them."""

from __future__ import annotations

import asyncio
import io
import socket
import zipfile
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import pytest
import viser
import websockets

from dro_grasp.errors import OptionError
from dro_grasp.viewer.guard import own_names, refusal
from dro_grasp.viewer.stage import ServedPage
from dro_grasp.viewer.uploads import store_upload
from tests.helpers.claw_urdf import claw, meshed


@pytest.mark.parametrize(("host", "origin", "refused"), [
    ("localhost:8080", None, False), ("localhost:8080", "http://localhost:8080", False),
    ("[::1]:8080", "http://[::1]:8080", False),
    ("192.168.1.7:8080", "http://192.168.1.7:8080", False), ("robot-pc:8080", "http://robot-pc:8080", False),
    ("localhost:8080", "http://evil.example", True), ("localhost:8080", "http://localhost:9999", True), ("", None, True),
    ("localhost:8080", "null", True), ("evil.example:8080", "http://evil.example:8080", True), ("[::1", "http://[::1", True),
])
def test_foreign_hosts_and_origins_are_refused(host: str, origin: str | None, refused: bool) -> None:
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    assert bool(refusal(headers, own_names("robot-pc"))) == refused


def test_a_machine_has_its_names_and_that_which_it_is_served_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Arm")
    monkeypatch.setattr(socket, "getfqdn", lambda *_: "arm.lab.example")
    assert own_names("Robot-PC") == {"localhost", "robot-pc", "arm", "arm.lab.example"}


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


@pytest.mark.parametrize("name", ["/etc/passwd", "../other/x.stl", "package://secret/x.stl", "file:///etc/passwd", "~/x.stl"])
def test_an_uploaded_description_reads_only_what_was_uploaded(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "uploads" / "2"
    for other in ("secret", "uploads/other"):
        (tmp_path / other).mkdir(parents=True)
        (tmp_path / other / "x.stl").write_bytes(b"x")
    folder.mkdir()
    with pytest.raises(OptionError, match="was not uploaded with it"):
        store_upload("hand.urdf", meshed(name).encode(), folder)


@pytest.mark.parametrize("text", [
    '<mujoco><include file="a.xml"/></mujoco>', '<mujoco><asset><model name="m" file="a.xml"/></asset></mujoco>'])
def test_an_uploaded_description_includes_nothing(tmp_path: Path, text: str) -> None:
    with pytest.raises(OptionError, match="which uploads may not"):
        store_upload("hand.xml", text.encode(), tmp_path)


@pytest.mark.parametrize(
    "text", ['<mujoco><compiler meshdir="/etc"/></mujoco>', '<mujoco><compiler assetdir="../.."/></mujoco>'])
def test_an_uploaded_description_names_no_other_folder(tmp_path: Path, text: str) -> None:
    with pytest.raises(OptionError, match="was not uploaded with it"):
        store_upload("hand.xml", text.encode(), tmp_path)


def test_an_upload_of_several_files_is_taken(tmp_path: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("hand/hand.urdf", meshed("package://hand/x.obj"))
        archive.writestr("hand/x.obj", "v 0 0 0\n")
    assert store_upload("hand.zip", packed.getvalue(), tmp_path).name == "hand.urdf"
    assert store_upload("claw.urdf", claw().encode(), tmp_path).name == "claw.urdf"
