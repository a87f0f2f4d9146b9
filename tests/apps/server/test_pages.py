"""The pages of a grasp server: who may ask, how much, and what a request may hold."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import re
import socket
from collections import Counter
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError, ServerError
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints

pytest.importorskip("fastapi", reason="needs the extra [apps]: pip install '.[apps]'")
pytest.importorskip("uvicorn", reason="needs the extra [apps]: pip install '.[apps]'")

from dro_grasp.apps.server.http_server import Access, application, listening_socket
from dro_grasp.apps.server.messages import GraspCall, field_docs, settings_in
from dro_grasp.apps.server.request_queue import Metrics, Ready, Reply, RequestQueue
from tests.helpers.asgi import Caller, live

HERE = "http://127.0.0.1:8090"
PLAIN: dict[str, Any] = {"hand": "claw", "object": "can"}


class Echo(RequestQueue):
    """A queue that answers with what it was asked."""

    waiting, computing, memory, ready = 0, False, 1, Ready(["claw"], ["can"], 0)

    def __init__(self) -> None:
        self.metrics, self.closed = Metrics(Counter({200: 3})), False

    def submit(self, call: Any) -> Any:
        if call.id == "full":
            raise ServerError("16 requests are waiting already; ask again later", 2.4)
        reply: Future[Reply] = Future()
        reply.set_result(Reply(200, call.model_dump_json().encode()))
        return SimpleNamespace(reply=reply)

    def cancel(self, name: str) -> bool:
        return name == "mine"

    def close(self, patience: float = 0.0) -> None:
        self.closed = True


def client(**access: Any) -> Caller:
    return Caller(application(Echo(), Access(**access)))


def test_requests_have_every_field_of_what_is_asked_with_default_and_description() -> None:
    schema = GraspCall.model_json_schema()["properties"]
    for settings in (GraspRequest, Constraints):
        for field in dataclasses.fields(settings):
            assert schema[field.name]["description"] == field_docs(settings)[field.name]
            assert schema[field.name]["default"] == (list(field.default) if isinstance(field.default, tuple) else field.default)
    call = GraspCall(**PLAIN, num=3, source="network", direction=(0, 0, -1), table=0.1)
    assert settings_in(call, GraspRequest) == GraspRequest(3, source="network")
    assert settings_in(call, Constraints) == Constraints((0, 0, -1), 0.1)


def test_the_documents_request_is_one() -> None:
    document = (Path(__file__).parents[3] / "docs" / "serve.md").read_text()
    (text,) = re.findall(r"^```json\n(.*?)^```", document, re.MULTILINE | re.DOTALL)
    call = GraspCall(**json.loads(text))
    assert (call.object.file.content, call.object.scale, call.table) == (b"solid", 0.001, 0.0)


def test_the_command_line_has_a_page_of_its_own() -> None:
    here = client()
    reply = here("POST", "/generate", PLAIN | {"num": 2, "protocol": "none", "only_successful": True, "path": "/a/can.stl"})
    assert reply.status == 200
    call = reply.json()
    assert (call["num"], call["protocol"], call["only_successful"], call["path"]) == (2, "none", True, "/a/can.stl")
    assert here("POST", "/grasps", PLAIN | {"only_successful": True}).status == 422, "elsewhere it is no option"


def test_a_request_is_answered_and_a_page_describes_it() -> None:
    here = client()
    reply = here("POST", "/grasps", PLAIN | {"num": 2})
    assert (reply.status, reply.json()["object"]["name"], reply.json()["num"]) == (200, "can", 2)
    assert "Palm direction" in here("GET", "/openapi.json").text
    assert here("GET", "/docs").status == 200
    assert here("GET", "/hands").json() == ["claw"]
    assert here("GET", "/objects").json() == ["can"]
    assert here("GET", "/health").json()["status"] == "ok"
    assert 'dro_grasp_replies_total{status="200"} 3\n' in here("GET", "/metrics").text


@pytest.mark.parametrize(("body", "told"), [
    (PLAIN | {"nim": 2}, "nim: Extra inputs"), ({"hand": "claw"}, "object: Field required"), (PLAIN | {"num": "x"}, "num: "),
    (PLAIN | {"object": {"name": "can", "points": [[0, 0, 0]]}}, "one of name, file and points"),
    (PLAIN | {"object": {}}, "one of name, file and points"), (PLAIN | {"object": {"points": [[0, 0]]}}, "object.points.0.2"),
    (PLAIN | {"object": {"file": {"name": "a.stl", "content": "?"}}}, "object.file.content"),
    (PLAIN | {"object": {"file": {"name": "a.stl", "content": None}}}, "content is no text"), ([], "the request"),
    (PLAIN | {"num": True}, "num: "), (PLAIN | {"mass": True}, "mass"), (PLAIN | {"table": False}, "table"),
    (PLAIN | {"direction": [0, 0, True]}, "direction"), (PLAIN | {"object": {"points": [[0, True, 0]]}}, "true is no number"),
    (PLAIN | {"object": {"name": "can", "scale": True}}, "object.scale"),
    (PLAIN | {"id": "../x"}, "id: "), (PLAIN | {"camera": {"frame": "base", "T_frame_camera": [[1]]}}, "camera.T_frame_camera"),
])
def test_a_request_that_is_none_is_told_why(body: Any, told: str) -> None:
    reply = client()("POST", "/grasps", body)
    assert reply.status == 422
    assert told in reply.json()["error"]


@pytest.mark.parametrize("content", [b"{", b"[" * 100_000])
def test_a_body_that_is_no_json_or_too_deep_is_refused(content: bytes) -> None:
    reply = client()("POST", "/grasps", parts=[content])
    assert reply.status in {400, 422}
    assert set(reply.json()) == {"error"}


@pytest.mark.parametrize(("headers", "status"), [
    ({"Host": "evil.example"}, 403), ({"Origin": "http://evil.example"}, 403), ({"Origin": HERE}, 200), ({}, 200),
])
def test_foreign_pages_are_refused(headers: dict[str, str], status: int) -> None:
    assert client()("POST", "/grasps", PLAIN, headers).status == status


def test_no_request_waits_for_a_name_server(monkeypatch: pytest.MonkeyPatch) -> None:
    here = client()
    monkeypatch.setattr(socket, "getfqdn", lambda *_: pytest.fail("it is asked"))
    assert here("GET", "/health").status == 200
    assert here("GET", "/health", headers={"Host": "evil.example"}).status == 403


@pytest.mark.parametrize(("borne", "status"), [
    (None, 401), ("Bearer other", 401), ("Bearer séc", 401), ("secret", 401), ("Basic secret", 401), ("Bearersecret", 401),
    ("Bearer", 401), ("Bearer secret", 200), ("bearer secret", 200), ("BEARER  secret", 200)])
def test_a_token_opens_everything_and_nothing_else_does(borne: str | None, status: int) -> None:
    here, headers = client(token="secret"), {} if borne is None else {"Authorization": borne}
    for page in ("/hands", "/metrics", "/docs", "/openapi.json"):
        assert here("GET", page, headers=headers).status == status, page
    assert here("POST", "/grasps", PLAIN, headers).status == status
    assert here("GET", "/health", headers=headers).status == 200


def test_others_are_not_served_without_a_token() -> None:
    for token in (None, ""):
        with pytest.raises(OptionError, match="give a token"):
            Access("0.0.0.0", token)
    assert Access("0.0.0.0", "secret").token
    with pytest.raises(OptionError, match="megabytes is nan"):
        Access(megabytes=float("nan"))


def test_large_bodies_are_refused_whether_they_tell_their_size_or_not() -> None:
    here = client(megabytes=0.001)
    large = PLAIN | {"object": "c" * 2000}
    parts = [json.dumps(large).encode()[part] for part in (slice(900), slice(900, None))]
    for reply in (here("POST", "/grasps", large), here("POST", "/grasps", parts=parts)):
        assert reply.status == 413
        assert "more than 0.001 MB" in reply.json()["error"]
    assert here("POST", "/grasps", PLAIN).status == 200


def test_slow_bodies_are_refused() -> None:
    assert Caller(application(Echo(), Access(body_seconds=0.05)), delay=0.2)("POST", "/grasps", PLAIN).status == 408


def test_a_full_queue_asks_to_come_again_and_a_request_can_be_cancelled() -> None:
    reply = client()("POST", "/grasps", PLAIN | {"id": "full"})
    assert (reply.status, reply.headers["retry-after"]) == (503, "3")
    assert "ask again later" in reply.json()["error"]
    assert client()("DELETE", "/grasps/mine").json() == {"cancelled": "mine"}
    for unknown in (client()("DELETE", "/grasps/other"), client()("GET", "/nothing")):
        assert (unknown.status, set(unknown.json())) == (404, {"error"})


def test_the_desk_is_closed_when_the_server_stops() -> None:
    queue = Echo()
    asyncio.run(live(application(queue, Access())))
    assert queue.closed


def test_an_address_that_is_taken_or_foreign_is_refused() -> None:
    with listening_socket("127.0.0.1", 0) as taken:
        for host, port in (("127.0.0.1", taken.getsockname()[1]), ("192.0.2.1", 0)):
            with pytest.raises(OptionError, match="cannot serve at"):
                listening_socket(host, port)
    with pytest.raises(OptionError, match="port is 99999"):
        listening_socket("127.0.0.1", 99999)


@pytest.mark.parametrize(("arguments", "told"), [
    (["--host", "0.0.0.0"], "give a token"), (["--queue", "0"], "the queue is 0 long"), (["--port", "70000"], "port is 70000"),
])
def test_a_server_that_cannot_be_does_not_start(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DRO_GRASP_TOKEN", raising=False)
    assert main(["serve", "--port", "0", *arguments]) == 2
    assert told in capsys.readouterr().err
