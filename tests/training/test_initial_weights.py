"""Training that begins with given weights: their architecture is taken, and what does not fit them is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.errors import WeightsError
from dro_grasp.hands.proportions import proportions
from dro_grasp.network.checkpoints import describe_weights, load_weights, save_weights
from dro_grasp.network.network import DistanceNetwork, untrained_network
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.loop import train
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, quiet

PAPER = dataclasses.replace(TINY, frame="object")


@pytest.fixture
def command(home: Path, bundle: Bundle, tmp_path: Path, quick_statistics: None) -> list[str]:
    """Train one step from weights in the form of the shipped ones."""
    save_weights(untrained_network(TINY, seed=0), tmp_path / "initial.safetensors")
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
        (["--preset", "slim"], "n_hand 160 instead of 48"), (["--preset", "paper"], "frame object instead of palm"),
    ):
        assert main([*command, *options]) == 2
        assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_weights_of_another_configuration_are_refused(bundle: Bundle, tmp_path: Path) -> None:
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)

    def refused(word: str, network: NetworkConfig, **given: NetworkConfig) -> None:
        weights = {role: DistanceNetwork(form, name="given") for role, form in given.items()}
        with pytest.raises(WeightsError, match=word):
            train(bundle, network, config, tmp_path / "run", report=quiet, **weights)

    # The first three change no tensor's name or shape.
    settings = {"neighbours": 4, "heads": 1, "placement_temperature": 0.1, "latent": 6, "frame": "object"}
    for name, value in settings.items():
        told = f"'given' have another configuration.*: {name} {value} instead of {getattr(TINY, name)};"
        refused(told, dataclasses.replace(TINY, **{name: value}), initial=TINY)
    other = dataclasses.replace(TINY, width=20)
    refused(r"'given' do not fit this network: .*final\.linear\.weight: .*\[20, 40\].*\[16, 40\]", TINY, pretrained=other)
    refused("neighbours of each point", dataclasses.replace(TINY, neighbours=TINY.neighbours + 1), pretrained=TINY)
    refused(r"hold a pretrained motion, but z does not move the hand", PAPER, pretrained=TINY)
    refused(r"code\.4\.weight: ", dataclasses.replace(TINY, latent=6), pretrained=TINY)
    assert not (tmp_path / "run").exists()


def test_fine_tuning_keeps_what_proportions_are_relative_to(bundle: Bundle, tmp_path: Path) -> None:
    config = TrainConfig(dataclasses.replace(SCHEDULE, steps=1, learning_rate=1e-9), hands_per_step=1, columns=24)
    begun = train(bundle, TINY, config, tmp_path / "begun", report=quiet)
    tuned = train(bundle, TINY, config, tmp_path / "tuned", report=quiet, initial=untrained_network(TINY, seed=6))
    assert begun.placement is not None
    assert tuned.placement is not None
    hand = bundle.hands["toy"].with_points(TINY.n_hand)
    torch.testing.assert_close(begun.placement.standardised.mean, proportions(hand, hand.palm_axes_wrist))
    assert bool((tuned.placement.standardised.mean == 0).all())


def test_tuned_weights_say_what_they_come_from(command: list[str], tmp_path: Path) -> None:
    initial = tmp_path / "initial.safetensors"
    save_weights(load_weights(initial), initial, {"stage": "first"}, [{"stage": "before"}])
    assert main(command) == 0
    about = describe_weights(tmp_path / "tuned.safetensors")
    assert about["history"] == [{"stage": "before"}, {"stage": "first"}]
    assert (about["about"]["initial"], about["about"]["steps"]) == (str(initial), 1)
    assert about["about"]["data"]["grasps"] == 48
    assert about["about"]["settings"]["schedule"]["learning_rate"] == 1e-9
