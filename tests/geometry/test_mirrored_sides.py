from __future__ import annotations

import torch

from dro_grasp.geometry.mirrored_sides import choose_sides
from dro_grasp.geometry.rotations import roma


def bodies(height: float, noise: float = 0.0) -> tuple[torch.Tensor, ...]:
    """Two bodies of 30 points, 40 poses around this height over the plane z = 0, with mirrored candidates."""
    torch.manual_seed(0)
    local = torch.randn(2, 30, 3) * torch.tensor([0.01, 0.015, 0.03])
    posed = local @ roma.random_rotmat((40, 2)).mT + torch.randn(40, 2, 1, 3) * torch.tensor([0.05, 0.05, 0.0])
    posed[..., 2] += height
    second = posed[..., 2] < 0
    mirrored = posed * torch.tensor([1.0, 1.0, -1.0])
    swap = second[..., None]
    pair = torch.stack([torch.where(swap, mirrored, posed), torch.where(swap, posed, mirrored)], 1)
    return local, torch.ones(2, 30), pair + noise * torch.randn_like(pair), torch.zeros(40, 2, 2, 30), second, posed


def wrong(height: float, noise: float = 0.0) -> torch.Tensor:
    """Mask of the points far from the plane that came out on the wrong side."""
    local, weight, candidates, misfit, second, posed = bodies(height, noise)
    chosen = choose_sides(local, weight, candidates, misfit, 0)
    return (chosen != second) & (posed[..., 2].abs() > 0.003)


def test_bodies_on_one_side():
    assert not wrong(0.15).any()


def test_bodies_cut_by_the_plane():
    assert wrong(0.0).float().mean() < 0.01


def test_noise_leaves_the_side_of_most_points():
    assert wrong(0.08, noise=0.002).float().mean() < 0.05


def test_padding_has_no_say():
    local, weight, candidates, misfit, second, _ = bodies(0.15)
    local, candidates = local.clone(), candidates.clone()
    weight[:, 25:] = 0
    local[:, 25:], candidates[..., 25:, :] = 9.0, -7.0
    assert torch.equal(choose_sides(local, weight, candidates, misfit, 0)[..., :25], second[..., :25])


def test_what_fits_both_ways_follows_the_reference():
    local, weight, _, misfit, _, _ = bodies(0.15)
    local = local.clone()
    local[1, :, 0] = 0  # a flat body has no handedness
    posed = local @ torch.eye(3) + torch.tensor([0.0, 0.0, 0.15])
    mirrored = posed * torch.tensor([1.0, 1.0, -1.0])
    for first in (posed, mirrored):
        pair = torch.stack([first, posed if first is mirrored else mirrored])[None]
        chosen = choose_sides(local, weight, pair, misfit[:1], 0)
        assert torch.equal(chosen, torch.full_like(chosen, first is mirrored))
