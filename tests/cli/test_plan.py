"""`plan`: what it hands to the planner, prints and writes; the planner returns at once, and is tested on its own."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import dro_grasp as dro
from dro_grasp.arm import planner
from dro_grasp.arm.motion import CHOSEN, STAGES, PlanNotes, PlanScene, Trajectory
from dro_grasp.cli.main import main
from dro_grasp.predict import predictor

NOTES = PlanNotes("arm", "can", ("a",), ("f",), "world", 0.0, 3, {"out of reach": 2}, 1, 0, 1.5, np.eye(4).tolist(), 7,
                  {"grasps": 0.5})


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """What the planner was asked for; its plan takes a second for each stage."""
    asked: dict[str, Any] = {}
    time = np.arange(6.0)
    still = Trajectory(time, time[:, None] / 10, np.zeros((6, 1)), np.zeros((6, 1)))
    wrist = np.eye(4)[None]
    scene = PlanScene(np.zeros((1, 3)), np.zeros((0, 3)), wrist, np.zeros((1, 1)), np.zeros(1), (CHOSEN,))
    made = dro.MotionPlan(NOTES, scene, np.array([0, 0, 1, 2, 3, 4]), still, still)

    def plan(robot: Any, obj: Any, T: Any, obstacles: Any, weights: Any, config: Any, seed: int) -> dro.MotionPlan:
        asked.update(robot=robot, obj=obj, T=T, obstacles=obstacles, weights=weights, config=config, seed=seed)
        return made

    monkeypatch.setattr(planner, "plan", plan)
    monkeypatch.setattr(predictor, "GraspPredictor", lambda weights: weights)
    monkeypatch.chdir(tmp_path)
    return asked


def planned(robot: str, *options: str) -> int:
    return main(["plan", "--robot", robot, "--object", "can", *options])


def test_every_option_reaches_the_planner_and_every_file_is_written(
    asked: dict[str, Any], small_robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    palm = ["--direction", "0", "0", "-1", "--max-tilt", "0.6", "--pregrasp-clearance", "0.012"]
    places = ["--contact-region", "0.5", "0.1", "0.2", "0.03", "--keep-out", "0", "0", "1", "0.1", "0", "0", "2", "0.2"]
    numbers = ["--num", "9", "--top", "2", "--rehearsals", "4", "--planner-seconds", "2.5", "--seed", "7", "--weights", "mine"]
    files = ["--output", "plan.npz", "--trajectory", "plan.yaml", "--csv", "plan.csv"]
    where = ["--at", "0.5", "0.1", "--obstacles", "cube"]
    assert planned(small_robot, *where, *palm, *places, *numbers, *files, "--json") == 0
    hold, spare = ((0.5, 0.1, 0.2, 0.03),), ((0, 0, 1, 0.1), (0, 0, 2, 0.2))
    constraints = dro.Constraints((0, 0, -1), None, 0.6, None, hold, spare, 0.012)
    assert asked["config"] == dro.PlanConfig(9, 2, constraints=constraints, rehearsals=4, planner_seconds=2.5)
    assert (asked["seed"], asked["weights"]) == (7, "mine")
    assert (asked["obj"].name, [o.name for o in asked["obstacles"]]) == ("can", ["cube"])
    stands = np.asarray(asked["obj"].vertices) @ asked["T"][:3, :3].T + asked["T"][:3, 3]
    assert stands[:, 2].min() == pytest.approx(asked["robot"].table.height, abs=1e-3)
    assert asked["T"][:2, 3] == pytest.approx([0.5, 0.1])
    told = json.loads(capsys.readouterr().out)
    assert {name: told[name] for name in ("plan", "trajectory", "csv")} == {
        "plan": "plan.npz", "trajectory": "plan.yaml", "csv": "plan.csv"}
    assert (told["dropped"], told["score"], told["motion_seconds"]) == ({"out of reach": 2}, 1.5, 5.0)
    assert dro.MotionPlan.load("plan.npz").notes == NOTES
    assert [point["positions"] for point in yaml.safe_load(Path("plan.yaml").read_text())["hand"]["points"]][-1] == [0.5]
    assert [row["stage"] for row in csv.DictReader(io.StringIO(Path("plan.csv").read_text()))][1:] == list(STAGES)


def test_the_pose_in_a_file_is_the_objects_and_people_are_told_in_words(
    asked: dict[str, Any], small_robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    T = [[0, -1, 0, 0.4], [1, 0, 0, 0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]]
    Path("pose.json").write_text(json.dumps({"frame": "world", "T_frame_object": T}))
    assert planned(small_robot, "--pose", "pose.json", "--csv", "plan.csv") == 0
    np.testing.assert_allclose(asked["T"], T, atol=1e-7)
    said = capsys.readouterr().out
    assert "1 given to the planner" in said
    assert "motion of 5.0 s" in said
    assert said.endswith("csv: plan.csv\n")
    assert asked["config"] == dro.PlanConfig()


@pytest.mark.parametrize(("options", "said"), [
    (["--seed", "-1"], "seed is -1; give an integer from 0"),
    (["--max-tilt", "0.5"], "give both, for example --direction 0 0 -1"),
    (["--output", "nowhere/plan.npz"], "create it first"),
    (["--at", "nan", "0.1"], "error: --at is nan 0.1; give x and y in metres"),
    (["--at", "0.5", "inf"], "error: --at is 0.5 inf; give x and y in metres"),
    (["--near", "nan", "0"], "error: --near is nan 0; give x and y in metres"),
    (["--planner-seconds", "nan"], "planner_seconds is nan; give a number above 0"),
    (["--planner-seconds", "inf"], "planner_seconds is inf; give a number above 0"),
    (["--camera", "robot"], "has no camera; state it in the robot file, or give --camera JSON"),
])
def test_what_cannot_be_planned_is_refused_before_the_work(
    options: list[str], said: str, asked: dict[str, Any], small_robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert planned(small_robot, *options) == 2
    assert said in capsys.readouterr().err
    assert not asked
    assert not list(tmp_path.iterdir())
