"""The layers of the package, and that training needs no simulator."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BARE = ("dro_grasp.training.loop", "dro_grasp.training.pretraining", "dro_grasp.training.data.bundle.training_file",
        "dro_grasp.network.checkpoints", "dro_grasp.hands.hand")
FORBIDDEN = ("mujoco", "trimesh", "viser", "igl", "coacd", "matplotlib", "PIL", "rich", "tyro")


@pytest.mark.slow
def test_imports_point_downwards_only() -> None:
    tool = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run([tool, "--no-logo", "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_training_runs_where_there_is_no_simulator_and_starts_without_the_compiler() -> None:
    blocked = "".join(f"sys.modules[{name!r}] = None; " for name in FORBIDDEN)
    check = "assert 'torch._dynamo' not in sys.modules, 'it takes longer to import than all the rest'"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {blocked}import {', '.join(BARE)}; {check}"],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT / "src")})
    assert done.returncode == 0, done.stderr


def test_only_their_layers_import_mujoco_and_viser() -> None:
    source = ROOT / "src" / "dro_grasp"
    for name, allowed in (("mujoco", {"simulation", "hands", "arm"}), ("viser", {"apps"}), ("mink", {"arm"}),
                          ("ompl", {"arm"}), ("toppra", {"arm"}), ("fastapi", {"apps"}), ("pydantic", {"apps"})):
        users = {
            f.relative_to(source).parts[0]
            for f in source.rglob("*.py")
            if any(line.split()[:2] in (["import", name], ["from", name]) for line in f.read_text().splitlines())
        }
        assert users <= allowed, name
