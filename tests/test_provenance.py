"""What files say of where they come from."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dro_grasp import __version__, provenance


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    return subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


def asked(folder: Path) -> str:
    """The commit that a copy of the module states, in a folder of its own."""
    code = (f"import dro_grasp.provenance as p; p.PACKAGE = p.Path({str(folder)!r}); "
            f"p.__file__ = {str(folder / 'a.py')!r}; print(p.commit())")
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def test_the_commit_of_a_clone_and_its_changes(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("a")
    assert asked(tmp_path) == ""
    git(tmp_path, "init", "-q")
    assert asked(tmp_path) == ""
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "-q", "-m", "a")
    head = git(tmp_path, "rev-parse", "HEAD")[:10]
    assert asked(tmp_path) == head
    (tmp_path / "a.py").write_text("b")
    assert asked(tmp_path) == f"{head}+"
    (tmp_path / "b").mkdir()
    shutil.copy(tmp_path / "a.py", tmp_path / "b" / "a.py")
    assert asked(tmp_path / "b") == "", "of a package that was copied into a clone of something else"


def test_without_git_nothing_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert provenance.made_by() | {"command": ""} == {"command": "", "commit": "", "version": __version__}


@pytest.mark.parametrize(("start", "told"), [
    (["-m", "dro_grasp", "weights", "--made by"], "dro-grasp weights '--made by'"),
    (["-m", "lab.recipe.pack", "x"], "python -m lab.recipe.pack x")])
def test_the_command_is_as_a_user_types_it(start: list[str], told: str) -> None:
    code = ("import sys; main = sys.modules['__main__']; from importlib.machinery import ModuleSpec; "
            f"main.__spec__ = ModuleSpec({start[1]!r} + ('.__main__' if {start[1]!r} == 'dro_grasp' else ''), None); "
            f"sys.argv = ['x', *{start[2:]!r}]; from dro_grasp.provenance import this_command; print(this_command())")
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip() == told
