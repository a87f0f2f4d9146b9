"""`dro-grasp generate --server`: the same file, table, messages and exit codes as without; what a server cannot do is told."""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from dro_grasp.cli.main import main
from dro_grasp.errors import DroGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import object_of

pytest.importorskip("pydantic", reason="needs the extra [apps]: pip install '.[apps]'")

from dro_grasp.apps.server.answering import Answerer, ServerConfig
from dro_grasp.apps.server.messages import GenerateCall, GraspCall

TUBE = trimesh.creation.cylinder(0.03, 0.1)
HEAVY = {"torch", "numpy", "scipy", "mujoco", "trimesh", "pyarrow", "pandas", "pydantic", "fastapi", "uvicorn", "matplotlib"}
"""Packages of which each takes longer to load than all that asking a server needs."""


class Page(BaseHTTPRequestHandler):
    """The server's page, in this process: its own queue and limits are tested elsewhere."""

    def do_POST(self) -> None:
        assert self.path == "/generate"
        call = GenerateCall(**json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        try:
            status, said = 200, self.server.answerer.answer(call).model_dump_json()  # type: ignore[attr-defined]
        except DroGraspError as error:
            status, said = 422, json.dumps({"error": str(error)})
        except ZeroDivisionError as error:
            status, said = 500, json.dumps({"error": str(error)})
        self.send_response(status)
        self.end_headers()
        self.wfile.write(said.encode())

    def log_message(self, format: str, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh that no server knows."""
    file = tmp_path_factory.mktemp("own") / "tube.stl"
    TUBE.export(file)
    return file


@pytest.fixture(scope="module")
def answerer(weights: str) -> Answerer:
    return Answerer(ServerConfig(weights, hands=("gripper3",)))


@pytest.fixture
def server(answerer: Answerer) -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Page) as server:
        server.answerer = answerer  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def without_times(text: str) -> str:
    """What a command says, without times."""
    return re.sub(r"\d+\.\d+ s\b", "TIME", text)


@pytest.mark.parametrize("options", [
    ["--object", "mug", "--protocol", "strict"],
    ["--object", "sphere", "--direction", "0", "0", "-1", "--max-tilt", "0.5", "--table", "-0.15"],
    ["--object", "TUBE", "--scale", "0.9", "--mass", "0.2", "--keep-out", "0.2", "0", "0", "0.05", "--touch-table", "no"],
    ["--object", "TUBE", "--only-successful", "--protocol", "dro", "--obstacles", "WALL"],
    ["--object", "SCAN", "--camera", "CAMERA", "--keep-table", "--seed", "4"],
], ids=lambda options: options[1] + options[2])
def test_a_server_makes_the_same_file_and_says_the_same(
    options: list[str], weights: str, own: Path, server: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = trimesh.transformations.rotation_matrix(2.5, [1, 0, 0], [0.3, 0.2, 0.8])
    files = {"TUBE": own, "SCAN": tmp_path / "scan.npy", "CAMERA": tmp_path / "camera.json", "WALL": tmp_path / "wall.npy"}
    np.save(files["SCAN"], TUBE.sample(300, seed=0) + np.array([0, 0, 0.5]))
    np.save(files["WALL"], TUBE.sample(300, seed=1) + np.array([0.3, 0, 0]))
    files["CAMERA"].write_text(json.dumps({"frame": "base", "T_frame_camera": pose.tolist()}))
    words = [str(files.get(word, word)) for word in options]
    output, said = tmp_path / "grasps.parquet", []
    base = ["generate", "--hand", "gripper3", *words, "--num", "2", "--source", "network", "--candidates", "1", "--output"]
    for where in (["--weights", weights], ["--server", server]):
        assert main([*base, str(output), *where]) == 0
        said.append((output.read_bytes(), *map(without_times, capsys.readouterr())))
        output.unlink()
    assert said[0] == said[1]


def test_the_file_of_a_sent_mesh_records_where_it_lies(own: Path, server: str, tmp_path: Path) -> None:
    output = tmp_path / "grasps.parquet"
    options = ["--num", "1", "--source", "network", "--candidates", "1", "--protocol", "none"]
    base = ["generate", "--hand", "gripper3", "--object", str(own), "--server", server, "--output", str(output)]
    assert main([*base, *options]) == 0
    assert object_of(GraspBatch.load(output), None, 1.0).volume == pytest.approx(TUBE.volume, rel=1e-3)


def test_the_file_of_an_object_that_the_server_has_records_where_it_lies(own: Path, weights: str, tmp_path: Path) -> None:
    answerer = Answerer(ServerConfig(weights, hands=("gripper3",), objects=(str(own),)))
    call = {"hand": "gripper3", "object": {"name": "tube", "scale": 0.9}, "num": 1, "source": "network", "candidates": 1}
    answer = answerer.answer(GenerateCall(**call, protocol="none"))
    (tmp_path / "grasps.parquet").write_bytes(base64.b64decode(answer.file))
    back = object_of(GraspBatch.load(tmp_path / "grasps.parquet"), None, 1.0)
    assert back.volume == pytest.approx(0.9**3 * TUBE.volume, rel=1e-3)
    assert answerer.answer(GraspCall(**call)).seconds["total"] > 0, "as `generate --json` calls it"


def test_json_is_the_same_and_the_environment_may_name_the_server(
    weights: str, server: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["generate", "--hand", "gripper3", "--object", "can", "--num", "2", "--source", "network", "--candidates", "1",
            "--json"]
    assert main([*base, "--weights", weights]) == 0
    here = json.loads(capsys.readouterr().out)
    monkeypatch.setenv("DRO_GRASP_SERVER", server)
    assert main(base) == 0
    there = json.loads(capsys.readouterr().out)
    assert set(here.pop("seconds")) == set(there.pop("seconds"))
    assert here == there
    assert main([*base, "--weights", weights, "--server", "none"]) == 0, "the command line has the last word"


@pytest.mark.parametrize(("options", "words"), [
    (["--num", "0"], "num is 0; ask for at least one grasp (--num 16)"), (["--object", "mugg"], "knows no object 'mugg'"),
    (["--hand", "allegr"], "knows no hand 'allegr'"), (["--picture", "a.png"], "cannot do --picture"), (["--view"], "--view"),
    (["--weights", "any"], "cannot do --weights"), (["--device", "cuda"], "cannot do --device"),
    (["--source", "my.module:Mine"], "takes auto, network, optimiser"), (["--hand", __file__], "give the name"),
    (["--object", "."], "one object at a time"), (["--output", "a.csv"], "such as a.parquet"),
    (["--camera", "nowhere.json"], "nowhere.json"), (["--num", "300"], "at most 1000 candidates"),
])
def test_what_a_server_cannot_do_is_told(
    options: list[str], words: str, server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = {"--hand": ["gripper3"], "--object": ["can"]} | {options[0]: options[1:]}
    assert main(["generate", *[word for pair in given.items() for word in (pair[0], *pair[1])], "--server", server]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert words in said.err
    assert said.err.startswith("error: ")


def test_faults_and_absent_servers_have_their_exit_codes(
    answerer: Answerer, server: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: Any) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(answerer, "answer", broken)
    base = ["generate", "--hand", "gripper3", "--object", "can", "--server"]
    assert main([*base, server]) == 1
    assert "internal error: RuntimeError: oops" in capsys.readouterr().err
    assert main([*base, "http://127.0.0.1:9"]) == 2
    assert "no grasp server answers at http://127.0.0.1:9" in capsys.readouterr().err


def test_asking_a_server_loads_nothing_heavy(server: str, tmp_path: Path) -> None:
    output = tmp_path / "grasps.parquet"
    code = ("import sys\nfrom dro_grasp.cli.main import main\n"
            f"print(main(sys.argv[1:]), sorted({HEAVY} & set(sys.modules)))")
    words = ["generate", "--hand", "gripper3", "--object", "can", "--num", "1", "--source", "network", "--candidates", "1",
             "--output", str(output)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True,
                          env=os.environ | {"DRO_GRASP_SERVER": server})
    assert done.stdout.splitlines()[-1] == "0 []", done.stderr
    assert len(GraspBatch.load(output)) == 1


class Foreign(Page):
    """Another program, which answers anything."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'{"report": {}}')


def test_another_program_at_the_address_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with HTTPServer(("127.0.0.1", 0), Foreign) as server:
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        output = tmp_path / "grasps.parquet"
        assert main(["generate", "--hand", "gripper3", "--object", "sphere", "--output", str(output),
                     "--server", f"http://127.0.0.1:{server.server_port}"]) == 2
        server.shutdown()
    assert "answers, but not as a grasp server of version" in capsys.readouterr().err
    assert not output.exists()
