"""Requests under foreign names of this machine, and from foreign pages, are refused."""

from __future__ import annotations

import socket

import pytest

from dro_grasp.web.origins import own_names, refusal


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
