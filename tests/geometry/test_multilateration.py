from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dro_grasp.geometry.multilateration import (
    MultilaterationConfig,
    choose_sides,
    distance_misfit,
    leading_eigenvector,
    multilaterate,
    thin_rows,
)
from dro_grasp.geometry.se3 import roma


def scene(batch: tuple[int, ...], thickness: float, noise: float = 0.0, dtype=torch.float32, m: int = 200):
    """Points, anchors far from the origin and oblique, and their distances [m]."""
    g = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0]
    anchors = torch.randn(*batch, m, 3, generator=g, dtype=torch.float64) * torch.tensor([0.04, 0.03, thickness])
    points = torch.randn(*batch, 60, 3, generator=g, dtype=torch.float64) * 0.05
    anchors, points = anchors @ turn.T, points @ turn.T
    distances = torch.cdist(points, anchors, compute_mode="donot_use_mm_for_euclid_dist")
    distances = (distances + noise * torch.randn(distances.shape, generator=g, dtype=torch.float64)).abs()
    shift = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    return (points + shift).to(dtype), (anchors + shift).to(dtype), distances.to(dtype)


CLOSED, REFINED = MultilaterationConfig(thin=0.0), MultilaterationConfig(thin=float("inf"))


def best(distances: Tensor, anchors: Tensor, config: MultilaterationConfig | None = None) -> Tensor:
    """The candidate of each point that fits its distances better."""
    first, second = multilaterate(distances, anchors, config)[0].unbind(-3)
    better = distance_misfit(first, distances, anchors) <= distance_misfit(second, distances, anchors)
    return torch.where(better[..., None], first, second)


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("config", [CLOSED, REFINED, None])
def test_exact_distances_give_the_points_back(batch, dtype, config):
    points, anchors, distances = scene(batch, 0.03, dtype=dtype)
    found = best(distances, anchors, config)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, points, atol=2e-5 if dtype == torch.float32 else 3e-6)  # [m], the ridge


def test_closed_form_equals_lstsq_under_noise():
    _, anchors, distances = scene((), 0.03, noise=0.005, dtype=torch.float64)
    found = best(distances, anchors, CLOSED).numpy()
    a, d = anchors.numpy(), distances.numpy()
    # |p|^2 - 2 a.p = d^2 - |a|^2, linear in (|p|^2, p): the same problem with the square as a free unknown.
    system = np.concatenate([np.ones((len(a), 1)), -2 * a], 1)
    oracle = np.linalg.lstsq(system, (d**2 - (a**2).sum(1)).T, rcond=None)[0][1:].T
    np.testing.assert_allclose(found, oracle, atol=5e-6)  # [m], the ridge accounts for the difference


def test_refinement_is_a_minimum_of_unsquared_distances():
    _, anchors, distances = scene((), 0.02, noise=0.005, dtype=torch.float64)
    points = best(distances, anchors, REFINED).requires_grad_()
    distance_misfit(points, distances, anchors).sum().backward()
    assert points.grad.abs().max() < 1e-5
    closed = best(distances, anchors, CLOSED)
    assert (distance_misfit(points, distances, anchors) <= distance_misfit(closed, distances, anchors)).all()


@pytest.mark.parametrize("thickness", [0.001, 0.004])
def test_thin_clouds_are_refined_by_default(thickness):
    points, anchors, distances = scene((3,), thickness, noise=0.005)
    error = (best(distances, anchors) - points).norm(dim=-1).mean()
    closed = (best(distances, anchors, CLOSED) - points).norm(dim=-1).mean()
    assert error < 0.5 * closed


def test_an_exact_plane_leaves_two_mirrored_candidates():
    points, anchors, distances = scene((2,), 0.0)
    both, flat = multilaterate(distances, anchors)
    assert flat.all()
    error = (both - points[:, None]).norm(dim=-1).amin(1)
    assert error.max() < 2e-3  # [m], heights under a millimetre
    assert error.median() < 1e-5
    centre = anchors.mean(1, keepdim=True)
    normal = torch.linalg.svd(anchors - centre)[2][:, 2]
    heights = ((both - centre[:, None]) * normal[:, None, None]).sum(-1)
    np.testing.assert_allclose(heights[:, 0], -heights[:, 1], atol=2e-3)


def test_thick_clouds_have_one_candidate():
    points, anchors, distances = scene((2,), 0.03)
    both, flat = multilaterate(distances, anchors)
    assert not flat.any()
    assert torch.equal(both[:, 0], both[:, 1])
    np.testing.assert_allclose(both[:, 0], points, atol=2e-5)


def mixed() -> tuple[Tensor, Tensor]:
    """Distances and anchors of five clouds, of which the second and the last are thin."""
    scenes = [scene((), thickness, noise=0.003)[1:] for thickness in (0.03, 0.001, 0.03, 0.02, 0.002)]
    anchors, distances = (torch.stack(values) for values in zip(*scenes, strict=True))
    return distances, anchors


def test_rows_of_thin_clouds_are_found_where_there_is_room():
    _, anchors = mixed()
    assert thin_rows(anchors, 2).tolist() == [1, 4]
    assert thin_rows(anchors, 3).tolist() == [1, 4, 0]
    assert thin_rows(anchors, 1).tolist() == [1, 4, 0, 2, 3], "all, rather than some of the thin ones"


@pytest.mark.parametrize("room", [2, 4, 5])
def test_thin_clouds_among_given_rows_are_placed_as_those_that_are_looked_for(room: int, device: str):
    distances, anchors = (values.to(device) for values in mixed())
    expected, flat = multilaterate(distances, anchors)
    found, same = multilaterate(distances, anchors, among=thin_rows(anchors, room))
    assert flat.tolist() == same.tolist() == [False, True, False, False, True]
    torch.testing.assert_close(found.cpu(), expected.cpu(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_device_places_points_as_the_cpu_does(noise: float, device: str):
    _, anchors, distances = scene((3,), 0.002, noise)
    for given in (mixed(), (distances, anchors)):
        here, there = multilaterate(*given)[0], multilaterate(*(values.to(device) for values in given))[0].cpu()
        mirrored = (here - there.flip(1)).norm(dim=-1) < (here - there).norm(dim=-1)  # axes have no sign
        there = torch.where(mirrored[..., None], there.flip(1), there)
        apart = (here - there).norm(dim=-1)
        assert apart.quantile(0.95) < 1e-5
        assert apart.max() < 5e-4, "where noise leaves a shallow minimum"


@pytest.mark.parametrize("size", [3, 4])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_the_leading_eigenvector_is_that_of_lapack(size: int, scale: float):
    matrix = torch.randn(200, size, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix = scale * (matrix + matrix.mT)
    values, vectors = np.linalg.eigh(matrix.numpy())
    apart = (values[:, -1] - values[:, -2]) / np.abs(values).max(1)
    found = leading_eigenvector(matrix).numpy()
    aligned = np.abs((found * vectors[:, :, -1]).sum(-1))
    assert apart.min() > 1e-3
    np.testing.assert_allclose(aligned, 1, atol=1e-9)
    single = leading_eigenvector(matrix.float()).numpy()
    np.testing.assert_allclose(np.abs((single * vectors[:, :, -1]).sum(-1))[apart > 0.05], 1, atol=1e-5)


def test_of_two_leading_eigenvectors_some_vector_of_both_is_found():
    found = leading_eigenvector(torch.diag(torch.tensor([2.0, 2.0, -3.0])))
    assert found.norm() == pytest.approx(1)
    assert found[2] == pytest.approx(0)


def test_a_cloud_does_not_depend_on_its_neighbours_in_the_batch():
    _, thin, near_thin = scene((), 0.001, noise=0.003)
    _, thick, near_thick = scene((), 0.03, noise=0.003)
    together = best(torch.stack([near_thin, near_thick]), torch.stack([thin, thick]))
    np.testing.assert_allclose(together[0], best(near_thin, thin), atol=1e-5)
    np.testing.assert_allclose(together[1], best(near_thick, thick), atol=1e-5)


@pytest.mark.parametrize("config", [CLOSED, REFINED])
def test_gradient_agrees_with_finite_differences(config):
    _, anchors, distances = scene((), 0.02, dtype=torch.float64, m=12)
    distances = distances[:2].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda d: best(d, anchors, config), distances, atol=1e-3, rtol=1e-2)


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
