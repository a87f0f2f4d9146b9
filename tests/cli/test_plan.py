"""`plan`: what it hands to the planner, prints and writes; the planner returns at once, and is tested on its own."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import dro_grasp as dro
from dro_grasp.arm.planning.motion import CHOSEN, STAGES, PlanNotes, PlanScene, Trajectory
from dro_grasp.cli.main import parse

NOTES = PlanNotes("arm", "can", ("a",), ("f",), "world", 0.0, 3, {"out of reach": 2}, 1, 0, 1.5, np.eye(4).tolist(), 7,
                  {"grasps": 0.5})


Planned = Callable[..., int]


@pytest.fixture
def asked() -> dict[str, Any]:
    """What the planner was asked for."""
    return {}


@pytest.fixture
def planned(asked: dict[str, Any], small_robot: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Planned:
    """The command in an empty folder, with a planner whose plan takes a second for each stage."""
    monkeypatch.chdir(tmp_path)
    time = np.arange(6.0)
    still = Trajectory(time, time[:, None] / 10, np.zeros((6, 1)), np.zeros((6, 1)))
    wrist = np.eye(4)[None]
    scene = PlanScene(np.zeros((1, 3)), np.zeros((0, 3)), wrist, np.zeros((1, 1)), np.zeros(1), (CHOSEN,))
    made = dro.MotionPlan(NOTES, scene, np.array([0, 0, 1, 2, 3, 4]), still, still)

    def plan(
        robot: Any, obj: Any, T: Any, obstacles: Any, predictor: Any, config: Any, seed: int, start: Any, place: Any
    ) -> dro.MotionPlan:
        asked.update(robot=robot, obj=obj, T=T, obstacles=obstacles, predictor=predictor, config=config, seed=seed, start=start,
                     place=place)
        return made

    return lambda *options: parse(["plan", "--robot", small_robot, "--object", "can", *options]).run(plan)


def test_every_option_reaches_the_planner_and_every_file_is_written(
    planned: Planned, asked: dict[str, Any], weights: str, capsys: pytest.CaptureFixture[str]
) -> None:
    palm = ["--direction", "0", "0", "-1", "--max-tilt", "0.6", "--pregrasp-clearance", "0.012"]
    places = ["--contact-region", "0.5", "0.1", "0.2", "0.03", "--keep-out", "0", "0", "1", "0.1", "0", "0", "2", "0.2"]
    numbers = ["--num", "9", "--top", "2", "--rehearsals", "4", "--planner-seconds", "2.5", "--seed", "7", "--weights", weights,
               "--least-confidence", "0.35"]
    files = ["--output", "plan.npz", "--trajectory", "plan.yaml", "--csv", "plan.csv"]
    where = ["--at", "0.5", "0.1", "--obstacles", "cube", "--start", "0.1", "-0.2", "3"]
    assert planned(*where, *palm, *places, *numbers, *files, "--json") == 0
    hold, spare = ((0.5, 0.1, 0.2, 0.03),), ((0, 0, 1, 0.1), (0, 0, 2, 0.2))
    constraints = dro.Constraints((0, 0, -1), None, 0.6, None, hold, spare, 0.012)
    assert asked["config"] == dro.PlanConfig(
        9, 2, constraints=constraints, rehearsals=4, planner_seconds=2.5, least_confidence=0.35)
    assert (asked["seed"], asked["predictor"].weights_name) == (7, dro.load_weights(weights).name)
    assert (asked["start"], asked["place"]) == ((0.1, -0.2, 3.0), None)
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
    planned: Planned, asked: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    T = [[0, -1, 0, 0.4], [1, 0, 0, 0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]]
    Path("pose.json").write_text(json.dumps({"frame": "world", "T_frame_object": T}))
    assert planned("--pose", "pose.json", "--csv", "plan.csv") == 0
    np.testing.assert_allclose(asked["T"], T, atol=1e-7)
    said, aside = capsys.readouterr()
    assert "floats" not in aside
    assert "1 given to the planner" in said
    assert "motion of 5.0 s" in said
    assert said.endswith("csv: plan.csv\n")
    assert asked["config"] == dro.PlanConfig()
    assert asked["start"] is None


def test_efforts_that_are_unknown_are_told(planned: Planned, capsys: pytest.CaptureFixture[str]) -> None:
    assert planned("--at", "0.5", "0.1", "--trajectory", "plan.yaml", "--efforts") == 0
    assert "warning: the efforts of the grasp are unknown" in capsys.readouterr().err


@pytest.mark.parametrize(("options", "place"), [
    (["--place", "0.4", "-0.2", "0", "1.5"], (0.4, -0.2, 0.0, 1.5)), (["--place-on", "table"], "table")])
def test_a_place_reaches_the_planner(options: list[str], place: object, planned: Planned, asked: dict[str, Any]) -> None:
    assert planned(*options) == 0
    assert asked["place"] == place


def test_an_object_in_the_air_is_planned_for_and_people_are_told(
    planned: Planned, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("pose.json").write_text(json.dumps({"frame": "world", "T_frame_object": [
        [1, 0, 0, 0.4], [0, 1, 0, 0.2], [0, 0, 1, 0.8], [0, 0, 0, 1]]}))
    assert planned("--pose", "pose.json") == 0
    assert "can floats 0.7" in capsys.readouterr().err


@pytest.mark.parametrize(("options", "said"), [
    (["--seed", "-1"], "seed is -1; give an integer from 0"),
    (["--max-tilt", "0.5"], "give both, for example direction=(0, 0, -1)"),
    (["--output", "nowhere/plan.npz"], "create it first"),
    (["--at", "nan", "0.1"], "--at is nan 0.1; give x and y in metres"),
    (["--at", "0.5", "inf"], "--at is 0.5 inf; give x and y in metres"),
    (["--nearest"], "--nearest concerns a scene"),
    (["--scene", "depth.png"], "both are given"),
    (["--at", "0.5", "0.1", "0"], "--at is 0.5 0.1 0; give x and y in metres"),
    (["--planner-seconds", "nan"], "planner_seconds is nan; give a number above 0"),
    (["--planner-seconds", "inf"], "planner_seconds is inf; give a number above 0"),
    (["--least-confidence", "1"], "least_confidence is 1.0; give a probability from 0"),
    (["--least-confidence", "nan"], "least_confidence is nan"),
    (["--mass", "-1"], "mass is -1.0; give kilograms, above 0"),
    (["--rehearsals", "-1"], "rehearsals is -1; give 0 or a number above it"),
    (["--trajectory", "a.yaml", "--stages", "./a.yaml"], "named twice"),
    (["--efforts"], "--efforts are written into the trajectory file; name one with --trajectory YAML"),
    (["--place", "0.5", "0.1"], "give X Y Z of the object's foot in metres"),
    (["--place", "0.5", "0.1", "0", "--place-on", "table"], "--place and --place-on both say where to put the object"),
    (["--camera", "robot"], "has no camera; state it in the robot file, or give --camera JSON"),
])
def test_what_cannot_be_planned_is_refused_before_the_work(
    options: list[str], said: str, planned: Planned, asked: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.raises(dro.DroGraspError, match=re.escape(said)):
        planned(*options)
    assert not asked
    assert not list(tmp_path.iterdir())
