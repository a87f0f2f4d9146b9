"""Features of grasps against plain geometry, and a network to which links are a set."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.errors import WeightsError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.predict.score.features import (
    FARTHEST,
    GRASP_FEATURES,
    LENGTH,
    LINK_FEATURES,
    MOTION,
    NEAR,
    Feature,
    GraspFeatures,
    grasp_features,
)
from dro_grasp.predict.score.score import ScoreNetwork, load_score_network, save_score_network, shipped_score_network
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    return load_object("sphere")


@pytest.fixture(scope="module")
def grasps(ball: ObjectModel) -> GraspBatch:
    made = made_up_grasps(HAND, "sphere", count=6)
    T = made.T_object_wrist.clone()
    T[:, :3, 3] -= 0.01
    return made.replace(T_object_wrist=T)


def features(obj: ObjectModel, grasps: GraspBatch) -> GraspFeatures:
    energy = GraspEnergy.of_object(HAND, obj)
    return grasp_features(energy, grasps, energy(grasps.T_object_wrist, grasps.joints).terms)


def test_links_are_described_at_their_point_nearest_to_a_ball(ball: ObjectModel, grasps: GraspBatch) -> None:
    found = features(ball, grasps)
    radius = float(np.linalg.norm(ball.vertices, axis=1).mean())
    points = HAND.points(grasps.joints, grasps.T_object_wrist)
    before, after = (HAND.points(joints, grasps.T_object_wrist) for joints in pregrasp_and_squeeze(
        HAND, grasps.T_object_wrist, grasps.joints, torch.zeros(3)))
    links, checked = HAND.link_index.unique().tolist(), 0
    widths = [feature.width for feature in LINK_FEATURES.values()]
    assert found.links.shape == (6, len(links), sum(widths))
    columns = dict(zip(LINK_FEATURES, found.links.split(widths, -1), strict=True))
    for i in range(len(grasps)):
        axes = grasps.T_object_wrist[i, :3, :3] @ HAND.palm_axes_wrist
        for slot, link in enumerate(links):
            own = points[i, HAND.link_index == link]
            distance = own.norm(dim=-1) - radius
            gap = float(distance.min())
            told = {name: values[i, slot] for name, values in columns.items()}
            if gap < -0.02:  # near the ball's middle, where no direction is outward
                continue
            checked += 1
            assert float(told["gap"]) * MOTION == pytest.approx(max(-FARTHEST, min(gap, FARTHEST)), abs=0.0015)
            assert float(found.nearness[i, slot]) == pytest.approx(np.exp(-max(gap, 0) / NEAR), abs=0.2)
            # Which of two points is nearest may differ by the grid's rounding; the one told lies that near as well.
            place = axes @ told["position"] * LENGTH
            assert float(place.norm()) - radius == pytest.approx(gap, abs=0.002)
            normal = axes @ told["object normal"]
            assert float(normal @ torch.nn.functional.normalize(place, dim=0)) > 0.97
            which = int((own - place).norm(dim=-1).argmin())
            closing = after[i, HAND.link_index == link][which] - own[which]
            torch.testing.assert_close(axes @ told["closing vector"] * MOTION, closing, atol=1e-4, rtol=0)
            assert float(told["closing"]) * MOTION == pytest.approx(-float(closing @ normal), abs=1e-4)
            arriving = own[which] - before[i, HAND.link_index == link][which]
            assert float(told["arriving"]) * MOTION == pytest.approx(-float(arriving @ normal), abs=1e-4)
            assert bool(told["palm"]) == (link == HAND.palm)
    assert checked > 12


def test_features_do_not_know_where_the_scene_is(ball: ObjectModel, grasps: GraspBatch) -> None:
    # A turn that takes axes to axes, so that the grid turns as well.
    R, shift = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), torch.tensor([0.1, -0.2, 0.3])
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    moved = dataclasses.replace(
        cloud, cloud=(torch.from_numpy(ball.cloud) @ R.T + shift).numpy(),
        cloud_normals=(torch.from_numpy(ball.cloud_normals) @ R.T).numpy(), centre_of_mass=shift.numpy().astype(float))
    T = grasps.T_object_wrist.clone()
    T[:, :3] = R @ T[:, :3]
    T[:, :3, 3] += shift
    here, there = features(cloud, grasps), features(moved, grasps.replace(T_object_wrist=T))
    for ours, theirs in zip(here, there, strict=True):
        assert ((ours - theirs).abs() < 2e-3).float().mean() > 0.97


def test_links_are_a_set() -> None:
    torch.manual_seed(0)
    network = ScoreNetwork(2)
    link_width, whole_width = (sum(f.width for f in features.values()) for features in (LINK_FEATURES, GRASP_FEATURES))
    links, nearness, whole = torch.randn(5, 7, link_width), torch.rand(5, 7), torch.randn(5, whole_width)
    order = torch.randperm(7)
    whole_set = network(links, nearness, whole)
    torch.testing.assert_close(network(links[:, order], nearness[:, order], whole), whole_set)
    repeated = torch.cat([links, links[:, :1]], 1), torch.cat([nearness, torch.zeros(5, 1)], 1)
    torch.testing.assert_close(network(*repeated, whole), whole_set)
    assert not torch.allclose(network(links, nearness.flip(1), whole), whole_set)


def test_a_network_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    shipped = shipped_score_network()
    save_score_network(shipped, tmp_path / "again.safetensors")
    again = load_score_network(tmp_path / "again.safetensors")
    for name, value in shipped.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
    assert not any(p.requires_grad for p in again.parameters())


def test_a_network_of_other_features_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A feature more than the weights know: both lists are named. A file without a list is refused as well."""
    save_weights(ScoreNetwork(2), tmp_path / "unnamed.safetensors")
    with pytest.raises(WeightsError, match=r"unnamed.safetensors states the features None"):
        load_score_network(tmp_path / "unnamed.safetensors")
    save_score_network(ScoreNetwork(2), tmp_path / "old.safetensors")
    monkeypatch.setitem(LINK_FEATURES, "spin", Feature(1, lambda s: s.gap))
    with pytest.raises(WeightsError, match=r"old.safetensors.*'energy terms'.*'spin', 'energy terms'"):
        load_score_network(tmp_path / "old.safetensors")
