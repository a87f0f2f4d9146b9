"""Named configurations: the paper's numbers, those of the shipped weights, and what the shipped weights predict."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch
from safetensors import safe_open

from dro_grasp.errors import OptionError
from dro_grasp.network.checkpoints import KEY, load_weights, locate_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.placement import PROPORTIONS
from dro_grasp.network.presets import FORMER, PRESETS, NetworkConfig


def test_paper_preset_is_the_papers_network() -> None:
    paper = PRESETS["paper"]
    assert dataclasses.asdict(paper) == {
        "n_hand": 512, "n_object": 512, "width": 512, "encoder_widths": (64, 64, 128, 256, 512), "neighbours": 32, "heads": 4,
        "attention_hidden": 1024, "latent": 64, "latent_widths": (64, 64, 128, 256), "latent_head": (512, 256),
        "latent_neighbours": 20, "frame": "object", "kernel_hidden": (300, 100),
        # Ours: where an untrained kernel begins, and the placement prior, which the paper's network does not have.
        "initial_distance": 0.1, "placement_width": 128, "placement_components": 8,
        "placement_temperature": 0.7,
    }
    assert not paper.placed
    network = DistanceNetwork(paper)
    assert 13.5e6 < sum(p.numel() for p in network.parameters()) < 15e6
    parts = {name for name, _ in network.named_children()}
    assert parts == {"hand_encoder", "object_encoder", "hand_transformer", "object_transformer", "latent_encoder", "head"}


def test_multi_preset_is_the_network_of_the_default_weights() -> None:
    shipped = load_weights()
    assert shipped.config == PRESETS["multi"]
    with safe_open(locate_weights(), "pt") as file:
        stored = json.loads(file.metadata()[KEY])["config"]
    former = {name: value for name, value in stored.items() if name in FORMER["palm"]}
    assert former == {"latent_form": "motion", "prior": "flow", "placement_hand": "proportions"}, "implied by the frame now"
    assert set(stored) - set(former) == {f.name for f in dataclasses.fields(NetworkConfig)}


def test_presets_differ_in_what_they_are_named_for() -> None:
    assert PRESETS["slim"] == PRESETS["multi"]
    assert PRESETS["paper-slim"].differences(PRESETS["multi"]) == {"frame": ("object", "palm"), "latent": (64, 32)}
    assert not PRESETS["paper-slim"].differences(PRESETS["paper"]).keys() & {"frame", "latent"}
    assert PRESETS["slim"].differences(PRESETS["slim"]) == {}
    assert NetworkConfig.preset("slim") is PRESETS["slim"]
    with pytest.raises(OptionError, match="no network is called 'wide'; choose paper, paper-slim, slim, multi"):
        NetworkConfig.preset("wide")


def test_axes_are_the_palms_or_the_objects() -> None:
    palm = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    assert torch.equal(PRESETS["multi"].axes(palm), palm)
    assert torch.equal(PRESETS["paper"].axes(palm), torch.eye(3))


@torch.no_grad()
def test_shipped_weights_predict_what_they_predicted() -> None:
    """Recorded before the settings were reduced; on the machine of the recording the numbers were equal to the last bit."""
    network, generator = load_weights(), torch.Generator().manual_seed(3)
    hand = torch.randn(5, 160, 3, generator=generator) * 0.05
    obj = torch.randn(5, 128, 3, generator=generator) * 0.05
    turns = torch.linalg.qr(torch.randn(40, 3, 3, generator=generator))[0]
    turns = turns * torch.linalg.det(turns)[:, None, None]
    distances = network.predict(hand, obj, network.sample_latent(5, generator))
    network.sample_latent(5, generator, 0.3)
    _, positions = network.sample_placements(obj[0], turns, 7, generator, torch.linspace(-0.1, 0.2, PROPORTIONS))
    expected = torch.tensor([[0.1621, 0.0539, 0.0875], [0.1775, 0.0345, 0.0774], [0.2106, 0.1002, 0.0704]])
    torch.testing.assert_close(distances[0, :3, :3], expected, rtol=0, atol=2e-4)
    assert float(distances.mean()) == pytest.approx(0.1136, abs=1e-4)
    torch.testing.assert_close(positions[0], torch.tensor([-0.0187, 0.0134, -0.1166]), rtol=0, atol=2e-4)
