"""Distance errors against networks whose errors are known, and ranks of matches with encoders whose features are known."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from dro_grasp.cli.main import main
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.network.network import DistanceNetwork, NetworkOutput
from dro_grasp.network.presets import PRESETS
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.measures import distance_errors, matching_rank, mean_rank
from dro_grasp.training.samples import SampleSource
from tests.helpers.tiny_bundle import TINY


class Off(DistanceNetwork):
    """Predicts true distances, a few millimetres off; its posterior is two standard deviations off the prior."""

    def forward(
        self, hand: Tensor, obj: Tensor, grasp: Tensor, generator: torch.Generator, columns: int | None = None
    ) -> NetworkOutput:
        self.true = torch.cdist(grasp, obj, compute_mode="donot_use_mm_for_euclid_dist")
        zero = torch.zeros(len(obj), TINY.latent)
        mean = zero.clone()
        mean[:, 0] = 2.0
        return NetworkOutput(self.true + 0.004, mean, zero, zero[:, 0], hand)

    def predict(self, hand: Tensor, obj: Tensor, noise: Tensor) -> Tensor:
        assert noise.shape == (len(obj), TINY.latent)
        return self.true - 0.009


def test_errors_are_those_of_the_network(bundle: Bundle) -> None:
    (found,) = distance_errors(Off(TINY), bundle, samples=70)
    assert found.hand == "toy"
    assert found.posterior == pytest.approx(0.004, abs=1e-6)
    assert found.prior == pytest.approx(0.009, abs=1e-6)
    assert found.divergence == pytest.approx(2.0), "half of the squared mean"


@pytest.mark.usefixtures("quick_statistics")
@pytest.mark.slow
def test_training_reports_them_of_grasps_it_has_not_seen(
    bundle: Bundle, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(home / "bundle.safetensors")
    monkeypatch.setitem(PRESETS, "slim", TINY)
    command = ["train", "--bundle", path, "--run-folder", str(tmp_path / "run"), "--output", str(tmp_path / "w.safetensors"),
               "--steps", "2", "--validation", path]
    assert main([*command, "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out.splitlines()[-1])["distance_errors"]
    (measured,) = distance_errors(load_weights(tmp_path / "w.safetensors"), bundle)
    assert told == pytest.approx(vars(measured))
    assert main(command) == 0
    assert f"{1e3 * measured.posterior:.4g}" in capsys.readouterr().out


class Known(StaticGraphEncoder):
    """Features that do not look at the points: one of each point alone, or noise that no two clouds share."""

    def __init__(self, noise: bool) -> None:
        nn.Module.__init__(self)
        self.noise = noise

    def forward(self, points: Tensor) -> Tensor:
        b, n = points.shape[:2]
        return torch.randn(b, n, 64) if self.noise else torch.eye(n).expand(b, n, n)


def test_ranks_are_one_for_known_points_and_half_for_unknown_ones(bundle: Bundle) -> None:
    source, seed = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(0)
    assert matching_rank(Known(False), source, seed, 4) == {"toy": 1.0}
    torch.manual_seed(0)
    rank = matching_rank(Known(True), source, seed, 16)["toy"]
    assert abs(rank - (TINY.n_hand + 1) / 2) < 3
    others = torch.arange(TINY.n_hand).roll(1)
    assert mean_rank(Known(False), source, ("toy", "toy"), others, seed, 4) == 2.0, "one point is more similar"
