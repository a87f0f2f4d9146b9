"""A grasp server as it runs: a process of its own, asked over HTTP."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh

import dro_grasp as dro
from tests.helpers.weights import untrained_weights

pytest.importorskip("fastapi", reason="needs the extra [apps]: pip install '.[apps]'")
pytest.importorskip("uvicorn", reason="needs the extra [apps]: pip install '.[apps]'")

pytestmark = [pytest.mark.slow, pytest.mark.alone]

OPTIONS: dict[str, Any] = {"source": "network", "candidates": 1, "refine": False}


@contextmanager
def serving(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server's process and its address."""
    weights = str(untrained_weights(folder))
    command = [sys.executable, "-m", "dro_grasp", "serve", "--port", "0", "--hand", "gripper3", "--weights", weights]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        yield process, process.stderr.readline().split()[2].rstrip(",")
        process.kill()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen[str], str]]:
    with serving(tmp_path_factory.mktemp("weights")) as started:
        yield started


@pytest.fixture(scope="module")
def client(running) -> dro.GraspClient:
    return dro.GraspClient(running[1])


def test_the_client_asks_by_name_by_file_and_with_points(client: dro.GraspClient, tmp_path: Path) -> None:
    mesh, file = trimesh.creation.cylinder(0.03, 0.1), tmp_path / "tube.stl"
    mesh.export(file)
    answers = [client.predict("gripper3", obj, 1, **OPTIONS) for obj in ("can", file, str(file), mesh.sample(300, seed=0))]
    assert [answer["object"] for answer in answers] == ["can", "tube", "tube", "cloud"]
    assert answers[1]["grasps"] == answers[2]["grasps"] != answers[0]["grasps"]
    wall = mesh.sample(300, seed=0) + np.array([0.3, 0, 0])
    assert client.predict("gripper3", "can", 1, obstacles=wall, **OPTIONS)["grasps"]
    larger = client.predict("gripper3", file, 1, scale=1.5, **OPTIONS)
    assert larger["grasps"] != answers[1]["grasps"]
    with pytest.raises(dro.DroGraspError, match=r"knows no object 'tube\.obj'"):
        client.predict("gripper3", "tube.obj", 1)


def test_a_closed_connection_cancels_its_request(client: dro.GraspClient, running) -> None:
    host, port = running[1].removeprefix("http://").split(":")
    body = b'{"hand": "gripper3", "object": "can", "num": 100, "candidates": 10, "source": "optimiser"}'
    head = f"POST /grasps HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(head.encode() + body)
        while not client.ask("GET", "/health")["computing"]:
            time.sleep(0.02)
    begin = time.monotonic()
    while client.ask("GET", "/health")["computing"]:
        time.sleep(0.02)
    assert time.monotonic() - begin < 10
    assert 'replies_total{status="409"} 1' in urlopen(f"{running[1]}/metrics").read().decode()


def test_nobody_answers_at_another_address() -> None:
    with pytest.raises(dro.DroGraspError, match=r"no grasp server answers.*start one"):
        dro.GraspClient("http://127.0.0.1:9").predict("gripper3", "can")


def test_sigterm_lets_a_request_end_and_closes_the_server(client: dro.GraspClient, running) -> None:
    process, answers = running[0], []
    asked = threading.Thread(target=lambda: answers.append(client.predict("gripper3", "can", 2, **OPTIONS)))
    asked.start()
    while asked.is_alive() and not client.ask("GET", "/health")["computing"]:
        time.sleep(0.005)
    process.terminate()
    asked.join(20)
    assert process.wait(20) == 0
    assert len(answers[0]["grasps"]) == 2
    assert process.stderr is not None
    assert process.stderr.read() == ""


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT])
def test_a_server_that_stops_tells_all_that_wait_and_its_log_is_quiet(tmp_path: Path, sign: signal.Signals) -> None:
    told: list[str] = []
    with serving(tmp_path) as (process, url):
        client = dro.GraspClient(url)

        def ask(num: int) -> None:
            with pytest.raises(dro.DroGraspError) as refused:
                client.predict("gripper3", "can", num, candidates=10, source="optimiser")
            told.append(str(refused.value))

        threads = [threading.Thread(target=ask, args=[100]) for _ in range(4)]
        for thread in threads:
            thread.start()
        while (health := client.ask("GET", "/health"))["waiting"] < 3 or not health["computing"]:
            time.sleep(0.02)
        silent = socket.create_connection(url.removeprefix("http://").split(":"))  # type: ignore[arg-type]
        process.send_signal(sign)
        for thread in threads:
            thread.join(40)
        assert process.wait(40) == 0
        silent.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert told == ["the server is stopping; ask another one, or ask again once it runs"] * 4


def test_a_small_load_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lab.benchmarks import serving

    monkeypatch.setattr(serving, "LONE", 2)
    arguments = ["--clients", "2", "--requests", "12", "--weights", str(untrained_weights(tmp_path)), "--json"]
    assert serving.main(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["requests"], told["lost"], told["exit"]) == (12, 0, 0)
    assert told["ratio"] < 3  # 1.5 on a quiet machine
