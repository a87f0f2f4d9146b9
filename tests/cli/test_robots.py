"""`robot check` and `robot list`: what they print in both forms; robots themselves are tested where they are read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from dro_grasp.arm.robots.loading import BUILTIN_ROBOTS
from dro_grasp.cli.main import main


def test_the_list_names_every_file_that_ships(capsys: pytest.CaptureFixture[str]) -> None:
    there = sorted(path.stem for path in BUILTIN_ROBOTS.glob("*.yaml"))
    assert main(["robot", "list", "--json"]) == 0
    assert sorted(json.loads(capsys.readouterr().out)["robots"]) == there
    assert main(["robot", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in there)
    assert "the path of a robot.yaml" in said


def test_a_check_says_the_same_to_programs_as_to_people(
    small_robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    stated = yaml.safe_load(Path(small_robot).read_text())
    assert main(["robot", "check", small_robot, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["picture"] is None
    assert {name: joint["home"] for name, joint in told["joints"].items()} == pytest.approx(stated["home"])
    assert (told["hand"], told["camera"], told["usable"]) == ("gripper3", False, True)
    assert main(["robot", "check", small_robot]) == 0
    said = capsys.readouterr().out
    assert f"{len(told['joints'])} arm joints, hand gripper3 with {len(told['hand_joints'])}" in said
    assert "no camera" in said
    assert f"{told['free_share']:.0%} of random configurations" in said
    assert said.endswith("usable\n"), "no picture was asked for"


@pytest.mark.parametrize(("options", "said"), [
    ([], "nowhere.yaml"), (["--picture", "nowhere/robot.png"], "create it first (mkdir -p ")])
def test_what_is_not_there_is_status_2(options: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot", "check", "nowhere.yaml", *options]) == 2
    assert said in capsys.readouterr().err
