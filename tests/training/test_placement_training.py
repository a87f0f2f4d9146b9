"""The placement prior trained alone: what changes and what stays, what it learns, and the command."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.errors import TrainingError
from dro_grasp.network.checkpoints import describe_weights, load_weights, save_weights
from dro_grasp.network.network import DistanceNetwork, untrained_network
from dro_grasp.training.config import AugmentationConfig, PlacementConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.loop import placement_losses, train_placement
from dro_grasp.training.samples import Batch, SampleSource
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, curve, quiet

SHORT = PlacementConfig(dataclasses.replace(SCHEDULE, steps=150, learning_rate=1e-2, log_every=10), hands_per_step=1)


@pytest.fixture
def given() -> DistanceNetwork:
    return untrained_network(TINY, seed=5)


def test_the_prior_learns_and_all_else_stays(bundle: Bundle, given: DistanceNetwork, tmp_path: Path) -> None:
    learnt = train_placement(bundle, TINY, SHORT, tmp_path / "run", given, quiet)
    lines = curve(tmp_path / "run")
    assert lines[-1]["log_density"] > lines[0]["log_density"] + 1
    assert learnt.config == TINY
    for name, value in given.state_dict().items():
        if not name.startswith("placement."):
            assert torch.equal(learnt.state_dict()[name], value), name
    again = train_placement(bundle, TINY, SHORT, tmp_path / "run", given, quiet)
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), learnt.state_dict().values(), strict=True))


def test_the_likeliest_position_comes_near_the_true_one(bundle: Bundle, given: DistanceNetwork, tmp_path: Path) -> None:
    learnt = train_placement(bundle, TINY, SHORT, tmp_path / "run", given, quiet)
    source = SampleSource(bundle, TINY, AugmentationConfig())
    group = source.draw("toy", 64, torch.Generator().manual_seed(9))
    with torch.no_grad():
        errors = []
        for model in (given, learnt):
            assert model.placement is not None
            logits, mean, _, _ = model.placement(group.obj_hand, group.proportions.expand(64, -1))
            likeliest = mean[torch.arange(64), logits.argmax(-1)]
            errors.append(float((likeliest - group.position).norm(dim=-1).median()))
    assert errors[1] < 0.5 * errors[0]


def test_preferred_is_the_area_under_the_roc_curve(bundle: Bundle, given: DistanceNetwork) -> None:
    from scipy.stats import mannwhitneyu

    source = SampleSource(bundle, TINY, AugmentationConfig())
    group = source.draw("toy", 40, torch.Generator().manual_seed(2))
    prior, hand = given.placement, group.proportions.expand(40, -1)
    assert prior is not None
    with torch.no_grad():
        found = placement_losses(prior, Batch.of([group]), 0.0, torch.Generator())
        true, other = prior(group.obj_hand, hand)[3], prior(group.obj_random, hand)[3]
    expected = mannwhitneyu(true.numpy(), other.numpy()).statistic / 40**2
    assert float(found["preferred"]) == pytest.approx(expected, abs=1e-6)


def test_networks_without_a_placement_prior_are_refused(bundle: Bundle, tmp_path: Path) -> None:
    network = dataclasses.replace(TINY, frame="object")
    with pytest.raises(TrainingError, match="'paper' has no placement prior"):
        train_placement(bundle, network, SHORT, tmp_path / "run", untrained_network(network, 0, "paper"), quiet)
    assert not (tmp_path / "run").exists()


def test_the_command_trains_the_placement_alone(
    home: Path, bundle: Bundle, given: DistanceNetwork, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, output = tmp_path / "first.safetensors", tmp_path / "better.safetensors"
    save_weights(given, first, {"stage": "training"})
    command = ["train", "--part", "placement", "--bundle", str(home / "bundle.safetensors"), "--run-folder",
               str(tmp_path / "run"), "--output", str(output), "--steps", "3"]
    assert main(command) == 2
    assert main([*command, "--initial", str(first), "--pretrained", str(first)]) == 2
    assert capsys.readouterr().err.count("name them with --initial") == 2
    whole = [word for word in command if word not in ("--part", "placement")]
    assert main([*whole, "--initial", str(first), "--pretrained", str(first)]) == 2
    assert "both give the hand encoder" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert main([*command, "--initial", str(first)]) == 0
    assert load_weights(output).config == TINY
    about = describe_weights(output)
    assert (about["about"]["stage"], about["about"]["steps"]) == ("placement", 3)
    assert about["history"] == [{"stage": "training"}]
    (tmp_path / "run" / "log.jsonl").unlink()  # what is kept of a run is its checkpoint
    output.unlink()
    assert main([*command, "--initial", str(first)]) == 0
    assert describe_weights(output)["about"]["steps"] == 3

