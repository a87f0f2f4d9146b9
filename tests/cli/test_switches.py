"""Messages name arguments as Python has them; the command line alone says what is typed."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import dro_grasp as dro
from dro_grasp.cli import output
from dro_grasp.cli.main import main
from dro_grasp.cli.switches import in_switches

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
