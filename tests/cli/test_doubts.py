"""What is doubtful in a hand's file is told, short, by the commands that grasp with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import dro_grasp as dro
from dro_grasp.apps.server import http_server, request_queue
from dro_grasp.arm.robots import loading
from dro_grasp.cli.main import main
from dro_grasp.errors import ObjectError
from dro_grasp.hands.description.loader import load_description
from dro_grasp.hands.doubts import MOST, doubts
from dro_grasp.hands.library import hand_names, load_hand_description
from dro_grasp.objects import catalogue
from dro_grasp.training.data.engine import schedule
from tests.helpers.claw_urdf import claw, joint, link, meshed, written


def refuse(*_: Any, **__: Any) -> None:
    raise ObjectError("enough")


@pytest.fixture
def begin(weights: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str, str], int]:
    """Each command with a hand, up to where its work begins."""
    monkeypatch.setattr(catalogue, "load_object", refuse)
    monkeypatch.setattr(loading, "load_robot", lambda hand: SimpleNamespace(hand=dro.load_hand(hand)))
    monkeypatch.setattr(request_queue, "RequestQueue", lambda *_: None)
    monkeypatch.setattr(http_server, "serve_grasps", lambda *_: None)
    monkeypatch.setattr(schedule, "synthesize_dataset", lambda *_, **__: schedule.DatasetReport(1, 1, 1, 1.0, {}))
    words = {
        "generate": ["--object", "sphere", "--weights", weights], "synthesize": ["--object", "can", "--output", str(tmp_path)],
        "serve": ["--port", "0"], "plan": ["--object", "can", "--obstacles", "can"]}

    def run(command: str, hand: str) -> int:
        return main([command, "--robot" if command == "plan" else "--hand", hand, *words[command]])

    return run


@pytest.mark.parametrize("command", ["generate", "plan", "serve", "synthesize"])
def test_a_finger_whose_mesh_is_lost_is_told(
    begin: Callable[[str, str], int], command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, meshed("lost.stl"))
    begin(command, str(path))
    told = capsys.readouterr().err
    assert "hand claw: warning: left: collision mesh 'lost.stl' was not found and is left out\n" in told
    assert f"hand claw: see dro-grasp hand check {path}\n" in told
    begin(command, "gripper3")
    assert "hand check" not in capsys.readouterr().err


def test_doubts_are_few_lines(tmp_path: Path) -> None:
    shapes = "".join(link(name, f'<mesh filename="{name}.stl"/>', kinds=("collision",)) for name in "abcd")
    fixed = "".join(joint(f"to_{name}", "left", name, "0 0 0", more="", kind="fixed") for name in "abcd")
    *told, last = doubts(load_description(written(tmp_path, claw(shapes + fixed))))
    assert len(told) == MOST
    assert last.startswith("1 more; see dro-grasp hand check ")


def test_fingers_that_are_only_drawn_are_told(tmp_path: Path) -> None:
    drawn = claw(links=link("left", kinds=("visual",)) + link("right", kinds=("visual",)))
    told = doubts(load_description(written(tmp_path, drawn)))
    assert told[0] == "warning: left, right: has a visual but no collision shape; it cannot touch anything"


def test_hands_without_faults_are_not_doubted() -> None:
    names = [name for name, source in hand_names().items() if source == "builtin"]
    assert [doubts(load_hand_description(name)[0]) for name in names] == [[]] * len(names)
