"""The wheel: built, installed elsewhere, and run far from the repository."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import dro_grasp

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_a_missing_wheel_fails_the_check_and_is_named(tmp_path: Path) -> None:
    environment = os.environ | {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path), "PIP_CONFIG_FILE": os.devnull}
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "check_wheels.py"), "3.13"], env=environment, capture_output=True, text=True,
        timeout=120)
    assert done.returncode == 1
    assert "Python 3.13" in done.stderr
    assert "torch" in done.stderr


def test_the_version_is_the_same_wherever_it_is_stated() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest, date = re.search(r"^## (\S+) \((\S+)\)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE).groups()
    assert {project["version"], citation["version"], newest} == {dro_grasp.__version__}
    assert str(citation["date-released"]) == date


@pytest.mark.slow
def test_the_wheel_holds_all_that_grasping_needs(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", str(ROOT), "--no-deps", "--wheel-dir", str(tmp_path)], check=True, timeout=300)
    (wheel,) = tmp_path.glob("dro_grasp-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    kinds = ("weights/**/*.safetensors", "weights/SHA256SUMS", "hands/builtin/*", "arm/robots/builtin/*", "py.typed")
    shipped = {str(p.relative_to(ROOT / "src")) for kind in kinds for p in (ROOT / "src" / "dro_grasp").glob(kind)}
    assert len(shipped) > 8
    assert shipped <= names
    assert wheel.stat().st_size < 6e6
    assert not any(name.startswith(("tests/", "lab/", "data/")) for name in names)
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True, timeout=300)
    away = tmp_path / "away"
    away.mkdir()
    code = "import sys, dro_grasp.cli.main as m; print(m.__file__, file=sys.stderr); sys.exit(m.main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "generate", "--hand", "gripper3", "--object", "can", "--num", "2", "--json"],
        cwd=away, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert str(site) in done.stderr
    assert json.loads(done.stdout)["num"] == 2
