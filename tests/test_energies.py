"""Energy terms and their gradients against finite differences in double precision, and against known grasps."""

from __future__ import annotations

import pytest
import roma
import torch

from dro_grasp.geometry.signed_distance import SignedDistanceGrid
from dro_grasp.grasps import energies
from dro_grasp.grasps.field import CloudField, DistanceField
from dro_grasp.grasps.grasp_energy import TERMS, EnergyConfig, GraspEnergy
from dro_grasp.grasps.synthesis import moved
from tests.toy_hand import toy_hand

STEP = 1e-6
RADIUS = 0.03


def sphere_grid(half: float = 0.08, spacing: float = 0.004) -> SignedDistanceGrid:
    axis = torch.arange(-half, half + 1e-9, spacing, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return SignedDistanceGrid.from_values(points.norm(dim=-1) - RADIUS, torch.full((3,), -half), spacing)


def random(*shape: int, seed: int = 0, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def unit(x: torch.Tensor) -> torch.Tensor:
    return x / x.norm(dim=-1, keepdim=True)


def numeric(function, x: torch.Tensor) -> torch.Tensor:
    """Central differences of a function that maps (b ...) to (b), for every entry of x."""
    gradient = torch.zeros_like(x)
    flat, out = x.reshape(len(x), -1), gradient.reshape(len(x), -1)
    for i in range(flat.shape[1]):
        step = torch.zeros_like(flat)
        step[:, i] = STEP
        high, low = (function((flat + s * step).reshape(x.shape)) for s in (1, -1))
        out[:, i] = (high - low) / (2 * STEP)
    return gradient


def test_force_closure_gradients():
    points, normals = random(3, 4, 3, scale=0.05), unit(random(3, 4, 3, seed=1))
    term = energies.force_closure(points, normals, 0.04)
    by_point = numeric(lambda p: energies.force_closure(p, normals, 0.04).value.sum(-1), points)
    by_normal = numeric(lambda n: energies.force_closure(points, n, 0.04).value.sum(-1), normals)
    torch.testing.assert_close(term.by_point, by_point, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(term.by_normal, by_normal, rtol=1e-6, atol=1e-6)


def test_force_closure_of_known_contacts():
    tetrahedron = unit(torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]))
    assert energies.force_closure(0.03 * tetrahedron, tetrahedron, 0.03).value.sum() < 1e-12
    one_sided = unit(torch.tensor([[1.0, 1, 1], [1, -1, -1], [1, 1, -1], [1, -1, 1]]))
    assert energies.force_closure(0.03 * one_sided, one_sided, 0.03).value.sum() > 1.0
    couple = torch.tensor([[0.03, 0.02, 0.0], [-0.03, -0.02, 0.0]])
    sides = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    wrench = energies.force_closure(couple, sides, 0.02).value
    torch.testing.assert_close(wrench, torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 4.0]))  # two arms of one length each


@pytest.mark.parametrize("name", ["contact_distance", "penetration"])
def test_distance_terms_follow_the_field(name):
    term = getattr(energies, name)
    direction, offset = unit(random(2, 5, 3)), torch.linspace(-0.02, 0.02, 5, dtype=torch.float64) + 1e-3
    points = direction * (RADIUS + offset)[:, None]

    def plane(p: torch.Tensor) -> torch.Tensor:
        return (p * direction).sum(-1) - RADIUS

    value = term(plane(points), direction)
    by_point = numeric(lambda p: term(plane(p), direction).value.sum(-1), points)
    torch.testing.assert_close(value.by_point, by_point, rtol=1e-6, atol=1e-6)
    expected = offset.abs() if name == "contact_distance" else (-offset).clamp_min(0)
    torch.testing.assert_close(value.value, expected.expand(2, 5))


def test_alignment_is_zero_where_the_normals_oppose():
    normals = unit(random(2, 3, 3))
    assert energies.normal_alignment(normals, -normals).value.abs().max() < 1e-12
    other = unit(random(2, 3, 3, seed=5))
    by_normal = numeric(lambda n: energies.normal_alignment(n, other).value.sum(-1), normals)
    torch.testing.assert_close(energies.normal_alignment(normals, other).by_normal, by_normal, rtol=1e-6, atol=1e-6)


def test_self_penetration_gradient_and_value():
    centres, radii = random(2, 5, 3, scale=0.02), torch.full((5,), 0.02, dtype=torch.float64)
    pairs = torch.combinations(torch.arange(5), 2)
    term = energies.self_penetration(centres, radii, pairs)
    by_point = numeric(lambda c: energies.self_penetration(c, radii, pairs).value.sum(-1), centres)
    torch.testing.assert_close(term.by_point, by_point, rtol=1e-6, atol=1e-6)
    two = torch.tensor([[0.0, 0, 0], [0.03, 0, 0]], dtype=torch.float64)
    overlap = energies.self_penetration(two, radii[:2], torch.tensor([[0, 1]])).value
    torch.testing.assert_close(overlap, torch.tensor([0.01], dtype=torch.float64))  # [m]


def test_joint_margin_gradient():
    q, lower, upper = random(3, 4), torch.full((4,), -0.5).double(), torch.full((4,), 0.4).double()
    value, slope = energies.joint_margin(q, lower, upper)
    torch.testing.assert_close(slope, numeric(lambda x: energies.joint_margin(x, lower, upper)[0].sum(-1), q))
    assert ((value == 0) == ((q >= lower) & (q <= upper))).all()


def test_field_reads_distance_normal_and_curvature_of_a_sphere():
    field = DistanceField.from_grid(sphere_grid(), torch.float64)
    points = unit(random(200, 3)) * (RADIUS + 0.01 * torch.linspace(0, 1, 200).double()[:, None])
    distance, _, normal, bend = field.normals(points)
    torch.testing.assert_close(distance, points.norm(dim=-1) - RADIUS, atol=2e-4, rtol=0)  # [m]
    assert (normal * unit(points)).sum(-1).min() > 0.995
    radius = points.norm(dim=-1)[:, None, None]
    exact = (torch.eye(3).double() - unit(points)[..., None] * unit(points)[..., None, :]) / radius
    assert (bend - exact).norm(dim=(-1, -2)).median() < 0.15 * exact.norm(dim=(-1, -2)).median()
    torch.testing.assert_close(field.distances(points)[0], distance, atol=2e-4, rtol=0)  # [m]


def test_field_grows_beyond_the_grid():
    field = DistanceField.from_grid(sphere_grid(), torch.float64)
    points = unit(random(50, 3)) * 0.3
    assert field.distances(points)[0].min() > 0.15  # [m]


def test_cloud_field_agrees_with_the_grid_near_the_surface():
    normals = unit(random(20000, 3))
    cloud = CloudField.of(RADIUS * normals, normals)
    points = unit(random(100, 3, seed=3)) * (RADIUS + 0.01 * torch.linspace(-0.5, 0.5, 100).double()[:, None])
    distance, normal = cloud.distances(points)
    torch.testing.assert_close(distance, points.norm(dim=-1) - RADIUS, atol=5e-4, rtol=0)  # [m]
    assert (normal * unit(points)).sum(-1).min() > 0.99


@pytest.fixture(scope="module")
def toy() -> GraspEnergy:
    config = EnergyConfig(closing_room=0.3, self_penetration=20.0)
    field = DistanceField.from_grid(sphere_grid(), torch.float64)
    return GraspEnergy(toy_hand(torch.float64), field, torch.zeros(3).double(), RADIUS, config)


def draw(energy: GraspEnergy, n: int = 6, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Grasps that reach into the object, so that every term has something to say."""
    generator = torch.Generator().manual_seed(seed)
    hand = energy.hand
    span = hand.tree.upper - hand.tree.lower
    q = hand.tree.lower + span * torch.rand(n, hand.tree.n_dof, dtype=torch.float64, generator=generator)
    T = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    T[:, :3, :3] = roma.random_rotmat(n, dtype=torch.float64)
    T[:, :3, 3] = random(n, 3, seed=seed, scale=0.01) - (T[:, :3, :3] @ hand.grasp_centre_wrist)
    return T, q, energy.candidates.draw(n, None, generator)


@pytest.mark.parametrize("part", ["joints", "translation", "rotation"])
def test_whole_gradient_through_the_tree(toy, part):
    torch.manual_seed(0)
    T, q, contacts = draw(toy)
    result, pivot = toy(T, q, contacts), toy.pivot(T)
    zero = torch.zeros(len(q), 3, dtype=torch.float64)
    if part == "joints":
        expected, given = numeric(lambda x: toy(T, x, contacts).total, q), result.by_joint
    elif part == "translation":
        expected = numeric(lambda x: toy(moved(T, pivot, x, zero), q, contacts).total, zero)
        given = result.by_pose[:, :3]
    else:
        expected = numeric(lambda x: toy(moved(T, pivot, zero, x), q, contacts).total, zero)
        given = result.by_pose[:, 3:]
    # Steps of 1e-6 seldom cross a voxel's border, where the nearest-voxel field jumps: compare the bulk.
    wrong = (given - expected).abs() > 1e-4 * (1 + expected.abs())
    assert wrong.float().mean() < 0.05
    assert expected.abs().max() > 1


def test_every_term_is_exercised_by_the_gradient_test(toy):
    assert (toy(*draw(toy, 32)).terms.amax(0) > 0).all(), TERMS
