"""Training that begins with given weights: their architecture is taken, and what does not fit them is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.errors import WeightsError
from dro_grasp.hands.proportions import proportions
from dro_grasp.models.checkpoints import describe_weights, load_weights, save_weights
from dro_grasp.models.network import DistanceNetwork, untrained_network
from dro_grasp.models.placement import PROPORTIONS
from dro_grasp.models.presets import NetworkConfig
from dro_grasp.training.config import TrainConfig
from dro_grasp.training.loop import train
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, quiet

MOVING = dataclasses.replace(TINY, latent_form="motion", prior="flow")
"""The form of the shipped weights, tiny."""


@pytest.fixture
def command(home: Path, bundle: Bundle, tmp_path: Path, quick_statistics: None) -> list[str]:
    """Train one step from weights in the form of the shipped ones."""
    save_weights(untrained_network(MOVING, seed=0), tmp_path / "initial.safetensors")
    return ["train", "--bundle", str(home / "bundle.safetensors"), "--run-folder", str(tmp_path / "run"), "--output",
            str(tmp_path / "tuned.safetensors"), "--initial", str(tmp_path / "initial.safetensors"), "--steps", "1",
            "--learning-rate", "1e-9"]


def test_initial_weights_bring_their_architecture_and_every_tensor(command: list[str], tmp_path: Path) -> None:
    assert main(command) == 0
    given, tuned = (load_weights(tmp_path / f"{name}.safetensors") for name in ("initial", "tuned"))
    assert tuned.config == given.config
    for name, value in tuned.state_dict().items():
        if "running" not in name and "tracked" not in name:
            torch.testing.assert_close(value, given.state_dict()[name], msg=name)


def test_options_that_contradict_initial_weights_are_refused(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options, told in (
        (["--size", "slim"], "n_hand 160 instead of 48"), (["--preset", "paper"], "frame object instead of wrist"),
        (["--latent", "6"], "latent 6 instead of 4"), (["--prior", "standard"], "prior standard instead of flow"),
        (["--latent-form", "kernel"], "latent_form kernel instead of motion"),
    ):
        assert main([*command, *options]) == 2
        assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert main([*command, "--latent", "4", "--prior", "flow", "--latent-form", "motion"]) == 0, "they say the same"


def test_weights_of_another_configuration_are_refused(bundle: Bundle, tmp_path: Path) -> None:
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)

    def refused(word: str, network: NetworkConfig, **given: NetworkConfig) -> None:
        weights = {role: DistanceNetwork(form, name="given") for role, form in given.items()}
        with pytest.raises(WeightsError, match=word):
            train(bundle, network, config, tmp_path / "run", report=quiet, **weights)

    # The first four change no tensor's name or shape.
    settings = {"frame": "palm", "neighbours": 4, "heads": 1, "placement_temperature": 0.1, "latent": 6, "prior": "flow"}
    for name, value in settings.items():
        told = f"'given' have another configuration.*: {name} {value} instead of {getattr(TINY, name)};"
        refused(told, dataclasses.replace(TINY, **{name: value}), initial=TINY)
    refused("latent_form kernel instead of motion, prior standard instead of flow", TINY, initial=MOVING)
    other = dataclasses.replace(TINY, width=20)
    refused(r"'given' do not fit this network: .*final\.linear\.weight has shape \(20, 40\), not \(16, 40\)", TINY,
            pretrained=other)
    refused("neighbours of each point", dataclasses.replace(TINY, neighbours=TINY.neighbours + 1), pretrained=TINY)
    refused(r"hold a pretrained motion, but z does not move the hand", TINY, pretrained=MOVING)
    refused(r"code\.4\.weight has shape", dataclasses.replace(MOVING, latent=6), pretrained=MOVING)
    assert not (tmp_path / "run").exists()


def test_a_placement_prior_of_another_form_begins_anew_and_all_else_is_taken(bundle: Bundle, tmp_path: Path) -> None:
    given = untrained_network(TINY, seed=5)
    config = TrainConfig(dataclasses.replace(SCHEDULE, steps=1, learning_rate=1e-9), hands_per_step=1, columns=24)
    form = dataclasses.replace(TINY, placement_hand="proportions")
    tuned = train(bundle, form, config, tmp_path / "run", report=quiet, initial=given)
    assert tuned.placement is not None
    for name, value in tuned.state_dict().items():
        if "running" not in name and "tracked" not in name and not name.startswith("placement."):
            torch.testing.assert_close(value, given.state_dict()[name], msg=name)
    hand = bundle.hands["toy"].with_points(TINY.n_hand)
    torch.testing.assert_close(tuned.placement.standardised.mean, proportions(hand, torch.eye(3)))
    assert tuned.placement.hand.weight.shape[1] == PROPORTIONS
    other = untrained_network(form, seed=6)
    again = train(bundle, form, config, tmp_path / "again", report=quiet, initial=other)
    assert again.placement is not None
    assert bool((again.placement.standardised.mean == 0).all()), "fine-tuning keeps what the numbers are relative to"


def test_tuned_weights_say_what_they_come_from(command: list[str], tmp_path: Path) -> None:
    initial = tmp_path / "initial.safetensors"
    save_weights(load_weights(initial), initial, {"stage": "first"}, [{"stage": "before"}])
    assert main(command) == 0
    about = describe_weights(tmp_path / "tuned.safetensors")
    assert about["history"] == [{"stage": "before"}, {"stage": "first"}]
    assert (about["about"]["initial"], about["about"]["steps"]) == (str(initial), 1)
    assert about["about"]["data"]["grasps"] == 48
    assert about["about"]["settings"]["schedule"]["learning_rate"] == 1e-9
