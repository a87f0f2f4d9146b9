"""Messages name arguments as Python has them; the command line alone says what is typed."""

from __future__ import annotations

import ast
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import dro_grasp as dro
from dro_grasp.cli import output
from dro_grasp.cli.evaluate import Evaluate
from dro_grasp.cli.generate import Generate
from dro_grasp.cli.inputs import load_obstacle
from dro_grasp.cli.main import main
from dro_grasp.cli.robots import Plan, Tabletop
from dro_grasp.cli.switches import in_switches, use_options_of
from dro_grasp.cli.view import View
from dro_grasp.errors import UngraspableError
from dro_grasp.objects.perception.things import AS_SCENE
from dro_grasp.predict.sources.registry import make_source
from dro_grasp.simulation.outcome import MORE
from dro_grasp.simulation.scene import require_simulable

SOURCE = Path(__file__).parents[2] / "src" / "dro_grasp"
SWITCH = re.compile(r"(?<![\w-])--[a-z]")
COMMAND = re.compile(r"`[^`]*`|<i>.*|^--[a-z-]+( [a-z.]+)?$|^ --output .*|^dro-grasp .*")
"""What is typed as it stands: a command in backticks, or a word of one."""


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Strings of a module with their lines; docstrings are none."""
    tree = ast.parse(path.read_text())
    plain = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield node.lineno, "".join(str(part.value) if isinstance(part, ast.Constant) else "0" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in plain | inner:
            yield node.lineno, node.value


def test_no_message_outside_the_command_line_speaks_of_switches() -> None:
    found = [f"{path.relative_to(SOURCE)}:{line}: {text}" for path in sorted(SOURCE.rglob("*.py"))
             if path.parent.name != "cli" for line, text in texts(path) if SWITCH.search(COMMAND.sub("", text))]
    assert not found, "\n" + "\n".join(found)


def test_that_test_sees_switches(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text('"""With --docs."""\nA = f"give {3} --num"\nB = "start `dro-grasp serve --hand X`"\n')
    seen = [line for line, text in texts(tmp_path / "a.py") if SWITCH.search(COMMAND.sub("", text))]
    assert seen == [2]


@pytest.mark.parametrize(("told", "typed"), [
    ("num is 0; ask for one (num=16)", "num is 0; ask for one (--num 16)"),
    ("give direction=(0, 0, -1), max_tilt=0.5.", "give --direction 0 0 -1, --max-tilt 0.5."),
    ("use device='cpu', or others", "use --device cpu, or others"),
    ("it is 60 m; give scale=0.001 for millimetres", "it is 60 m; give --scale 0.001 for millimetres"),
    ("more grasps (num=...), or a place (at=(X, Y, Z))", "more grasps (--num), or a place (--at X Y Z)"),
    ("ask for that too (resettle=True)", "ask for that too (--resettle)"),
    ("choose split='train or validate'", "choose --split train or validate"),
    ("no object is called 'a/num=3'", "no object is called 'a/num=3'"),
    ("carry+friction=3/1 and weight=2", "carry+friction=3/1 and weight=2"), ("`num=3`", "`num=3`"),
])
def test_arguments_become_switches(told: str, typed: str) -> None:
    assert in_switches(told) == typed


def test_python_and_command_line_are_each_told_in_their_words(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(dro.DroGraspError, match=r"\(num=16\)"):
        dro.GraspRequest(num=0)
    assert main(["generate", "--hand", "gripper3", "--object", "can", "--num", "0"]) == 2
    assert "(--num 16)" in capsys.readouterr().err
    output.say("better: scale=0.01")
    assert capsys.readouterr().out == "better: --scale 0.01\n"
    output.say_aside("better: scale=0.01")
    assert capsys.readouterr().err == "better: --scale 0.01\n"


@pytest.mark.parametrize(("told", "generated", "planned"), [
    ("give scale=0.001", "give --scale 0.001", "give a file with all coordinates times 0.001"),
    ("its unit (scale=...)", "its unit (--scale)", "its unit (a file in metres)"),
    ("with keep_table=True", "with --keep-table", "with load_object(..., keep_table=True) in Python"),
    ("direction=..., place=...", "--direction, place=...", "--direction, --place"),
])
def test_a_command_is_told_of_its_own_options_alone(told: str, generated: str, planned: str) -> None:
    try:
        use_options_of(Generate("gripper3"))
        assert in_switches(told) == generated
        use_options_of(Plan("robot"))
        assert in_switches(told) == planned
    finally:
        use_options_of(None)


def test_what_was_typed_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for typed in (["--object", "seed=3.stl"], ["--object=seed=3.stl"]):
        assert main(["generate", "--hand", "gripper3", *typed]) == 2
        assert "no object file at seed=3.stl; " in capsys.readouterr().err
    assert main(["generate", "--hand", "gripper3", "--object", "can", "--num=0"]) == 2
    assert "(--num 16)" in capsys.readouterr().err
    assert in_switches("of seed=3.stl") == "of --seed 3.stl", "of the command that runs alone"


@pytest.mark.parametrize(("told", "evaluated"), [
    (MORE, "propose more candidates for each grasp (`dro-grasp generate --candidates 16`), or take them from the optimiser "
           "(`dro-grasp generate --source optimiser`)"),
])
def test_what_another_command_can_be_told_is_named_with_it(told: str, evaluated: str) -> None:
    try:
        use_options_of(Evaluate(Path("g.parquet")))
        assert in_switches(told) == evaluated
    finally:
        use_options_of(None)


def test_sources_are_told_in_words_that_every_command_has(tmp_path: Path) -> None:
    with pytest.raises(dro.DroGraspError) as told:
        make_source("meen-grasp")
    assert "mean-grasp" not in str(told.value).replace("meen-grasp", ""), "without a bundle, it cannot be chosen"
    hand, can = dro.load_hand("gripper3"), dro.load_object("can")
    dro.GraspBatch.create(hand, can, np.eye(4)[None], hand.canonical_joints()[None]).save(tmp_path / "g.parquet")
    with pytest.raises(dro.DroGraspError, match="holds no grasp of 'mug', but of can; ask for grasps of one of these"):
        make_source(str(tmp_path / "g.parquet")).propose(dro.GraspProblem(hand, dro.load_object("mug")), 1, 0)


CHOICE = "--nearest, --at X Y Z or --pixel U V"


@pytest.mark.parametrize(("command", "words"), [
    (Generate("gripper3"), f"(--scene FILE --camera JSON, and {CHOICE})"),
    (Plan("robot"), f"(--scene FILE --camera JSON, and {CHOICE})"),
    (View(), "(--scene FILE --camera JSON, and a click on the page)"),
    (Evaluate(Path("g.parquet")), f"(`dro-grasp generate --scene FILE --camera JSON` with {CHOICE})"),
    (Tabletop("robot", ("can",)), f"(`dro-grasp generate --scene FILE --camera JSON` with {CHOICE})"),
    (None, f"(--scene FILE --camera JSON, and {CHOICE})"),
])
def test_each_command_is_told_of_scenes_in_one_language(command: Any, words: str) -> None:
    try:
        use_options_of(command)
        told = in_switches(f"a view; {AS_SCENE}.")
    finally:
        use_options_of(None)
    assert told == f"a view; give it as a scene, of which one thing is meant {words}."


def test_what_a_command_lacks_is_named_as_generate_has_it() -> None:
    evaluate = Evaluate(Path("g.parquet"))
    try:
        use_options_of(evaluate)
        assert in_switches("its pose (camera=...)") == "its pose (`dro-grasp generate --camera JSON`)"
        assert in_switches("from above (direction=(0, 0, -1))") == "from above (`dro-grasp generate --direction 0 0 -1`)"
        assert in_switches("without only_successful=True") == "without --only-successful"
        with pytest.raises(dro.DroGraspError, match="a trial needs a mesh") as caught:
            require_simulable(dro.load_hand("gripper3"), dro.load_object(dro.load_object("can").cloud))
        use_options_of(Plan("robot"))
        assert in_switches(str(caught.value)).endswith("a trial needs a mesh (--object); or make no trial")
    finally:
        use_options_of(None)


@pytest.mark.parametrize("command", [
    ["plan", "--object"], ["tabletop", "--objects"], ["clear", "--objects"], ["generate", "--hand", "gripper3", "--object"]])
def test_no_command_is_told_of_a_scale_that_it_lacks(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trimesh.creation.box((60, 50, 100)).export(tmp_path / "mm.stl")
    robot = [] if command[0] == "generate" else ["--robot", "xarm7_leaphand"]
    assert main([command[0], *robot, *command[1:], str(tmp_path / "mm.stl")]) == 2
    told = capsys.readouterr().err
    assert "measures 100 m" in told
    assert ("--scale" in told) == (command[0] == "generate")
    assert ("a file with all coordinates times 0.001 for millimetres" in told) == (command[0] != "generate")
    assert in_switches("scale=2") == "--scale 2", "of all commands, once none runs"


def test_what_is_no_obstacle_is_referred_to_surroundings(tmp_path: Path) -> None:
    trimesh.creation.box((1.2, 1.2, 0.1)).export(tmp_path / "wall.stl")
    with pytest.raises(dro.DroGraspError, match=r"too large\. --obstacles takes.*--surroundings, a mesh or cloud of any size"):
        load_obstacle(str(tmp_path / "wall.stl"))
    np.save(tmp_path / "room.npy", np.random.default_rng(0).uniform(-2, 2, (500, 3)).astype(np.float32))
    with pytest.raises(dro.DroGraspError, match=r"too large\. --obstacles takes") as caught:
        load_obstacle(str(tmp_path / "room.npy"))
    assert "scene" not in str(caught.value)
    np.save(tmp_path / "depth.npy", np.ones((48, 64), np.float32))
    with pytest.raises(dro.DroGraspError, match=r"an array of shape \(48, 64\).*with --surroundings") as caught:
        load_obstacle(str(tmp_path / "depth.npy"))
    assert "scene" not in str(caught.value)
    half = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 1, 2], [0, 3, 1]])
    half.export(tmp_path / "half.stl")
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]], [[0, 1, 2], [2, 1, 3]])
    flat.export(tmp_path / "flat.stl")
    for name, said in (("half", "is an open sheet"), ("flat", "encloses no volume")):
        with pytest.raises(dro.DroGraspError, match=rf"{said}.*clouds and meshes of things.*with --surroundings"):
            load_obstacle(str(tmp_path / f"{name}.stl"))
    (tmp_path / "broken.stl").write_bytes(b"hello")
    np.save(tmp_path / "few.npy", np.eye(3))
    for name in ("nothing_of_that_name", str(tmp_path / "broken.stl"), str(tmp_path / "few.npy")):
        with pytest.raises(dro.DroGraspError) as caught:
            load_obstacle(name)
        assert "--surroundings" not in str(caught.value)
    assert load_obstacle("can").name == "can"


def test_what_is_no_thing_to_grasp_passes_between_processes() -> None:
    error = pickle.loads(pickle.dumps(UngraspableError("it measures 3 m, too large", " for a hand")))
    assert (str(error), error.fault) == ("it measures 3 m, too large for a hand", "it measures 3 m, too large")
