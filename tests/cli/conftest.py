"""`generate` with untrained weights."""

from __future__ import annotations

import json

import pytest

from dro_grasp.cli.main import main


@pytest.fixture
def generate(weights: str, capsys: pytest.CaptureFixture[str]):
    def run(
        *arguments: str, num: int = 3, name: str = "sphere", source: str = "network", candidates: int = 1
    ) -> dict:
        base = ["generate", "--hand", "gripper3", "--object", name, "--weights", weights, "--num", str(num), "--json",
                "--source", source, "--candidates", str(candidates)]
        assert main([*base, *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    return run
