"""Training needs no simulator, no mesh library, no viewer: only what a bare machine with PyTorch has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.tiny_bundle import tiny_bundle

BLOCKED = (
    "PIL", "coacd", "defusedxml", "fast_simplification", "igl", "matplotlib", "mujoco", "pandas", "rich",
    "scipy", "tensorboard", "trimesh", "tyro", "viser",
)
SCRIPT = f'''
import importlib.util, sys
from pathlib import Path

class Without:
    """A finder that does not find the packages."""

    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in {BLOCKED!r} else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
for name in {BLOCKED!r}:
    assert importlib.util.find_spec(name) is None, name

from dro_grasp.training.data.bundle.training_file import load_bundle
from dro_grasp.network.checkpoints import load_weights, save_weights
from dro_grasp.training.config import PretrainConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.loop import train
from dro_grasp.training.pretraining import pretrain
from tests.helpers.tiny_bundle import TINY

folder, schedule = Path(sys.argv[1]), ScheduleConfig(steps=2)
bundle = load_bundle(folder / "bundle.safetensors")
encoder = pretrain(bundle, TINY, PretrainConfig(schedule, hands_per_step=1), folder / "pre")
model = train(bundle, TINY, TrainConfig(schedule, hands_per_step=1, columns=24), folder / "main", encoder)
save_weights(model, folder / "mine.safetensors")
print(load_weights(folder / "mine.safetensors").name, sorted(set(sys.modules) & set({BLOCKED!r})))
'''


@pytest.mark.slow
def test_training_runs_on_a_bare_machine(tmp_path: Path) -> None:
    tiny_bundle(tmp_path / "bundle.safetensors")
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "mine []\n"
