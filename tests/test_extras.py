"""What the core does without the packages of its extras, and what the other commands say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from dro_grasp import extras
from dro_grasp.cli.main import main
from tests.helpers.weights import untrained_weights

CORE = """
import json, sys

for name in ("viser", "websockets", "fastapi", "uvicorn", "pydantic", "starlette", "cachetools"):
    sys.modules[name] = None
from dro_grasp.cli.main import main

print("codes", [main(arguments) for arguments in json.loads(sys.argv[1])])
import dro_grasp
try:
    dro_grasp.view_grasps
except dro_grasp.DroGraspError as error:
    print(error)
"""
"""Commands with the packages of the extra `apps` out of reach."""


def test_the_core_needs_no_extra_and_the_pages_say_what_to_install(tmp_path: Path) -> None:
    grasps, weights = str(tmp_path / "grasps.parquet"), str(untrained_weights(tmp_path))
    commands = [
        ["generate", "--hand", "gripper3", "--object", "sphere", "--num", "2", "--source", "network", "--weights", weights,
         "--output", grasps, "--json"],
        ["evaluate", grasps, "--json"], ["export", grasps, "--format", "csv", "--output", str(tmp_path / "grasps.csv")],
        ["picture", grasps, "--output", str(tmp_path / "sheet.png"), "--size", "40", "40"],
        ["view", grasps], ["view"], ["serve"]]
    done = subprocess.run([sys.executable, "-c", CORE, json.dumps(commands)], capture_output=True, text=True, check=False)
    assert "codes [0, 0, 0, 0, 2, 2, 2]\n" in done.stdout, done.stderr
    assert done.stderr.count("viser, fastapi, uvicorn, cachetools; run pip install 'dro-grasp[apps]'") == 3
    assert "run pip install 'dro-grasp[apps]'" in done.stdout, "in Python too"
    assert (tmp_path / "grasps.csv").exists()
    assert (tmp_path / "sheet.png").exists()


@pytest.mark.parametrize(("command", "missing"), [
    *(("serve", name) for name in extras.EXTRAS["apps"]), ("view", "viser"), ("plan", "ompl"), ("tabletop", "mink")])
def test_a_command_without_its_extra_says_what_to_install(
    command: str, missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == missing else object())
    options = {"plan": ["--robot", "nowhere", "--object", "can"], "tabletop": ["--robot", "nowhere", "--objects", "can"]}
    assert main([command, *options.get(command, [])]) == 2
    (extra,) = (name for name, packages in extras.EXTRAS.items() if missing in packages)
    said = capsys.readouterr().err
    assert f"not installed: {missing}; run pip install 'dro-grasp[{extra}]'" in said
    assert said.count("\n") == 1


def test_timing_loads_no_library_of_drawings_until_it_is_used() -> None:
    code = ("import sys, numpy as np; from dro_grasp.arm.planning.trajectory import smooth;"
            "smooth(np.eye(2), *np.ones((2, 2)));"
            "assert not any(name.startswith('matplotlib') for name in sys.modules);"
            "from toppra.algorithm import algorithm; figure = algorithm.plt.figure;"
            "import matplotlib.pyplot; assert matplotlib.pyplot.figure is figure")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
