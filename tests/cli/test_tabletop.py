"""`tabletop`: what it hands to attempts, prints and stores, with attempts that end at once; these are tested on their own."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import dro_grasp as dro
from dro_grasp import extras
from dro_grasp.arm.tabletop import animation
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.experiment import TabletopConfig
from dro_grasp.cli.main import parse

Lift = Callable[..., int]


@pytest.fixture
def done() -> list[Attempt]:
    """The attempts that were made."""
    return []


@pytest.fixture
def lifted(done: list[Attempt], small_robot: str, weights: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Lift:
    """The command in an empty folder, with attempts of which those with a can hold; of anything else, the first one falls."""
    monkeypatch.chdir(tmp_path)

    def attempt(
        robot: Any, obj: Any, number: int, seed: int, predictor: dro.GraspPredictor, config: TabletopConfig, _: object
    ) -> Attempt:
        assert predictor.weights_name == dro.load_weights(weights).name
        held = obj.name == "can" or number > 0
        done.append(Attempt(robot.name, obj.name, number, seed, config.label(), held, "done" if held else "lift",
                            "" if held else "it fell", processor_seconds=1.0 + number))
        return done[-1]

    def lifted(*options: str) -> int:
        common = ["--robot", small_robot, "--objects", "can", "cube", "--attempts", "2", "--weights", weights]
        return parse(["tabletop", *common, *options]).run(attempt)

    return lifted


def test_every_option_reaches_the_attempts_and_the_counts_are_printed(
    lifted: Lift, done: list[Attempt], small_robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lifted("--see", "mesh", "--order", "random", "--direction", "0", "0", "-1", "--max-tilt", "0.6",
                  "--pregrasp-clearance", "0.012",
                  "--num", "9", "--rehearsals", "4", "--clutter", "2", "--segment", "mask", "--noise", "0.003", "--seed", "5",
                  "--mass", "0.25",
                  "--json") == 0
    constraints = dro.Constraints((0, 0, -1), max_tilt=0.6, pregrasp_clearance=0.012)
    config = TabletopConfig("mesh", 0.003, clutter=2, segment="mask", mass=0.25, plan=dro.PlanConfig(
        9, order="random", rehearsals=4, constraints=constraints))
    assert [TabletopConfig.from_label(a.settings) for a in done] == [config] * 4
    assert {(a.robot, a.seed) for a in done} == {(dro.load_robot(small_robot).name, 5)}
    assert [(a.object, a.number) for a in done] == [("can", 0), ("can", 1), ("cube", 0), ("cube", 1)]
    told = json.loads(capsys.readouterr().out)
    assert (told["attempts"], told["success"], told["success_rate"]) == (4, 3, 0.75)
    assert told["interval"] == pytest.approx([0.3006, 0.9544], abs=1e-4), "Wilson's, from a table"
    assert (told["ended"], told["failures"]) == ({"done": 3, "lift": 1}, ["cube, attempt 0, lift: it fell"])
    assert told["processor_seconds"] == pytest.approx({"median": 1.5, "within_95": 2.0, "n": 4})


def test_people_see_objects_rates_and_every_attempt_aside(
    lifted: Lift, done: list[Attempt], capsys: pytest.CaptureFixture[str]
) -> None:
    assert lifted("--output", "results.parquet") == 0
    assert {a.settings for a in done} == {TabletopConfig().label()}
    said = capsys.readouterr()
    assert said.err.splitlines() == ["can, attempt 0: held", "can, attempt 1: held", "cube, attempt 0: lift: it fell",
                                     "cube, attempt 1: held"]
    assert "1 of 2" in next(line for line in said.out.splitlines() if "cube" in line)
    assert "3 of 4 attempts succeeded (75%, 95 % interval 30% to 95%)" in said.out
    assert said.out.endswith("attempts: results.parquet\n")
    assert lifted("--output", "results.parquet") == 0
    assert len(done) == 4, "they are not repeated"
    assert capsys.readouterr().err == ""
    assert lifted("--output", "results.parquet", "--plans", "plans") == 0
    assert capsys.readouterr().err == "4 of 4 attempts are in --output already, and --plans gets none of them\n"


def test_those_that_are_placed_are_counted_among_those_that_are_lifted(
    small_robot: str, weights: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def attempt(robot: Any, obj: Any, number: int, seed: int, *others: Any) -> Attempt:
        made = Attempt(robot.name, obj.name, number, seed, others[1].label(), processor_seconds=1.0)
        return [replace(made, stage="lift", reason="it fell"), replace(made, stage="carry", reason="it slipped"),
                replace(made, stage="place", reason="placed 3.1 cm off", place_error=0.031, place_tilt=4.0),
                replace(made, stage="done", success=True, place_error=0.005, place_tilt=2.0)][number]

    common = ["tabletop", "--robot", small_robot, "--objects", "can", "--attempts", "4", "--weights", weights, "--place"]
    output = ["--output", str(tmp_path / "results.parquet")]
    assert parse([*common, *output]).run(attempt) == 0
    said = capsys.readouterr()
    assert "1 of 3 that were lifted are placed (33%, 95 % interval 6% to 79%); median 18 mm and 3 degrees off" in said.out
    assert "can, attempt 3: placed" in said.err
    assert parse([*common, *output, "--json"]).run(attempt) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["lifted"], told["placing_errors"]) == (3, {"error": pytest.approx(0.018), "tilt": 3.0, "n": 2})


@pytest.mark.parametrize(("options", "said"), [
    (["--seed", "-1"], "seed is -1; give an integer from 0 to 2^31 - 1"),
    (["--noise", "-0.001"], "noise is -0.001; give a standard deviation in metres from 0 on"),
    (["--noise", "nan"], "noise is nan"),
    (["--clutter", "-1"], "clutter is -1"), (["--workers", "-3"], "workers is -3; give at least 1"),
    (["--mass", "0"], "mass is 0.0; give kilograms, above 0"),
    (["--mass", "250"], "250 g are 0.25 kg"),
    (["--plans", "mine"], "mine is a file; give a folder"),
    (["--output", "nowhere/results.parquet"], "create it first"),
    (["--direction", "0", "0", "-1", "--directions", "paper"], "leave out one of them"),
])
def test_what_cannot_be_attempted_is_refused_in_words(
    options: list[str], said: str, lifted: Lift, done: list[Attempt]
) -> None:
    Path("mine").write_text("mine")
    with pytest.raises(dro.DroGraspError, match=re.escape(said)):
        lifted(*options)
    assert not done


def test_without_the_extra_it_says_what_to_install(
    lifted: Lift, done: list[Attempt], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(dro.DroGraspError, match=re.escape("pip install '.[arm]' in the folder of the clone")):
        lifted()
    assert not done


def test_the_first_attempt_that_moved_is_drawn_and_none_is_no_error(
    lifted: Lift, done: list[Attempt], small_robot: str, weights: str, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = list[tuple[str, int]]()
    monkeypatch.setattr(animation, "draw_attempt", lambda run, chosen, path: drawn.append((chosen.object_file, chosen.number)))
    stage = {("can", 0): "plan", ("can", 1): "see", ("cube", 0): "lift", ("cube", 1): "done"}

    def attempt(robot: Any, obj: Any, number: int, seed: int, *others: Any) -> Attempt:
        return Attempt(robot.name, obj.name, number, seed, others[1].label(), stage=stage[obj.name, number])

    common = ["tabletop", "--robot", small_robot, "--objects", "can", "cube", "--attempts", "2", "--weights", weights]
    assert parse([*common, "--video", "film.webp"]).run(attempt) == 0
    assert drawn == [("cube", 0)]
    stage |= {("cube", 0): "see", ("cube", 1): "plan"}
    assert parse([*common, "--video", "film.webp"]).run(attempt) == 0
    assert "no robot moved in any attempt, so film.webp is not drawn" in capsys.readouterr().err
    assert len(drawn) == 1
