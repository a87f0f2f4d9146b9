"""What the client of a grasp server sends: a request that the server understands, whatever the arguments are made of."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.errors import OptionError, ServerError

pytest.importorskip("pydantic", reason="needs the extra [apps]: pip install '.[apps]'")

from dro_grasp.apps.server.messages import GraspCall

CLOUD = np.random.default_rng(0).uniform(-0.03, 0.03, (40, 3)).astype(np.float32)
POSE = ((0, -1, 0, 0.5), (1, 0, 0, 0.25), (0, 0, 1, 0.75), (0, 0, 0, 1))


class Listener(BaseHTTPRequestHandler):
    """Notes requests as the server reads them, and answers with nothing."""

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.calls.append(GraspCall(**json.loads(content)))  # type: ignore[attr-defined]
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"{}")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[HTTPServer]:
    with HTTPServer(("127.0.0.1", 0), Listener) as server:
        server.calls = []  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def sent(server: HTTPServer) -> list[Any]:
    """Requests as the server reads them."""
    return server.calls  # type: ignore[attr-defined]


@pytest.fixture
def client(server: HTTPServer) -> dro.GraspClient:
    return dro.GraspClient(f"http://127.0.0.1:{server.server_port}")


@pytest.mark.parametrize("array", [np.array, torch.tensor])
def test_numbers_may_be_arrays_and_tensors(client: dro.GraspClient, sent: list[Any], array: Any) -> None:
    client.predict(
        "gripper3", array(CLOUD), 2, direction=array([0, 0, -1]), contact_region=array([[0, 0, 0.5, 0.25]]),
        table=array(-0.5), mass=array(0.25), keep_table=np.bool_(True), camera={"frame": "base", "T_frame_camera": array(POSE)},
        obstacles=array(CLOUD) + 1, keep_out=[array([0, 1, 0, 0.25])])
    (call,) = sent
    assert (call.direction, call.contact_region, call.table, call.mass) == ((0, 0, -1), ((0, 0, 0.5, 0.25),), -0.5, 0.25)
    assert (call.keep_out, call.object.keep_table) == (((0, 1, 0, 0.25),), True)
    assert call.camera.T_frame_camera == POSE
    for part, points in ((call.object, CLOUD), (call.obstacles, CLOUD + 1)):
        np.testing.assert_array_equal(np.load(io.BytesIO(part.file.content)), points)


def test_a_server_on_this_machine_is_asked_without_a_proxy(
    client: dro.GraspClient, sent: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    client.predict("gripper3", "can")
    assert len(sent) == 1


@pytest.mark.parametrize("token", ["令牌", "schlüssel", "two\nlines"])
def test_a_token_that_cannot_be_sent_is_refused(token: str) -> None:
    with pytest.raises(OptionError, match="token holds characters that a header cannot bear"):
        dro.GraspClient(token=token)


def test_none_is_as_if_it_were_left_out(client: dro.GraspClient, sent: list[Any]) -> None:
    nothing = dict.fromkeys(("obstacles", "camera", "direction", "table", "max_tilt", "protocol"))
    for options in (nothing, {}):
        client.predict("gripper3", "can", id="one", **options)
    assert sent[0] == sent[1]


@pytest.mark.parametrize(("obj", "options", "told"), [
    ("can", {"constraints": dro.Constraints()}, "a Constraints cannot be sent to a grasp server; give .* arrays"),
    (["can"], {}, r"a list that holds no array of numbers .* points \(n, 3\)"),
    ([[0.0, 0.0], [0.0]], {}, "a list that holds no array of numbers"),
    ("can", {"contact_region": {0.1}}, "a set cannot be sent"),
])
def test_what_cannot_be_sent_is_named(
    client: dro.GraspClient, sent: list[Any], obj: Any, options: dict[str, Any], told: str
) -> None:
    with pytest.raises(OptionError, match=told):
        client.predict("gripper3", obj, **options)
    assert not sent


@pytest.mark.parametrize(("choose", "told"), [
    ({"mask": "nowhere.png"}, "mask: no file at nowhere.png"), ([(0, 0, 0)], "give a dict of at, pixel, nearest or mask")])
def test_a_choice_that_cannot_be_sent_is_refused(choose: Any, told: str) -> None:
    with pytest.raises(OptionError, match=told):
        dro.GraspClient("http://127.0.0.1:9").predict("allegro", CLOUD, choose=choose)


@pytest.mark.parametrize("address", ["robot-pc", "127.0.0.1"])
def test_an_address_that_is_none_is_told(address: str) -> None:
    with pytest.raises(ServerError, match=r"no grasp server answers at .*; give http://HOST:PORT"):
        dro.GraspClient(address).predict("allegro", "can")


class Breaking(BaseHTTPRequestHandler):
    """Refuses, and ends before all of its answer is sent."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(503)
        self.send_header("Content-Length", "1000")
        self.end_headers()
        self.wfile.write(b'{"error": "the que')

    def log_message(self, *_: object) -> None:
        pass


def test_an_answer_that_breaks_off_is_told_by_its_status() -> None:
    with HTTPServer(("127.0.0.1", 0), Breaking) as server:
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        with pytest.raises(ServerError, match="HTTP Error 503: Service Unavailable") as told:
            dro.GraspClient(f"http://127.0.0.1:{server.server_port}").predict("gripper3", "can")
        server.shutdown()
    assert told.value.status == 503
