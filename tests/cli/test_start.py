"""What commands load before they work: each module here took a noticeable part of the time from shell to file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

RUN = """
import sys
from dro_grasp.cli.main import main
try:
    code = main(sys.argv[2:])
except SystemExit as end:
    code = end.code
print(code, sorted(set(sys.argv[1].split(",")) & set(sys.modules)))
"""
"""A command in a process of its own, which then prints its exit code and what it should not have loaded."""
OPTIMISERS = ["scipy.optimize", "scipy.interpolate", "scipy.stats", "scipy.signal"]
PAGES = ["viser", "fastapi", "uvicorn", "pydantic", "matplotlib", "IPython", "sympy"]
UNUSED = [*OPTIMISERS, *PAGES, "pandas", "torch._dynamo", "torch._inductor", "ray", "warp", "coacd",
          "dro_grasp.objects.perception.completion", "dro_grasp.pictures.sheets", "dro_grasp.compare.methods"]
"""What neither a grasp nor a trial takes."""
HEAVY = [*UNUSED, "torch", "numpy", "scipy", "mujoco", "trimesh", "pyarrow", "jaxtyping"]
"""What no list of names takes."""


def loaded(unwanted: list[str], *arguments: str) -> str:
    """The exit code of a command, and what it loaded that is unwanted."""
    alone = {name: value for name, value in os.environ.items() if name != "DRO_GRASP_SERVER"}
    command = [sys.executable, "-c", RUN, ",".join(unwanted), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=alone)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize("words", [["--help"], ["generate", "--help"], ["hands"], ["hands", "--json"]], ids=" ".join)
def test_help_and_names_of_hands_load_nothing_heavy(words: list[str]) -> None:
    assert loaded(HEAVY, *words) == "0 []"


def test_a_hand_is_checked_without_what_only_grasps_take() -> None:
    assert loaded([*UNUSED, "pyarrow"], "hand", "check", "gripper3") == "0 []"


def test_grasps_are_made_tried_and_saved_without_what_they_do_not_take(weights: str, tmp_path: Path) -> None:
    """pandas is loaded by PyArrow where it is installed, SciPy's optimisers by trimesh, unless one sees to it."""
    file = tmp_path / "grasps.parquet"
    made = ["generate", "--hand", "gripper3", "--object", "mug", "--num", "1", "--candidates", "1", "--source", "network",
            "--weights", weights, "--least-confidence", "0", "--output", str(file)]
    assert loaded(UNUSED, *made) == "0 []"
    assert file.exists()
    assert loaded([name for name in UNUSED if name != "pandas"], "evaluate", str(file)) == "0 []"
