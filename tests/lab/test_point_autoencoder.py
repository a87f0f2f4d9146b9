"""What two networks share: layers against loops over points, the divergence against PyTorch's, training of a tiny one."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from dro_grasp.errors import BundleError, TrainingError
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.runs import RunFolder
from lab.methods.bundle_draws import BundleDraws
from lab.methods.point_autoencoder import AutoencoderConfig, divergence, each, layer, train_autoencoder

SCHEDULE = ScheduleConfig(steps=40, learning_rate=0.03, warmup_steps=1, recalibration=3, log_every=10, average_decay=0.9)
CONFIG = AutoencoderConfig(SCHEDULE, points=16, hand_points=12)


class Spans(nn.Module):
    """Tells from each point of an object how far the hand's nearest point is."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(*layer(3, 16), nn.Linear(16, 1))


def naive_spans(points: Tensor, body: Tensor) -> Tensor:
    """Distance of each point of an object to the nearest of a hand, one after the other [m]."""
    return torch.tensor([[min(math.dist(p, h) for h in hand) for p in cloud]
                         for cloud, hand in zip(points.tolist(), body.tolist(), strict=True)])


def passed(model: Spans, draws: BundleDraws, config: AutoencoderConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    drawn = draws.draw(4, config.points, generator)
    return each(model.layers, drawn.points / 0.03)[..., 0], naive_spans(drawn.points, drawn.body) / 0.03


def losses(found: tuple[Tensor, Tensor], _: AutoencoderConfig, progress: float) -> dict[str, Tensor]:
    assert 0 <= progress < 1
    return {"total": (found[0] - found[1]).square().mean()}


def trained(bundle: Bundle, folder: Path, told: list[float], config: AutoencoderConfig = CONFIG, what=losses) -> Spans:
    return train_autoencoder(Spans, bundle, config, folder, passed, what, lambda _, means: told.append(means["total"]))


def test_every_point_is_treated_alike_and_batchnorm_counts_all_of_them() -> None:
    torch.manual_seed(0)
    layers, values = nn.Sequential(*layer(3, 5), nn.Linear(5, 2)), torch.randn(2, 7, 3)
    linear, norm, _, last = layers
    hidden = values.reshape(-1, 3) @ linear.weight.T + linear.bias
    standard = (hidden - hidden.mean(0)) / (hidden.var(0, unbiased=False) + norm.eps).sqrt()
    torch.testing.assert_close(each(layers, values).reshape(-1, 2), standard.clamp_min(0) @ last.weight.T + last.bias)
    layers.eval()
    alone = torch.stack([torch.stack([layers(point[None])[0] for point in cloud]) for cloud in values])
    order = torch.randperm(7)
    torch.testing.assert_close(each(layers, values[:, order]), alone[:, order])


def test_the_divergence_is_that_of_pytorch() -> None:
    mean, log_variance = torch.randn(2, 6, 4, generator=torch.Generator().manual_seed(0))
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(mean, (log_variance / 2).exp()), normal(0.0, 1.0)).sum(-1).mean()
    torch.testing.assert_close(divergence(mean, log_variance), expected)
    assert float(divergence(torch.zeros(3, 4), torch.zeros(3, 4))) == 0


def test_the_loss_falls_and_the_averaged_weights_are_returned_with_statistics_of_their_own(bundle, tmp_path: Path) -> None:
    told: list[float] = []
    model = trained(bundle, tmp_path / "run", told)
    assert len(told) == 4
    assert told[-1] < 0.6 * told[0]
    assert not model.training
    kept = RunFolder(tmp_path / "run").read_checkpoint({})
    assert kept is not None
    for name, value in model.named_parameters():
        assert torch.equal(value, kept["average"][f"module.{name}"])
        assert name.endswith("weight") is False or not torch.equal(value, kept["model"][name]), "the average is another"
    # Statistics: the mean of those of three batches, drawn as after the last step.
    norm, generator = model.layers[1], torch.Generator()
    generator.manual_seed((SCHEDULE.seed * 1_000_003 + SCHEDULE.steps) * 1_009)
    draws, linear = BundleDraws(bundle, CONFIG.hand_points), model.layers[0]
    batches = [linear(draws.draw(4, CONFIG.points, generator).points.reshape(-1, 3) / 0.03) for _ in range(3)]
    torch.testing.assert_close(norm.running_mean, torch.stack([b.mean(0) for b in batches]).mean(0))
    torch.testing.assert_close(norm.running_var, torch.stack([b.var(0) for b in batches]).mean(0))
    again = trained(bundle, tmp_path / "again", [])
    assert all(torch.equal(a, b) for a, b in zip(model.state_dict().values(), again.state_dict().values(), strict=True))


def test_an_empty_bundle_and_a_loss_that_is_no_number_are_refused(bundle, tmp_path: Path) -> None:
    empty = dataclasses.replace(bundle, grasps={})
    with pytest.raises(BundleError, match="synthesize some first"):
        trained(empty, tmp_path / "empty", [])
    assert not (tmp_path / "empty").exists()
    short = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, steps=1))
    with pytest.raises(TrainingError, match="total is not finite at step 0"):
        trained(bundle, tmp_path / "nan", [], short, lambda found, *_: {"total": found[0].mean() * math.nan})
