"""Network and training on a device that is not the CPU: nothing is left behind, and the numbers are those of the CPU."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from dro_grasp.network.network import untrained_network
from dro_grasp.network.placement import PROPORTIONS
from dro_grasp.training.config import MotionConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.loop import train
from dro_grasp.training.pretraining import pretrain_motion
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, STAGES, curve, quiet, run_stage

PAPER = dataclasses.replace(TINY, frame="object")
SHORT = dataclasses.replace(SCHEDULE, steps=2, log_every=1, recalibration=2)


@pytest.mark.parametrize("network", [TINY, PAPER], ids=["ours", "paper"])
@torch.no_grad()
def test_a_network_predicts_where_it_is_with_random_numbers_of_the_cpu(network, device: str) -> None:
    def predicted(where: str) -> list[torch.Tensor]:
        model, generator = untrained_network(network, seed=0).to(where).eval(), torch.Generator().manual_seed(1)
        hand, obj = (torch.randn(3, n, 3, generator=generator).to(where) * 0.05 for n in (TINY.n_hand, TINY.n_object))
        axes = network.axes(torch.eye(3).to(where)).expand(6, 3, 3)
        distances = model.predict(hand, obj, model.sample_latent(3, generator))
        found = [distances, *model.sample_placements(obj[0], axes, 4, generator, torch.zeros(PROPORTIONS, device=where))]
        assert {value.device.type for value in found} == {torch.device(where).type}
        return [value.cpu() for value in found]

    for ours, theirs in zip(predicted(device), predicted("cpu"), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_descends_on_a_device(stage: str, device: str, bundle: Bundle, tmp_path: Path) -> None:
    there = run_stage(stage, bundle, tmp_path / "there", dataclasses.replace(SHORT, device=device))
    assert {value.device.type for value in there.state_dict().values()} == {"cpu"}
    run_stage(stage, bundle, tmp_path / "here", SHORT)
    assert [line["step"] for line in curve(tmp_path / "there")] == [1, 2]
    assert all(math.isfinite(value) for line in curve(tmp_path / "there") for value in line.values())
    if device != "cuda":  # whose random numbers are its own
        assert curve(tmp_path / "there") == [pytest.approx(line, rel=1e-4) for line in curve(tmp_path / "here")]


def test_a_motion_and_fine_tuning_descend_on_a_device(device: str, bundle: Bundle, tmp_path: Path) -> None:
    schedule = dataclasses.replace(SHORT, device=device)
    moving = pretrain_motion(
        untrained_network(TINY, seed=0), bundle, MotionConfig(schedule, hands_per_step=1), tmp_path / "motion", quiet)
    config = TrainConfig(schedule, hands_per_step=1, columns=24)
    tuned = train(bundle, TINY, config, tmp_path / "run", report=quiet, initial=moving)
    assert {value.device.type for value in [*moving.state_dict().values(), *tuned.state_dict().values()]} == {"cpu"}
    assert all(torch.isfinite(value).all() for value in tuned.state_dict().values())
