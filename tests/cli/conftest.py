"""Untrained weights, and `generate` with them; a robot that loads quickly."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from dro_grasp.cli.main import main
from dro_grasp.planning.robot_file import BUILTIN_ROBOTS
from tests.helpers.weights import untrained_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(untrained_weights(tmp_path_factory.mktemp("weights")))


@pytest.fixture
def generate(weights: str, capsys: pytest.CaptureFixture[str]):
    def run(
        *arguments: str, num: int = 3, name: str = "sphere", method: str = "network", candidates: int = 1
    ) -> dict:
        base = ["generate", "--hand", "gripper3", "--object", name, "--weights", weights, "--num", str(num), "--json",
                "--method", method, "--candidates", str(candidates)]
        assert main([*base, *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    return run


@pytest.fixture(scope="session")
def small_robot(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of the built-in xArm 7 with a small hand, and without a camera."""
    values = yaml.safe_load((BUILTIN_ROBOTS / "xarm7_leaphand.yaml").read_text())
    values |= {"arm": str(BUILTIN_ROBOTS / "xarm7.urdf"), "hand": "gripper3"}
    del values["camera"]
    path: Path = tmp_path_factory.mktemp("robot") / "small.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)
