"""Training and inference in the paper's form: the open hand is tilted, its place tells nothing, and no prior places it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from torch import Tensor

from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import apply_to_cloud
from dro_grasp.hands.hand import Hand
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.presets import PRESETS, NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.starts import Direction
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import ProposalConfig, _placements
from dro_grasp.training import loop
from dro_grasp.training.config import AugmentationConfig, LossConfig, PretrainConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.pretraining import contrastive_step, posture_clouds
from dro_grasp.training.samples import SampleSource
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, curve, run_stage

PAPER = dataclasses.replace(TINY, frame="object")
COUNT = 400


def wrist_turns(hand: Hand, clouds: Tensor) -> Rotation:
    """How the palm, the toy hand's root, is turned in clouds of its points."""
    palm = hand.link_index == 0
    body = hand.link_points[palm]
    body = body - body.mean(0)
    seen = [cloud[palm] - cloud[palm].mean(0) for cloud in clouds]
    return Rotation.concatenate([Rotation.align_vectors(cloud.numpy(), body.numpy())[0] for cloud in seen])


def test_the_open_hand_is_tilted_about_axes_across_its_direction_to_the_object(bundle: Bundle) -> None:
    source = SampleSource(bundle, PAPER, AugmentationConfig(object_noise=0.0))
    drawn = source.draw("toy", COUNT, torch.Generator().manual_seed(0))
    T = drawn.T_frame_link[:, 0]
    true = Rotation.from_matrix(T[:, :3, :3].numpy())
    tilt = (wrist_turns(drawn.hand, drawn.placed) * true.inv()).as_rotvec()
    angles = np.linalg.norm(tilt, axis=1)
    assert kstest(angles / np.radians(30), "uniform").pvalue > 1e-3
    toward = -torch.nn.functional.normalize(T[:, :3, 3], dim=-1).numpy()  # the object's centre is the origin
    assert np.abs((tilt * toward).sum(1)).max() < 1e-4
    torch.testing.assert_close(apply_to_cloud(T, drawn.hand.link_points[drawn.hand.link_index == 0]),
                               drawn.grasp[:, drawn.hand.link_index == 0], atol=1e-6, rtol=0)


def test_the_position_of_the_open_hand_tells_nothing_of_the_grasp(bundle: Bundle) -> None:
    drawn = SampleSource(bundle, PAPER, AugmentationConfig()).draw("toy", 20, torch.Generator().manual_seed(0))
    turned, palm = wrist_turns(drawn.hand, drawn.placed), drawn.hand.link_index == 0
    wrist = drawn.placed[:, palm].mean(1).numpy() - turned.apply(drawn.hand.link_points[palm].mean(0).numpy())
    np.testing.assert_allclose(wrist + turned.apply(drawn.hand.grasp_centre_wrist.numpy()), 0, atol=1e-5)


def test_pretraining_tilts_the_open_hand_as_training_does(bundle: Bundle) -> None:
    seen: list[Tensor] = []
    encoder = DistanceNetwork(PAPER).hand_encoder
    encoder.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    source = SampleSource(bundle, PAPER, AugmentationConfig())
    config = PretrainConfig(hands_per_step=1, samples_per_hand=COUNT)
    with torch.no_grad():
        contrastive_step(encoder, posture_clouds(source, config, torch.Generator().manual_seed(0)), config)
    grasping, opened = (wrist_turns(source.hands["toy"], clouds) for clouds in seen[0].chunk(2))
    assert kstest((opened * grasping.inv()).magnitude() / np.radians(30), "uniform").pvalue > 1e-3
    stored = Rotation.from_matrix(source.grasps["toy"].T_object_wrist[:, :3, :3].numpy())
    nearest = [(stored * turn.inv()).magnitude().min() for turn in grasping[:20]]
    assert max(nearest) < 1e-3


def test_nothing_is_learned_about_placements(bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "recalibrate", lambda *_: None)
    model = run_stage("train", bundle, tmp_path / "run", dataclasses.replace(SCHEDULE, steps=2), network=PAPER)
    assert model.placement is None
    assert not {"placement", "motion"} & curve(tmp_path / "run")[-1].keys()


@pytest.mark.parametrize("direction", [None, (0.0, 1.0, 0.0)])
def test_wrists_are_turned_at_random_or_face_the_direction(direction: Direction | None) -> None:
    network, hand = DistanceNetwork(PAPER), loaded_hand("leaphand").with_points(PAPER.n_hand)
    cloud = torch.rand(60, 3) * torch.tensor([0.2, 0.02, 0.05])
    problem = GraspProblem(hand, load_object("sphere"), constraints=Constraints(direction=direction))
    T = _placements(problem, hand, network, cloud, COUNT, 1, ProposalConfig(), torch.Generator().manual_seed(0))[:, 0]
    torch.testing.assert_close(hand.grasp_centres(T), cloud.mean(0).expand(COUNT, 3), atol=1e-5, rtol=0)
    facing = hand.palm_directions(T)
    if direction is None:  # each coordinate of a uniform direction is uniform, and so is that of any other axis of the hand
        side = T[:, :3, :3] @ torch.linalg.cross(hand.palm_direction_wrist, torch.tensor([0.6, 0.0, 0.8]))
        for axes in (facing, torch.nn.functional.normalize(side, dim=-1)):
            assert min(kstest(axes[:, i].numpy(), "uniform", (-1, 2)).pvalue for i in range(3)) > 1e-3
    else:
        assert float(facing[:, 1].min()) > 0.9


def test_losses_of_the_release_are_one_option(home: Path, bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    def keep(given: Bundle, network: NetworkConfig, config: TrainConfig, *_: object, **__: object) -> None:
        asked.append((network, config.losses))
        raise OptionError("enough")

    asked: list[tuple[NetworkConfig, LossConfig]] = []
    monkeypatch.setattr(loop, "train", keep)
    command = ["train", "--bundle", str(home / "bundle.safetensors"), "--preset", "paper-slim", "--run-folder",
               str(home / "none"), "--output", str(home / "none.safetensors")]
    for options in ([], ["--losses", "release"], ["--losses", "release", "--divergence", "0.003"]):
        assert main([*command, *options]) == 2
    assert {network for network, _ in asked} == {PRESETS["paper-slim"]}
    ours, release, changed = (losses for _, losses in asked)
    assert ours == LossConfig(penetration=5.0, divergence=0.01, divergence_form="batch_mean")
    # configs/train.yaml of the release: distance 1, pose 0.01, penetration 1, divergence 0.01.
    assert (release.distance, release.pose, release.penetration, release.divergence) == (1.0, 0.01, 1.0, 0.01)
    assert release.divergence_form == "official"
    assert changed == dataclasses.replace(release, divergence=0.003)
