from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp import distance_matrix
from dro_grasp.geometry.point_clouds import random_half
from dro_grasp.geometry.se3 import roma
from dro_grasp.hands.hand import Hand
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

ASSET_HANDS = (
    "allegro_left", "allegro_right", "barrett_multidex", "barrett", "shadowhand", "leaphand", "inspire", "ability",
    "dclaw", "orca", "ezgripper",
)
BUILTIN_HANDS = ("barrett", "allegro", "shadowhand", "leaphand", "gripper3")


def ellipsoid(n: int, seed: int = 0) -> torch.Tensor:
    directions = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(directions, dim=-1) * torch.tensor([0.05, 0.03, 0.04])


def random_grasps(hand: Hand, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    q = hand.random_joints(n, torch.Generator().manual_seed(1))
    T = torch.eye(4).repeat(n, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = roma.random_rotmat(n), 0.1 * torch.randn(n, 3)
    return T, q


def clouds() -> dict[str, torch.Tensor]:
    dense = ellipsoid(1024)
    return {
        "full": ellipsoid(512),
        "partial": dense[random_half(dense, 512, torch.Generator().manual_seed(2))],
        "plane": ellipsoid(512) * torch.tensor([1.0, 1.0, 0.0]),
    }


def check_round_trip(hand: Hand, n: int = 8) -> None:
    T, q = random_grasps(hand, n)
    truth = hand.points(q, T)
    links = (T[:, None] @ hand.tree.forward(q))[:, hand.registrable, :3, 3]
    for name, cloud in clouds().items():
        cloud = cloud.expand(n, -1, -1)
        poses = distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud)
        found = distance_matrix.solve(hand, poses)
        error = (hand.points(found.joints, found.T_world_wrist) - truth).norm(dim=-1).mean(-1)
        solved = (found.T_world_wrist[:, None] @ hand.tree.forward(found.joints))[:, hand.registrable, :3, 3]
        assert found.converged.all(), name
        assert error.max() < 1e-3, name  # [m]
        assert (solved - links).norm(dim=-1).mean(-1).max() < 1e-3, name  # [m]
        assert (found.joints >= hand.tree.lower).all()
        assert (found.joints <= hand.tree.upper).all()


def test_build_is_the_distance_of_every_pair():
    hand_points, object_points = torch.randn(2, 40, 3), torch.randn(2, 50, 3)
    naive = np.linalg.norm(hand_points.numpy()[:, :, None] - object_points.numpy()[:, None], axis=-1)
    np.testing.assert_allclose(distance_matrix.build(hand_points, object_points), naive, atol=1e-6)


def test_round_trip_of_the_toy_hand():
    check_round_trip(toy_hand(), 30)


@pytest.mark.assets
@pytest.mark.parametrize("name", ASSET_HANDS)
def test_round_trip_of_asset_hands(name: str, assets_folder: Path):
    check_round_trip(loaded_hand(f"assets/{name}"))


@pytest.mark.parametrize("name", BUILTIN_HANDS)
def test_round_trip_of_builtin_hands(name: str):
    check_round_trip(loaded_hand(name))


def test_decode_gives_points_and_link_poses():
    hand = toy_hand()
    T, q = random_grasps(hand, 5)
    cloud, truth = ellipsoid(300).expand(5, -1, -1), hand.points(q, T)
    poses = distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud)
    np.testing.assert_allclose(poses.points, truth, atol=2e-4)  # [m]
    np.testing.assert_allclose(poses.T_world_link, T[:, None] @ hand.tree.forward(q), atol=5e-3)
    assert poses.residual.max() < 1e-4
    assert poses.valid.all()


def test_exact_link_poses_need_no_search():
    hand = toy_hand()
    T, q = random_grasps(hand, 20)
    truth, cloud = hand.points(q, T), ellipsoid(300).expand(20, -1, -1)
    poses = distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud)
    assert distance_matrix.solve(hand, poses).iterations.max() <= 3


def test_single_grasp_without_batch_axis():
    hand = toy_hand()
    T, q = random_grasps(hand, 1)
    truth, cloud = hand.points(q[0], T[0]), ellipsoid(300)
    found = distance_matrix.solve(hand, distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud))
    assert found.joints.shape == (6,)
    np.testing.assert_allclose(found.joints, q[0], atol=2e-3)


def test_links_with_few_points_are_left_out():
    hand = toy_hand()
    few = (hand.link_index != 1) | (torch.arange(hand.n_points) < int((hand.link_index == 0).sum()) + 3)
    hand = replace(
        hand, link_points=hand.link_points[few], link_normals=hand.link_normals[few], link_index=hand.link_index[few]
    )
    T, q = random_grasps(hand, 4)
    truth, cloud = hand.points(q, T), ellipsoid(300).expand(4, -1, -1)
    poses = distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud)
    assert poses.valid.tolist() == [True, False, True, True, True, True, True]
    assert torch.equal(poses.T_world_link[:, 1], torch.eye(4).expand(4, -1, -1))
    found = distance_matrix.solve(hand, poses)
    np.testing.assert_allclose(found.joints, q, atol=5e-3)


def test_palm_without_points_is_no_obstacle():
    hand = toy_hand()
    few = hand.link_index != 0
    hand = replace(
        hand, link_points=hand.link_points[few], link_normals=hand.link_normals[few], link_index=hand.link_index[few]
    )
    T, q = random_grasps(hand, 6)
    truth, cloud = hand.points(q, T), ellipsoid(300).expand(6, -1, -1)
    found = distance_matrix.solve(hand, distance_matrix.decode(hand, distance_matrix.build(truth, cloud), cloud))
    assert (found.residual < 1e-3).all()


def test_noise_is_averaged_out():
    hand = toy_hand()
    T, q = random_grasps(hand, 20)
    truth, cloud = hand.points(q, T), ellipsoid(300).expand(20, -1, -1)
    distances = distance_matrix.build(truth, cloud) + 0.005 * torch.randn(20, hand.n_points, 300)
    found = distance_matrix.solve(hand, distance_matrix.decode(hand, distances, cloud))
    error = (hand.points(found.joints, found.T_world_wrist) - truth).norm(dim=-1).mean(-1)
    assert error.median() < 1.5e-3  # [m], from distances 5 mm wrong


@pytest.mark.parametrize("cloud", ["full", "plane"])
def test_training_can_go_through_the_decoding(cloud: str):
    hand = toy_hand()
    T, q = random_grasps(hand, 2)
    anchors = clouds()[cloud].expand(2, -1, -1)
    truth = hand.points(q, T)
    distances = (distance_matrix.build(truth, anchors) + 0.002 * torch.randn(2, hand.n_points, 512)).requires_grad_()
    poses = distance_matrix.decode(hand, distances, anchors)
    wanted = T[:, None] @ hand.tree.forward(q)
    before = (poses.T_world_link - wanted).square().sum()
    before.backward()
    assert distances.grad.isfinite().all()
    assert distances.grad.abs().max() > 0
    step = 1e-4 * distances.grad / distances.grad.norm()
    after = (distance_matrix.decode(hand, distances.detach() - step, anchors).T_world_link - wanted).square().sum()
    assert after < before


@pytest.mark.parametrize("cloud", ["full", "plane", "mixed"])
def test_hands_of_several_kinds_are_decoded_together_as_each_by_itself(cloud: str) -> None:
    hands = [hand.with_points(256) for hand in (toy_hand(), loaded_hand("gripper3"), loaded_hand("allegro"))]
    rows, count = [], 3
    for hand in hands:
        T, q = random_grasps(hand, count)
        flatness = {"full": [1.0] * 3, "plane": [0.0] * 3, "mixed": [1.0, 0.0, 1.0]}[cloud]
        obj = torch.stack([ellipsoid(96, seed) * torch.tensor([1.0, 1.0, f]) for seed, f in enumerate(flatness)])
        noise = 1e-3 * torch.randn(count, hand.n_points, 96, generator=torch.Generator().manual_seed(4))
        rows.append((distance_matrix.build(hand.points(q, T), obj) + noise, obj))
    segments = distance_matrix.segments_of(hands, torch.device("cpu"))
    assert not segments.real.all(), "hands must differ in their numbers of links"
    distances, obj = (torch.cat(values) for values in zip(*rows, strict=True))
    each = distance_matrix.together([segments.rows(slice(i, i + 1)).spread(count) for i in range(3)])
    poses, _, points = distance_matrix.decode_segments(each, distances.requires_grad_(), obj)
    (gradient,) = torch.autograd.grad((poses * each.real[..., None, None]).square().sum(), distances)
    on_links = each.poses_of_points(poses)
    for i, hand in enumerate(hands):
        own, at = slice(i * count, (i + 1) * count), rows[i][0].requires_grad_()
        alone = distance_matrix.decode(hand, at, rows[i][1])
        torch.testing.assert_close(points[own], alone.points)
        torch.testing.assert_close(poses[own][:, segments.real[i]], alone.T_world_link[:, alone.valid], rtol=1e-4, atol=1e-5)
        kept = alone.valid[hand.link_index]
        assert torch.equal(segments.kept[i], kept)
        torch.testing.assert_close(on_links[own][:, kept], alone.T_world_link[:, hand.link_index[kept]], rtol=1e-4, atol=1e-5)
        (known,) = torch.autograd.grad(alone.T_world_link[:, alone.valid].square().sum(), at)
        assert float((gradient[own] - known).abs().max()) < 1e-3 * float(known.abs().max())
