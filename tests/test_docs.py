"""The documents say nothing that is not there: commands parse, names exist, snippets run, links lead somewhere."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import dro_grasp as dro
from dro_grasp.cli.main import main, parse
from dro_grasp.frames import read_motion
from tests.helpers.weights import untrained_weights

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
# The development assets have folders hands/ and objects/ as well.
ROOMS = {path.name for path in (ROOT / "src" / "dro_grasp").iterdir() if path.is_dir()} - {"hands", "objects"}
FOLDERS = ["lab", "docs", "scripts", "tests", "src", *ROOMS]
FILE = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w/.-]+\.\w+)`")
MAKE_TARGET = re.compile(r"^([\w-]+):", re.MULTILINE)


def blocks(language: str) -> list[tuple[str, str]]:
    """(document, text) of every code block in a language."""
    found = []
    for document in DOCUMENTS:
        found += [(document.name, m[2]) for m in BLOCK.finditer(document.read_text()) if m[1] == language]
    return found


def commands() -> list[str]:
    """Every command of shell in the documents, and of the examples in --help."""
    texts = [text.replace("\\\n", " ") for _, text in blocks("bash")]
    parts = [part for text in texts for line in text.splitlines() for part in line.split("&&")]
    lines = [re.split(r"(?:^|\s)#", part)[0].strip() for part in parts]
    for file in (ROOT / "src" / "dro_grasp" / "cli").glob("*.py"):
        for example in re.findall(r"Example: (.*?)\n    (?:\"\"\"|\n)", file.read_text(), re.DOTALL):
            lines.append(" ".join(example.split()))
    return sorted({line for line in lines if line})


@pytest.mark.parametrize("command", commands())
def test_commands_are_understood(command: str) -> None:
    words = shlex.split(command)
    variables = {}
    while "=" in words[0]:
        name, _, value = words.pop(0).partition("=")
        variables[name] = value
    for name in {"PRETRAIN", "TRAIN"} & variables.keys():
        files = ["--bundle", "b", "--run-folder", "r", "--output", "o"]
        parse([name.lower(), *files, *shlex.split(variables[name])])
    if words[0] == "torchrun":
        words = words[words.index("--no-python") + 1 :]
    if words[0] == "make":
        assert words[1] in MAKE_TARGET.findall((ROOT / "Makefile").read_text())
    elif words[0] == "dro-grasp":
        assert_folders_exist(parse(words[1:]))
    elif words[:3] == ["python3", "-m", "venv"]:
        assert len(words) == 4, command
    elif words[:2] == ["python", "-m"]:
        assert (ROOT / f"{words[2].replace('.', '/')}.py").exists(), words[2]
    elif words[0].startswith("scripts/"):
        assert (ROOT / words[0]).stat().st_mode & 0o100, "not executable"
        assert variables.keys() <= set(re.findall(r"^#   ([A-Z]+) ", (ROOT / words[0]).read_text(), re.MULTILINE))
    else:
        assert words[0] in {"git", "cd", "mkdir", "pip", "source"}, command


def assert_folders_exist(command: object) -> None:
    """Commands make the folders that they fill, but a file that they write needs its folder, which a new clone may lack."""
    for path in (getattr(command, name, None) for name in ("output", "picture")):
        if path is not None and Path(path).suffix:
            assert (ROOT / path).parent.is_dir(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: d.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in LINK.findall(document.read_text()):
        if not target.startswith(("http://", "https://", "#")):
            assert (document.parent / target.split("#")[0]).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: d.name)
def test_named_files_exist(document: Path) -> None:
    for name in FILE.findall(document.read_text()):
        assert (ROOT / name).exists() or (ROOT / "src" / "dro_grasp" / name).exists(), name


def test_every_document_is_reachable_from_the_readme() -> None:
    linked = set(LINK.findall((ROOT / "README.md").read_text()))
    assert {f"docs/{d.name}" for d in DOCUMENTS[1:]} <= linked


def test_python_parses_and_uses_public_names() -> None:
    for document, text in blocks("python"):
        for node in ast.walk(ast.parse(text, document)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "dro":
                assert node.attr in dro.__all__, f"{document}: dro.{node.attr}"


def test_the_snippets_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The README's and that of first-grasps.md, then the one that reads their file.

    A small hand and untrained weights keep it quick.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dro_grasp.network.checkpoints.locate_weights", lambda name=None: untrained_weights(tmp_path))
    quicker = {'"allegro"': '"gripper3"', '"mug"': '"sphere"', "num=16": "num=2"}
    for document in ("README.md", "first-grasps.md"):
        (text,) = (t for d, t in blocks("python") if d == document)
        for usual, quick in quicker.items():
            assert usual in text, document
            text = text.replace(usual, quick)
        names: dict = {}
        exec(compile(text, document, "exec"), names)
        names["grasps"].save("grasps.parquet")
    assert (tmp_path / "grasps.png").exists()
    reader = next(t for d, t in blocks("python") if d == "file-formats.md")
    exec(compile(reader, "file-formats.md", "exec"), {})
    assert "a_base" in capsys.readouterr().out


@pytest.mark.slow
def test_the_first_lines_work_in_a_fresh_shell(tmp_path: Path) -> None:
    """The README's first block as it stands, but for the installation, which the tests' environment has."""
    installed = {"python3", "pip"}
    lines = next(t for d, t in blocks("bash") if d == "README.md").splitlines()
    assert len(lines) == 5
    *quick, last = [line for line in lines if line.split()[0] not in installed]
    kept = {"HOME", "LANG", "TMPDIR", "PYTHONPATH", "DRO_GRASP_CACHE"}
    environment = {name: value for name, value in os.environ.items() if name in kept}
    environment["PATH"] = f"{Path(sys.executable).parent}:/usr/bin:/bin"
    shell = {"cwd": tmp_path, "env": environment, "text": True}
    done = subprocess.run(["bash", "-eu", "-c", "\n".join(quick)], capture_output=True, timeout=600, **shell)
    assert done.returncode == 0, done.stderr
    assert "8 of 8 grasps succeeded" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"grasps.parquet", "grasps.png"}
    with subprocess.Popen(["bash", "-eu", "-c", f"exec timeout 120 {last}"], stderr=subprocess.PIPE, **shell) as viewer:
        assert any("viewer: http://127.0.0.1" in line for line in viewer.stderr)
        viewer.terminate()


@pytest.mark.slow
def test_a_request_that_cannot_be_met_says_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "first-grasps.md").read_text()
    command = next(line for line in page.splitlines() if "--direction 0 0 1 --table" in line)
    said = next(m[2] for m in BLOCK.finditer(page) if m[2].startswith("error:"))
    assert main(shlex.split(command)[1:]) == 2
    assert " ".join(capsys.readouterr().err.split()) == " ".join(said.split())


def test_json_example_has_the_keys_of_generate() -> None:
    (example,) = (e for e in (json.loads(text) for _, text in blocks("json")) if "seconds" in e)
    source = (ROOT / "src" / "dro_grasp" / "apps" / "report.py").read_text()
    assert all(f'"{key}":' in source for key in example)
    assert list(example["seconds"]) == [
        "start", "load", "network", "choose", "decode", "optimiser", "refine", "settle", "rank", "weigh", "ease", "trial",
        "files", "total"]


@pytest.mark.parametrize(("document", "key"), [("export.md", "T_frame_object"), ("own-object.md", "T_frame_camera")])
def test_frame_examples_are_frames(tmp_path: Path, document: str, key: str) -> None:
    (text,) = (text for name, text in blocks("json") if name == document)
    (tmp_path / "frame.json").write_text(text)
    assert read_motion(tmp_path / "frame.json", key)[0] == "base_link"


def test_public_names_of_the_readme_demo_exist() -> None:
    from dro_grasp.hands.library import hand_names
    from dro_grasp.objects.catalogue import object_names

    makefile = (ROOT / "Makefile").read_text()
    hand, obj = re.search(r"--hand (\w+)", makefile)[1], re.search(r"--object (\w+)", makefile)[1]
    assert hand_names()[hand] == "builtin"
    assert object_names()[obj] == "test", "the demo's object is one that no weights were trained on"
