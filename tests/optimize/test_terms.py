"""The pieces of the grasp energy: their gradients by central differences in double precision, and known values.

Each piece is tested away from its kinks; test_energy_kinks.py tests their sum, at the kinks too.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.se3 import turned_about
from dro_grasp.hands.kinematics.tree import PRISMATIC, REVOLUTE, KinematicTree
from dro_grasp.optimize import terms as energies
from tests.helpers.energy_samples import precise, rounded_box
from tests.helpers.toy_hand import toy_hand

STEP = 1e-6
RADIUS = 0.03


def sphere_field(half: float = 0.08, spacing: float = 0.004) -> DistanceField:
    axis = torch.arange(-half, half + 1e-9, spacing, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return DistanceField.from_values(points.norm(dim=-1) - RADIUS, torch.full((3,), -half), spacing)


def random(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True)


def numeric(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
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
    slope = 0.8 * direction  # fields of real meshes are not steep exactly 1
    points = direction * (offset / 0.8)[:, None]

    def plane(p: Tensor) -> Tensor:
        return (p * slope).sum(-1)

    value = term(plane(points), slope)
    by_point = numeric(lambda p: term(plane(p), slope).value.sum(-1), points)
    torch.testing.assert_close(value.by_point, by_point, rtol=1e-6, atol=1e-6)
    expected = offset.abs() if name == "contact_distance" else (-offset).clamp_min(0)
    torch.testing.assert_close(value.value, expected.expand(2, 5))


def test_alignment_is_zero_where_the_normals_oppose():
    normals = unit(random(2, 3, 3))
    assert energies.normal_alignment(normals, -normals).abs().max() < 1e-12
    other = unit(random(2, 3, 3, seed=5))
    by_normal = numeric(lambda n: energies.normal_alignment(n, other).sum(-1), normals)
    torch.testing.assert_close(other, by_normal, rtol=1e-6, atol=1e-6)
    by_object = numeric(lambda n: energies.normal_alignment(normals, n).sum(-1), other)
    torch.testing.assert_close(normals, by_object, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_links_that_may_all_touch_do_not_penetrate(batch: tuple[int, ...]):
    term = energies.self_penetration(
        torch.rand(*batch, 4, 3), energies.SpherePairs.of(torch.ones(4), torch.empty(0, 2, dtype=torch.long)))
    assert term.value.shape == (*batch, 0)
    assert torch.equal(term.by_point, torch.zeros(*batch, 4, 3))


def test_self_penetration_gradient_and_value():
    centres, radii = random(2, 5, 3, scale=0.02), torch.full((5,), 0.02, dtype=torch.float64)
    pairs = torch.combinations(torch.arange(5), 2)
    term = energies.self_penetration(centres, energies.SpherePairs.of(radii, pairs))
    by_point = numeric(lambda c: energies.self_penetration(c, energies.SpherePairs.of(radii, pairs)).value.sum(-1), centres)
    torch.testing.assert_close(term.by_point, by_point, rtol=1e-6, atol=1e-6)
    two = torch.tensor([[0.0, 0, 0], [0.03, 0, 0]], dtype=torch.float64)
    overlap = energies.self_penetration(two, energies.SpherePairs.of(radii[:2], torch.tensor([[0, 1]]))).value
    torch.testing.assert_close(overlap, torch.tensor([0.01], dtype=torch.float64))  # [m]


def test_joint_margin_gradient():
    q, lower, upper = random(3, 4), torch.full((4,), -0.5).double(), torch.full((4,), 0.4).double()
    value, slope = energies.joint_margin(q, lower, upper)
    torch.testing.assert_close(slope, numeric(lambda x: energies.joint_margin(x, lower, upper)[0].sum(-1), q))
    assert ((value == 0) == ((q >= lower) & (q <= upper))).all()
    assert slope.unique().tolist() == [-1, 0, 1]


def tangled_tree() -> KinematicTree:
    """The toy hand's tree with everything a tree can have: a sliding joint, axes off the links' origins, couplings."""
    tree = precise(toy_hand()).tree
    kind = (*tree.kind[:4], PRISMATIC, *tree.kind[5:])
    axis, anchor = tree.axis.clone(), random(tree.n_links, 3, seed=1, scale=0.02)
    axis[1:] = unit(random(tree.n_links - 1, 3, seed=2))
    coupling, limits = random(6, 4, seed=3), torch.ones(4).double()
    changed = {"kind": kind, "axis": axis, "anchor": anchor, "coupling": coupling, "offset": random(6, seed=4),
               "joint_names": tree.joint_names[:4], "lower": -limits, "upper": limits}
    return KinematicTree(**(tree.fields() | changed))


def test_forces_on_points_become_the_gradient_by_pose_and_joints():
    tree = tangled_tree()
    assert {PRISMATIC, REVOLUTE} < set(tree.kind)
    links = torch.arange(tree.n_links).repeat(3)
    local, force = random(len(links), 3, scale=0.05), random(2, len(links), 3, seed=6)
    T, q, pivot = torch.eye(4).double().repeat(2, 1, 1), random(2, 4, seed=8), random(2, 3, seed=9, scale=0.1)
    T[:, :3, 3] = random(2, 3, seed=10, scale=0.1)
    zero = torch.zeros(2, 3, dtype=torch.float64)

    def points(T: Tensor, q: Tensor) -> Tensor:
        poses = T[:, None] @ tree.forward(q)
        return (poses[:, links, :3, :3] @ local[..., None])[..., 0] + poses[:, links, :3, 3]

    def work(T: Tensor, q: Tensor) -> Tensor:
        return (points(T, q) * force).sum((-1, -2))

    wrenches = energies.link_wrenches(points(T, q), force, torch.eye(tree.n_links, dtype=torch.float64)[links])
    by_pose, by_joint = energies.joint_gradient(tree, T[:, None] @ tree.forward(q), wrenches, pivot)
    by_move = numeric(lambda x: work(turned_about(T, pivot, x, zero), q), zero)
    by_turn = numeric(lambda x: work(turned_about(T, pivot, zero, x), q), zero)
    torch.testing.assert_close(by_pose, torch.cat([by_move, by_turn], -1), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(by_joint, numeric(lambda x: work(T, x), q), rtol=1e-6, atol=1e-6)


def test_field_reads_distance_normal_and_curvature_of_a_sphere():
    field = sphere_field()
    points = unit(random(200, 3)) * (RADIUS + 0.01 * torch.linspace(0, 1, 200).double()[:, None])
    distance, _, normal, bend = field.normals(points)
    torch.testing.assert_close(distance, points.norm(dim=-1) - RADIUS, atol=2e-4, rtol=0)  # [m]
    assert (normal * unit(points)).sum(-1).min() > 0.995
    radius = points.norm(dim=-1)[:, None, None]
    exact = (torch.eye(3).double() - unit(points)[..., None] * unit(points)[..., None, :]) / radius
    assert (bend - exact).norm(dim=(-1, -2)).median() < 0.15 * exact.norm(dim=(-1, -2)).median()
    torch.testing.assert_close(field.distances(points)[0], distance, atol=2e-4, rtol=0)  # [m]


def points_within_voxels(field: DistanceField) -> Tensor:
    """Points around the surface, none of them near the border of its voxel."""
    points = 0.035 * (2 * torch.rand(400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1)
    voxel = ((points - field.origin) / field.spacing).round()
    return field.origin + (voxel + 0.8 * ((points - field.origin) / field.spacing - voxel)) * field.spacing


@pytest.mark.parametrize("beyond_the_grid", [False, True])
def test_field_within_a_voxel_is_consistent(beyond_the_grid):
    field = rounded_box()
    points = unit(random(100, 3)) * 0.2 if beyond_the_grid else points_within_voxels(field)
    gradient = field.distances(points)[1]
    by_point = numeric(lambda p: field.distances(p)[0], points)
    torch.testing.assert_close(gradient, by_point, rtol=1e-6, atol=1e-6)
    model = field.normals(points)
    by_point = numeric(lambda p: field.normals(p).distance, points)
    torch.testing.assert_close(model.gradient, by_point, rtol=1e-6, atol=1e-6)
    bend = torch.stack([numeric(lambda p, k=k: field.normals(p).normal[:, k], points) for k in range(3)], -2)
    torch.testing.assert_close(model.bend, bend, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(model.normal.norm(dim=-1), torch.ones(len(points)).double())
    assert (model.bend.abs().amax((-1, -2)) > 1).any() != beyond_the_grid  # [1/m]


def test_field_grows_beyond_the_grid():
    field = sphere_field()
    points = unit(random(50, 3)) * 0.3
    assert field.distances(points)[0].min() > 0.15  # [m]
