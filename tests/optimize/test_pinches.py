"""Pinches of analytic things on a table: both sides are touched, and nothing is below the table."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.contacts import tip_links
from dro_grasp.optimize.pinches import Pairs, PinchConfig, PinchEnergy, PinchSearch, _taking, opposed_pairs, pads_of
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.optimiser import OptimiserConfig, pinch
from tests.simulation.test_table import jaws

__all__ = ["jaws"]

TABLE = torch.tensor([0.0, 0.0, 1.0, 0.0])
DOWN = (0.0, 0.0, -1.0)


def solid(mesh: trimesh.Trimesh, name: str) -> ObjectModel:
    """A convex mesh that lies on z = 0."""
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh_object(name, mesh, origin=name, parts=((np.asarray(mesh.vertices), np.asarray(mesh.faces)),))


def card() -> ObjectModel:
    """A card 2 mm thick and 54 mm wide."""
    return solid(trimesh.creation.box((0.085, 0.054, 0.002)), "card")


def rod() -> ObjectModel:
    """A rod 8 mm thick."""
    mesh = trimesh.creation.cylinder(0.004, 0.14, sections=32)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    return solid(mesh, "rod")


@pytest.mark.parametrize("thing", [card, rod])
def test_flat_fingers_pinch_what_lies_on_a_table(jaws: Hand, thing: Callable[[], ObjectModel]) -> None:
    obj = thing()
    problem = GraspProblem(jaws, obj, constraints=Constraints(DOWN, table=0.0))
    assert problem.lies_flat
    found = pinch(problem, 4, 0, OptimiserConfig())
    assert len(found) == 4
    points, _ = jaws.points_and_normals(found.joints, found.T_object_wrist)
    assert float(points[:2, :, 2].amin()) > -0.001
    half = torch.from_numpy(np.abs(obj.cloud[:, :2]).max(0))
    for grasp in range(2):
        outward = []
        for link in tip_links(jaws):
            own = points[grasp, jaws.link_index == link]
            # Seen from above, how far and in which direction the low part of a finger is beside the outline: an exact oracle.
            top = float(obj.cloud[:, 2].max())
            own = own[own[:, 2] < top + 0.008]
            beside = own[:, :2] - torch.minimum(torch.maximum(own[:, :2], -half), half)
            apart = beside.norm(dim=-1)
            assert int(((apart < 1e-6) & (own[:, 2] < top)).sum()) <= 1  # it may lean over the object, but not into it
            beside, apart = beside[apart > 1e-6], apart[apart > 1e-6]
            assert float(apart.min()) < 0.006
            outward.append(beside[apart.argmin()] / apart.min())
        assert float(outward[0] @ outward[1]) < -0.85


def test_pairs_are_opposed_and_side_by_side() -> None:
    pairs = opposed_pairs(card(), TABLE, 0.1, 64, PinchConfig(), torch.Generator().manual_seed(0))
    assert pairs is not None
    assert float(pairs.axis[:, 2].abs().max()) < 0.6  # nothing reaches under a card
    assert torch.allclose(pairs.axis.norm(dim=-1), torch.ones(64), atol=1e-5)
    half = pairs.axis * pairs.width[:, None] / 2
    ends = torch.stack([pairs.middle - half, pairs.middle + half])
    # Both ends are on the surface of the box.
    inside = (ends - torch.tensor([0, 0, 0.001])).abs() / torch.tensor([0.0425, 0.027, 0.001])
    assert torch.allclose(inside.amax(-1), torch.ones(2, 64), atol=1e-3)
    lever = torch.linalg.cross(pairs.middle - torch.tensor([0, 0, 0.001]), pairs.axis).norm(dim=-1)
    assert torch.allclose(lever, pairs.lever, atol=1e-6)


def test_nothing_narrow_enough_gives_no_pairs() -> None:
    assert opposed_pairs(card(), TABLE, 0.01, 8, PinchConfig(), torch.Generator().manual_seed(0)) is None


def test_rotations_take_one_vector_to_another() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=-1) for _ in range(2))
    b[0], b[1] = a[0], -a[1]
    R = _taking(a, b)
    assert torch.allclose((R @ a[..., None])[..., 0], b, atol=1e-5)
    assert torch.allclose(R @ R.mT, torch.eye(3).expand(20, 3, 3), atol=1e-5)
    assert bool((torch.linalg.det(R) > 0.99).all())


def test_the_slope_is_that_of_the_energy() -> None:
    """The pull on the pads and the turn of their normals, against finite differences; other terms have tests of their own."""
    hand, obj = load_hand("gripper3"), rod()
    problem = GraspProblem(hand, obj, constraints=Constraints(DOWN, table=-1.0, touch_table=True))
    energy = problem.energy(OptimiserConfig().synthesis.energy)
    search = PinchSearch(energy, 0.01, DOWN, None)
    generator = torch.Generator().manual_seed(3)
    hands = search._first(6, generator)
    far = torch.tensor([[0.3, 0.3, 0.5]]).repeat(6, 1)  # away from the object and the table: nothing else acts
    axis = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator), dim=-1)
    pairs = Pairs(far, axis, torch.full((6,), 0.02), torch.zeros(6))
    slope = PinchEnergy(search.energy, hands.pads, pairs, PinchConfig())
    T = search._placed(hands, pairs)[0]
    still = slope(T, hands.q, hands.pads)
    others = [index for index in range(6) if index not in (1, 4)]
    for joint in range(hand.tree.n_dof):
        step = 1e-3 * torch.nn.functional.one_hot(torch.tensor(joint), hand.tree.n_dof)
        high, low = slope(T, hands.q + step, hands.pads), slope(T, hands.q - step, hands.pads)
        quiet = (still.terms[:, others].abs().sum(-1) + high.clearance[:, 0] + high.terms[:, others].abs().sum(-1)) < 1e-6
        numeric = (high.terms[:, (1, 4)].sum(-1) - low.terms[:, (1, 4)].sum(-1)) / 2e-3
        assert torch.allclose(numeric[quiet], still.by_joint[quiet, joint], rtol=0.03, atol=0.3)
    shift = torch.eye(4).repeat(6, 1, 1)
    shift[:, 0, 3] = 1e-4
    rise = (slope(shift @ T, hands.q, hands.pads).total - slope(torch.linalg.inv(shift) @ T, hands.q, hands.pads).total) / 2e-4
    assert torch.allclose(rise, still.by_pose[:, 0], rtol=0.03, atol=2.0)


def test_more_points_of_tips_are_pads_than_other_contacts() -> None:
    hand = load_hand("leaphand")
    energy = GraspProblem(hand, rod(), constraints=Constraints(DOWN, table=0.0)).energy(OptimiserConfig().synthesis.energy)
    pads, before = pads_of(energy, 0.0), energy.candidates
    assert {tuple(p) for p in before.points.tolist()} <= {tuple(p) for p in pads.points.tolist()}
    for link in tip_links(hand):
        assert int((pads.links == link).sum()) > int((before.links == link).sum()) > 0
    assert torch.equal(pads.fingers, hand.finger_of_link[pads.links])
